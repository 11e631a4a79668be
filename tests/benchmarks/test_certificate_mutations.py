"""Changes of each kind to a signed certificate (seed 16): none is accepted and shows anything else."""

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.certificate import proof
from benchmarks import certificate_mutations as mutations
from tests.support.certificates import RECORDED

SEED = 16


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[mutations.Pair]:
    folder = tmp_path_factory.mktemp("mutations")
    run = Path(shutil.copytree(RECORDED, folder / "runs" / "finished"))
    with pytest.MonkeyPatch.context() as patch:
        for name in ("residuals_by_angle", "verification_points"):
            patch.setattr(proof, name, lambda _: '<svg viewBox="0 0 2 1"><path d="M0 0L2 1"/></svg>')
        yield mutations.signed_pair(run, folder)


@pytest.mark.slow
def test_the_pair_itself_is_accepted(pair: mutations.Pair, tmp_path: Path) -> None:
    for kind, original in (("any bit", pair.xml), ("any bit of the PDF", pair.pdf)):
        assert mutations.outcome(pair, original, kind, tmp_path, beside=True) == mutations.UNCHANGED


@pytest.mark.slow
def test_a_change_of_each_kind_is_refused_or_changes_nothing_that_was_signed(
    pair: mutations.Pair, tmp_path: Path
) -> None:
    found = list(mutations.trials(pair, len(mutations.KINDS), SEED, tmp_path))
    assert [kind for kind, _ in found] == list(mutations.KINDS)
    came = Counter(came for _, came in found)
    assert came[mutations.CHANGED] == 0
    assert came[mutations.REFUSED] >= len(mutations.KINDS) - 6
    harmless = {kind for kind, came in found if came == mutations.UNCHANGED}
    assert "a blank between attributes" in harmless
