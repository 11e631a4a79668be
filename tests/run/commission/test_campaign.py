"""Commissioning with a fault of every kind (seed 20261122); `benchmarks/commissioning_campaign.py` has them all."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from benchmarks import commissioning_campaign as campaign

pytestmark = pytest.mark.slow

SEED = 20261122
BENCHES = ("bench-rs232", "bench-prologix", "bench-motorised")
"""Serial ports, an adapter, a head and a chamber with wires of their own."""
NEVER_S = 120.0


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> list[campaign.Bench]:
    return campaign.benches(tmp_path_factory.mktemp("benches"), BENCHES)


def test_one_fault_of_every_kind_is_named_and_all_is_left_safe(
    benches: list[campaign.Bench], tmp_path: Path
) -> None:
    generator = random.Random(SEED)  # noqa: S311 - nothing secret
    every = [trial for bench in benches for trial in campaign.trials_of(bench, SEED)]
    kinds = sorted({trial.kind for trial in every})
    # what is late each time takes half a minute
    modes = dict.fromkeys(kinds, campaign.LASTING) | {"late": campaign.ONCE}
    drawn = [
        generator.choice([trial for trial in every if (trial.kind, trial.mode) == (kind, modes[kind])])
        for kind in kinds
    ]
    outcomes = [campaign.carry_out(trial, tmp_path, NEVER_S) for trial in drawn]
    assert campaign.violations(outcomes) == []
    assert len(outcomes) == 14  # twelve of wire and instrument, two of a head
    assert sum(outcome.traced for outcome in outcomes) >= 11
    assert campaign.table(outcomes).splitlines()[-1].split()[:2] == ["all", "14"]


def test_the_judge_sees_a_fault_that_is_not_named_and_another_that_is_blamed(
    benches: list[campaign.Bench],
) -> None:
    trial = campaign.Trial(benches[-1], "drop", campaign.ONCE, "head", 1)
    result = {"ended": "", "findings": []}
    assert campaign._judged(trial, result, campaign.Outcome(trial)) == ["the instrument is not named"]
    blamed = {"instrument": "chamber", "state": "other", "said": "odd", "remedy": ""}
    wrong = campaign._judged(trial, {"ended": "", "findings": [blamed]}, campaign.Outcome(trial))
    assert any("another is blamed" in text for text in wrong)
    assert any("without a remedy" in text for text in wrong)
