"""The blind trial in short: the application against readings made by other code, answers apart.

`make blind-trial` is the whole of it; its table stands in docs/diagnosis-trial.md, with how often each of these is
right. The seed fixes the cases.
"""

import pytest

from bench.base.files import cache_folder
from bench.model import CATALOGUE
from bench.readings.corrected import MistakeName
from benchmarks.blind_trial import adapter
from benchmarks.blind_trial.adapter import diagnose_case
from benchmarks.blind_trial.cases import Row, make_case
from benchmarks.blind_trial.mistakes import MISTAKES
from benchmarks.blind_trial.score import judge, sets_given

SEED = 12


@pytest.fixture(scope="module", autouse=True)
def kept_thresholds():
    """The trial simulates the threshold of each design; here those that tests keep are taken."""
    object.__setattr__(adapter._bench()[-1], "folder", cache_folder("thresholds"))


def judged(row, index):
    case, answer = make_case(SEED, row, index)
    diagnosis = diagnose_case(case)
    return answer, diagnosis, judge(case, answer, diagnosis)


@pytest.mark.slow
def test_an_effect_of_20_is_found_and_the_truth_is_in_the_set():
    answer, diagnosis, marks = judged(Row("single", rho=20), 0)
    assert marks["detected"]
    assert any(answer.names[0] in names for names in sets_given(diagnosis)), answer.names
    gap = diagnosis["gap"]
    # what is constant in a mounting is in the other passes, too: nothing held out shows it
    assert answer.names == ("mounting_error",) if gap["before"] is None else gap["after"] < gap["before"]


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is():
    assert judged(Row("null", noise_factor=1.3), 0)[2]["agrees"]


@pytest.mark.slow
def test_a_mistake_is_found_by_its_name():
    """Every kind is found in readings of another independent simulation by `tests/diagnosis/mistakes`."""
    marks = judged(Row("mistake:swapped_installations"), 0)[2]
    assert marks["mistake found"]
    assert marks["in the set"]


@pytest.mark.slow
def test_what_nothing_can_show_is_listed():
    marks = judged(Row("hidden"), 0)[2]
    assert marks["agrees"]
    assert marks["hidden listed"]


def test_the_trial_hides_what_the_catalogue_names():
    """The two vocabularies are written apart; names that differ would be scored as wrong."""
    from benchmarks.blind_trial.effects import CATALOGUE as HIDDEN

    assert set(HIDDEN) <= set(CATALOGUE)
    assert set(MISTAKES) <= {kind.value for kind in MistakeName}
