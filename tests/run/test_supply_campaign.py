"""What befalls the block's supply in whole dry runs: a short seeded campaign (seed 20261122).

The campaign itself is `benchmarks/supply_campaign.py`; it judges values, the block's limits in the world, messages
and resuming.
"""

from pathlib import Path

import pytest

from benchmarks import supply_campaign as campaign
from sim.world.power import Disturbance

pytestmark = pytest.mark.slow

SEED = 20261122


def test_a_short_campaign_has_no_violation(tmp_path: Path) -> None:
    benches = campaign.stands(tmp_path, campaign.WAYS[1:])
    trials = campaign.draw(len(campaign.KINDS), SEED, benches)
    outcomes = [campaign.carry_out(trial, tmp_path) for trial in trials]
    assert campaign.violations(outcomes) == []
    assert {outcome.trial.kind for outcome in outcomes} == set(campaign.KINDS)
    assert sum(outcome.resumed for outcome in outcomes) >= 3
    last = campaign.table(outcomes).splitlines()[-1].split()
    assert last[:2] == ["all", str(len(outcomes))]
    assert last[5:8] == ["0", "0", "0"]


def test_the_judge_sees_a_value_that_is_wrong_and_a_cause_that_is_not_named(tmp_path: Path) -> None:
    """Against other values each reading is wrong; and an error must name the supply with the rail."""
    (stand,) = campaign.stands(tmp_path, campaign.WAYS[1:2])
    never = Disturbance("off", stand.duration_s + 1e6, "2")
    trial = campaign.FedTrial("judge", stand, "off", never)
    outcome = campaign.carry_out(trial, tmp_path)
    assert (outcome.completed, outcome.violations) == (True, [])
    values = {place: (mean[0] + 1e-6, *mean[1:]) for place, mean in stand.values.items()}
    other = campaign.replace(trial, stand=campaign.replace(stand, values=values))
    judged = campaign.FedOutcome(other)
    campaign.judge_finished(campaign.Run(tmp_path / "fed-trial-judge"), judged)
    assert judged.wrong_values == campaign.READINGS
    judged.said = "bench: power_supply: did something"
    campaign.judge_stop(2, judged)
    assert "the cause is not named" in judged.violations[-1]
