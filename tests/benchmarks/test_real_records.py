"""The trial on real records: what was sealed, and how names are judged."""

from types import SimpleNamespace

import pytest

from benchmarks.real_records.__main__ import Row
from benchmarks.real_records.cases import Case, cases, require_sealed


def test_truth_and_records_are_those_that_were_sealed():
    require_sealed()
    assert len(cases()) >= 20
    assert all(case.files for case in cases())


THERMAL = ["voltmeter_thermal_gain", "voltmeter_thermal_offset"]


@pytest.mark.parametrize(
    ("right", "groups", "judged"),
    [
        (THERMAL, [THERMAL], "right"),
        (THERMAL, [["voltmeter_thermal_gain"], ["voltmeter_move"]], "right, a jump not published"),
        (THERMAL, [], "missed"),
        (THERMAL, [["reference_supply"]], "wrong lone name"),
        ([], [["reference_supply"]], "wrong lone name"),
        ([], [THERMAL], "a tie, no cause published"),
        ([], [], "nothing named"),
    ],
)
def test_names_are_judged_by_what_the_publisher_tells(right, groups, judged):
    effects = [SimpleNamespace(name=name, cannot_tell_from=tied, in_catalogue=True) for name, *tied in groups]
    row = Row(Case("a", "b", right), SimpleNamespace(effects=effects), None, None, None)
    assert row.judged == judged
