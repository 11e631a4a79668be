"""Runs with signals, disturbed supplies, and commands in any order: nothing is amiss, and it would be seen."""

import signal
from pathlib import Path

import hypothesis
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from bench.run.power import WATCH_S
from benchmarks.campaign import command
from sim.world.power import Disturbance
from tests.support import signal_trials, supply_faults
from tests.support.campaigns import seeds
from tests.support.evenings import Evenings
from tests.support.signal_trials import PATTERNS, PHASES, TROUBLES, Trial, draw, worker

pytestmark = pytest.mark.slow
with_sighup = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a system without SIGHUP")
NEVER_S = 120.0
"""No trial is judged by its time here: a machine that is busy is not a fault."""
INT, TERM = signal.SIGINT, signal.SIGTERM
TRIALS = [
    Trial(1, "run_failed", "burst", (TERM, INT, INT, TERM, INT, INT, TERM), 0.0, "meter hangs"),
    Trial(2, "temperature", "late second", (INT, INT), 0.1, "chamber hangs"),
    Trial(3, "run_started", "single", (TERM,), 0.2, "terminal closed"),
]


@pytest.mark.slow(11)
@with_sighup
@pytest.mark.parametrize("seed", seeds(0))
def test_the_bench_is_left_safe_at_every_signal(monkeypatch, seed):
    monkeypatch.setattr(signal_trials, "LIMIT_S", NEVER_S)
    outcomes = worker(draw(len(PHASES) * len(PATTERNS), seed) if seed else TRIALS)
    assert [(outcome.trial, outcome.violations) for outcome in outcomes if outcome.violations] == []
    assert seed or {outcome.state for outcome in outcomes} >= {"interrupted", "failed"}


@with_sighup
def test_every_phase_pattern_and_trouble_is_drawn():
    trials = draw(200, 1)
    assert {trial.phase for trial in trials} == set(PHASES)
    assert {trial.pattern for trial in trials} == set(PATTERNS)
    assert {trial.trouble for trial in trials} == set(TROUBLES)
    assert {number for trial in trials for number in trial.signals} == {INT, TERM, signal.SIGHUP}


SEED = 20261122


@pytest.fixture(scope="module")
def stands(tmp_path_factory):
    return supply_faults.stands(tmp_path_factory.mktemp("stands"), supply_faults.WAYS[1:])


@pytest.mark.slow(14)
@pytest.mark.parametrize("seed", seeds(SEED))
def test_disturbances_of_each_kind_bring_no_violation(stands, tmp_path: Path, seed: int) -> None:
    trials = supply_faults.draw(len(supply_faults.KINDS), seed, stands)
    outcomes = [supply_faults.carry_out(trial, tmp_path) for trial in trials]
    assert supply_faults.violations(outcomes) == []
    assert {outcome.trial.kind for outcome in outcomes} == set(supply_faults.KINDS)
    assert seed > SEED or sum(outcome.resumed for outcome in outcomes) >= 3


def test_a_rail_that_drifts_while_the_block_is_mounted_stops_the_run_within_its_limits(stands, tmp_path):
    """Toward the other sign it passes no protection, and 20 min of mounting would take it to +2.9 V."""
    stand = stands[-1]
    with supply_faults.watched(Disturbance("drift", 596.0, "3", 53.0)) as watch:
        status, _, said, _ = command(
            "run", stand.procedure, "--dry-run", "--bench", stand.bench, "--runs", tmp_path
        )
    assert status == 2
    assert "rail n15 has -14.7" in said or "rail n15 has -14.6" in said
    assert watch.power.violations == []
    assert watch.now_s < 596.0 + 0.2 * 3600.0 / 53.0 + 2 * WATCH_S


def test_the_judge_sees_a_value_that_is_wrong_and_a_cause_that_is_not_named(stands, tmp_path: Path) -> None:
    """Against other values each reading is wrong; and an error must name the supply with the rail."""
    stand = stands[0]
    never = Disturbance("off", stand.duration_s + 1e6, "2")
    trial = supply_faults.FedTrial("judge", stand, "off", never)
    outcome = supply_faults.carry_out(trial, tmp_path)
    assert (outcome.completed, outcome.violations) == (True, [])
    values = {place: (mean[0] + 1e-6, *mean[1:]) for place, mean in stand.values.items()}
    other = supply_faults.replace(trial, stand=supply_faults.replace(stand, values=values))
    judged = supply_faults.FedOutcome(other)
    supply_faults.judge_finished(supply_faults.Run(tmp_path / "fed-trial-judge"), judged)
    assert judged.wrong_values == supply_faults.READINGS
    judged.said = "bench: power_supply: did something"
    supply_faults.judge_stop(2, judged)
    assert "the cause is not named" in judged.violations[-1]


pytest.importorskip("starlette")


@pytest.mark.parametrize("seed", seeds(0))
def test_no_record_is_lost_whatever_is_done(seed):
    """Drawn steps, the same each time; three times thirty of them with each further seed."""
    run_state_machine_as_test(
        hypothesis.seed(seed)(Evenings) if seed else Evenings,
        settings=settings(
            max_examples=3 if seed else 1,
            stateful_step_count=30 if seed else 10,
            derandomize=not seed,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_resumed_with_a_meter_off_and_killed_it_is_brought_to_its_end():
    """What broke records before, step by step: it needs no luck of the draw."""
    evening = Evenings()
    try:
        evening.run("meter off", 12)
        evening.resume(0, "", 0)
        evening.press_resume(0, "", 0)
        evening.switch("voltmeter.y")
        evening.resume(0, "kill", 9)
        evening.press_resume(0, "results", 4)
        evening.bring_to_its_end(0)
    finally:
        evening.teardown()
