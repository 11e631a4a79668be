"""What befalls the block's supply in whole dry runs: a short seeded campaign (seed 20261122).

The campaign itself is `benchmarks/supply_campaign.py`; it judges values, the block's limits in the world, messages
and resuming.
"""

from pathlib import Path

import pytest

from benchmarks import supply_campaign, supply_trials
from sim.world.power import Disturbance

pytestmark = pytest.mark.slow

SEED = 20261122


def test_a_short_campaign_has_no_violation(tmp_path: Path) -> None:
    benches = supply_trials.stands(tmp_path, supply_trials.WAYS[1:])
    trials = supply_campaign.draw(len(supply_campaign.KINDS), SEED, benches)
    outcomes = [supply_trials.carry_out(trial, tmp_path) for trial in trials]
    assert supply_campaign.violations(outcomes) == []
    assert {outcome.trial.kind for outcome in outcomes} == set(supply_campaign.KINDS)
    assert sum(outcome.resumed for outcome in outcomes) >= 3
    last = supply_campaign.table(outcomes).splitlines()[-1].split()
    assert last[:2] == ["all", str(len(outcomes))]
    assert last[5:8] == ["0", "0", "0"]


def test_the_judge_sees_a_value_that_is_wrong_and_a_cause_that_is_not_named(tmp_path: Path) -> None:
    """Against other values each reading is wrong; and an error must name the supply with the rail."""
    (stand,) = supply_trials.stands(tmp_path, supply_trials.WAYS[1:2])
    never = Disturbance("off", stand.duration_s + 1e6, "2")
    trial = supply_trials.FedTrial("judge", stand, "off", never)
    outcome = supply_trials.carry_out(trial, tmp_path)
    assert (outcome.completed, outcome.violations) == (True, [])
    values = {place: (mean[0] + 1e-6, *mean[1:]) for place, mean in stand.values.items()}
    other = supply_trials.replace(trial, stand=supply_trials.replace(stand, values=values))
    judged = supply_trials.FedOutcome(other)
    supply_trials.judge_finished(supply_trials.Run(tmp_path / "fed-trial-judge"), judged)
    assert judged.wrong_values == supply_trials.READINGS
    judged.said = "bench: power_supply: did something"
    supply_trials.judge_stop(2, judged)
    assert "the cause is not named" in judged.violations[-1]
