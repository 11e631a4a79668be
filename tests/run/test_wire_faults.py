"""Faults in whole dry runs: drawn ones (seed 20261121), and what campaigns of other seeds once found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from sim.wires.faults import Fault, FaultKind
from tests.support import wire_faults
from tests.support.campaigns import seeds

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from tests.support.wire_faults import Outcome, Stand

SEED = 20261121
FAULTS = 24
SHORT, PATIENT = "0.3 s", "3 s"
"""A reply that a busy machine delays is one fault more in a campaign; beside a single fault there is none."""
NEVER_S = 120.0
"""No trial is judged by its time here: a machine that is busy is not a fault."""
BENCHES = ("paper-stand", "bench-rs232", "bench-prologix", "bench-motorised", "bench-harsh")
"""GPIB boards, serial ports, an adapter; head and chamber with wires of their own; a bench as bad as real ones."""
SHIPPED = sorted(file.stem for file in (wire_faults.ROOT / "config").glob("*.yaml"))
"""The benches of further seeds."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("campaign")


@pytest.fixture(scope="module")
def benches(runs: Path) -> dict[str, Stand]:
    return {stand.name: stand for stand in wire_faults.stands(runs, BENCHES[:3], PATIENT)}


def tried(stand: Stand, runs: Path, name: str, *faults: Fault) -> Outcome:
    """Carry out one trial of a name of its own; there is no violation in it."""
    trial = wire_faults.Trial(name, stand, str(faults[0].kind), faults)
    outcome = wire_faults.carry_out(trial, runs, NEVER_S)
    assert outcome.violations == []
    assert outcome.struck == len(faults)
    return outcome


@pytest.mark.slow(6)
@pytest.mark.parametrize("seed", seeds(SEED))
def test_faults_of_each_kind_bring_no_violation(tmp_path: Path, seed: int) -> None:
    stands = wire_faults.stands(tmp_path, BENCHES if seed == SEED else SHIPPED, SHORT)
    trials = wire_faults.draw(FAULTS, seed, stands)
    outcomes = [wire_faults.carry_out(trial, tmp_path, NEVER_S) for trial in trials]
    assert wire_faults.violations(outcomes) == []
    assert {outcome.trial.kind for outcome in outcomes} == set(wire_faults.KINDS)
    assert sum(outcome.struck for outcome in outcomes) >= 0.6 * FAULTS
    assert any(outcome.completed for outcome in outcomes)
    assert any(outcome.resumed for outcome in outcomes)


def exchange(log: Path, instrument: str, command: str, nth: int = 1) -> int:
    """Return which exchange (1…) of an instrument the n-th of this command is, from a wire log."""
    sent = [
        line.split(" ", 3)[3]
        for line in log.read_text(encoding="utf-8").splitlines()
        if f" {instrument} > " in line
    ]
    places = [index for index, text in enumerate(sent, start=1) if text == command]
    return places[nth - 1]


@pytest.fixture(scope="module")
def log(benches: dict[str, Stand], runs: Path) -> Path:
    """The wire log of an undisturbed run on the paper's stand."""
    file = runs / "undisturbed.log"
    arguments = wire_faults.run_arguments(benches["paper-stand"], runs, "logged")
    assert wire_faults.command(*arguments, "--wire-log", file).status == 0
    return file


def test_a_meter_that_measures_when_another_failed_is_waited_for(
    benches: dict[str, Stand], runs: Path, log: Path
) -> None:
    """y and z were started and not fetched, as x failed: they would ignore the next start (-213)."""
    fault = Fault(FaultKind.POWER_CYCLE, at=exchange(log, "voltmeter.x", "FETC?"), instrument="voltmeter.x")
    assert tried(benches["paper-stand"], runs, "unfetched", fault).completed


@pytest.mark.parametrize("before", ["VOLT:DC:NPLC 1", "SAMP:COUN?", "SYST:ERR?"])
def test_a_meter_switched_off_while_it_is_set_up_is_set_up_again(
    benches: dict[str, Stand], runs: Path, log: Path, before: str
) -> None:
    at = exchange(log, "voltmeter.y", before)
    fault = Fault(FaultKind.POWER_CYCLE, at=at, instrument="voltmeter.y")
    assert tried(benches["paper-stand"], runs, f"set-up-{at}", fault).completed


@pytest.mark.parametrize("at", [8, 15, 21])
def test_errors_of_an_exchange_that_failed_do_not_spoil_the_next(
    benches: dict[str, Stand], runs: Path, at: int
) -> None:
    """LOCAL pressed during the set-up of an RS-232 meter: its errors (+550) are of the attempt before."""
    fault = Fault(FaultKind.LOCAL, at=at, instrument="voltmeter.z")
    assert tried(benches["bench-rs232"], runs, f"local-{at}", fault).completed


def test_an_adapters_connection_lost_once_costs_one_attempt(benches: dict[str, Stand], runs: Path) -> None:
    """All three meters share it: each has to find out, but not each at the cost of a step's attempt."""
    stand = benches["bench-prologix"]
    fault = Fault(FaultKind.DROP, at=stand.exchanges["adapter"] - 40, instrument="adapter")
    assert tried(stand, runs, "adapter", fault).completed


def test_the_judge_sees_a_wrong_value_and_a_missing_name(benches: dict[str, Stand], runs: Path) -> None:
    """Against a bench file with another bias, each value on record is wrong; an error must name its source."""
    stand = benches["paper-stand"]
    other = runs / "other-bias.yaml"
    text = stand.bench.read_text(encoding="utf-8")
    assert "0.071469 V" in text
    other.write_text(text.replace("0.071469 V", "0.071470 V"), encoding="utf-8")
    fault = Fault(FaultKind.ERROR, at=2, instrument="voltmeter.x")
    trial = wire_faults.Trial("judge", stand, "error", (fault,))
    outcome = wire_faults.carry_out(trial, runs, NEVER_S)
    assert outcome.violations == []
    judged = wire_faults.Outcome(replace(trial, stand=replace(stand, bench=other)))
    wire_faults.judge_record(wire_faults.Run(runs / "trial-judge"), judged)
    assert judged.wrong_values == wire_faults.READINGS
    judged.said = "bench: voltmeter.y: did something"
    wire_faults.judge_stop(2, judged)
    assert "the instrument is not named" in judged.violations[-1]
