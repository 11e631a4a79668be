"""Runs with a disturbed supply: no wrong value is recorded, and the block never leaves its limits.

Every trial is a dry run of a short procedure by the command line, on a shipped bench file without errors, fed
by a simulated supply. Once, at a random moment, a rail drops, trips, goes into current limit, drifts, loses
its contact or is switched off by hand, or the mains fail and return. Every recorded value is compared with an
undisturbed run and with the true state of the rails at that time. The block's absolute limits are checked in
the simulated world, not by the driver. A stopped run must name the supply and the rail. When it is resumed
undisturbed, it must end with all planned readings, which agree; those after the block was off must belong to
a new series.
"""

import contextlib
import copy
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final
from unittest import mock

import bench.cli.measure
import bench.run.assembly.served
from bench.run.folder import Run
from benchmarks.campaign import command
from sim.bench import SimulatedBench
from sim.world.power import Disturbance, Power
from tests.support.fed_bench import FEED, N15, P15
from tests.support.wire_faults import VALUE_V, Tried, exact_bench, run_arguments

TIMEOUT: Final = "2 s"
READBACK_V: Final = 0.01
"""Largest difference between the voltage that a supply measures and the true voltage of the rail, V."""
LOOKS: Final = 8
"""Number of times within a reading at which the true voltages of the rails are read."""

PROCEDURE: Final = """\
procedure: fed
title: Four points in each of two installations
reading: {samples: 2, nplc: 1, settle: 20 s}
steps:
  - installation:
      label: 1
      steps:
        - turn: {angles: [10 deg, 55 deg, 100 deg, 190 deg]}
  - wait: {for: 10 min, reason: the bench is quiet}
  - installation:
      label: 2
      steps:
        - turn: {angles: [10 deg, 55 deg, 100 deg, 190 deg]}
"""
READINGS: Final = 8

Place = tuple[str, int, int]


@dataclass(frozen=True)
class Fed:
    """A way to feed the block: a shipped bench, its supply, the outputs of its two rails, and their protection."""

    name: str
    bench: str
    supply: Mapping[str, Any]
    outputs: tuple[str, str]
    over_voltage_v: float | None


E3631A: Final = {"driver": "keysight-e3631a", "resource": "GPIB0::5::INSTR"}
E36311A: Final = {
    "driver": "keysight-e36300", "model": "E36311A", "resource": "TCPIP0::192.0.2.30::5025::SOCKET",
}  # fmt: skip
WAYS: Final = (
    Fed("E3631A on GPIB, head by hand", "bench-gpib", E3631A, ("P25V", "N25V"), None),
    Fed("E36311A on LAN, head by hand", "bench-lan", E36311A, ("2", "3"), 16.5),
    Fed("E36311A on LAN, head with a motor", "bench-motorised", E36311A, ("2", "3"), 16.5),
)


@dataclass(frozen=True)
class FedStand:
    """A bench without errors and with a supply; duration (s) and readings (V) of an undisturbed run on it."""

    fed: Fed
    bench: Path
    procedure: Path
    duration_s: float = 0.0
    values: Mapping[Place, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class FedTrial:
    """One run with the disturbance of its supply."""

    name: str
    stand: FedStand
    kind: str
    disturbance: Disturbance


@dataclass
class FedOutcome(Tried):
    """The outcome of a trial."""


# --- the benches ------------------------------------------------------------------------------------


def _section(fed: Fed) -> dict[str, Any]:
    """Return the section of a bench file that states how the block is fed."""
    stated = zip((P15, N15), fed.outputs, strict=True)
    rails = [{**copy.deepcopy(rail), "output": output} for rail, output in stated]  # without anchors in YAML
    section = {**FEED, "rails": rails, "warm_up": "10 min"}
    if fed.over_voltage_v is None:
        return section
    for rail, sign in zip(rails, (1, -1), strict=True):
        rail["over_voltage"] = f"{sign * fed.over_voltage_v} V"
    return {**section, "pause": "1 s"}


def _feed(fed: Fed, data: dict[str, Any]) -> None:
    data["instruments"]["power_supply"] = {**fed.supply, "timeout": TIMEOUT}
    data["unit_under_test"]["supply"] = _section(fed)


def stands(folder: Path, ways: Sequence[Fed] = WAYS) -> list[FedStand]:
    """Make the benches; an undisturbed run on each gives its duration and its readings.

    Raises `RuntimeError` if that run does not finish.
    """
    made = []
    for number, fed in enumerate(ways):
        bench_file, _ = exact_bench(folder, fed.bench, TIMEOUT, f"fed-{number}", partial(_feed, fed))
        procedure = folder / "fed-procedure.yaml"
        procedure.write_text(PROCEDURE, encoding="utf-8")
        bare = FedStand(fed, bench_file, procedure)
        with watched(None) as watch:
            status, _, said, _ = command(*run_arguments(bare, folder, f"undisturbed-{number}"))
        if status != 0:
            raise RuntimeError(f"{fed.name}: the undisturbed run ended with {status}: {said}")
        if watch.power.violations:
            raise RuntimeError(f"{fed.name}: outside of the block's limits: {watch.power.violations}")
        run = Run(folder / f"undisturbed-{number}")
        made.append(replace(bare, duration_s=run.history.events.last_s, values=values_of(run)))
    return made


def values_of(run: Run) -> dict[Place, tuple[float, ...]]:
    """Return the readings of a run by installation, pass and point."""
    taken = run.history.readings.values()
    return {(one.installation, one.pass_number, one.point): one.mean for one in taken}


class Watch:
    """A substitute for the class `SimulatedBench` in the composition root.

    It keeps the bench and disturbs its world.
    """

    power: Power
    """The supply and the rails of the world."""

    def __init__(self, disturbance: Disturbance | None) -> None:
        self._disturbance = disturbance

    def __call__(self, *arguments: Any, **named: Any) -> SimulatedBench:
        made = SimulatedBench(*arguments, **named)
        self.power, self.clock = made.world.power, made.world.clock
        if self._disturbance is not None:
            self.power.disturb(self._disturbance)
        return made

    @property
    def now_s(self) -> float:
        """The time in the simulated world, s."""
        return self.clock.now_s()


@contextlib.contextmanager
def watched(disturbance: Disturbance | None) -> Iterator[Watch]:
    """Within the context, disturb a dry run, and leave out its evaluation."""
    watch = Watch(disturbance)
    with (
        mock.patch.object(bench.run.assembly.served, "SimulatedBench", watch),
        # the evaluation of a finished run is no part of a trial, and takes most of its time
        mock.patch.object(bench.cli.measure, "_results", return_value=0),
    ):
        yield watch


# --- a trial ----------------------------------------------------------------------------------------


def carry_out(trial: FedTrial, folder: Path) -> FedOutcome:
    """Carry out and judge a run; if it stopped, resume it undisturbed and judge it again."""
    outcome = FedOutcome(trial)
    name = f"fed-trial-{trial.name}"
    with watched(trial.disturbance) as watch:
        status, _, outcome.said, _ = command(*run_arguments(trial.stand, folder, name))
    run = Run(folder / name)
    outcome.completed = status == 0
    _judge_world(watch, outcome)
    _judge_readings(run, watch, outcome)
    if status == 0:
        judge_finished(run, outcome)
        return outcome
    judge_stop(status, outcome)
    before = run.history.readings
    with watched(None) as watch:
        status, _, said, _ = command("resume", name, "--runs", folder)
    if status != 0:
        outcome.violations.append(f"the resumed run ended with {status}: {said.strip()}")
        return outcome
    outcome.resumed = True
    resumed = Run(folder / name)
    _judge_world(watch, outcome)
    judge_finished(resumed, outcome)
    _judge_visits(resumed, set(before), outcome)
    return outcome


def _judge_world(watch: Watch, outcome: FedOutcome) -> None:
    """Note a fault if the block was ever outside its limits in the simulated world, or is left on."""
    power, fed = watch.power, outcome.trial.stand.fed
    outcome.violations += [f"outside of the block's limits: {violation}" for violation in power.violations]
    on = [output for output in fed.outputs if power.stage(output, watch.now_s).on]
    if on:
        outcome.violations.append(f"left on: {', '.join(on)}")


def _judge_readings(run: Run, watch: Watch, outcome: FedOutcome) -> None:
    """Note each recorded value that differs from the undisturbed run, or was read while a rail was off."""
    stand = outcome.trial.stand
    outcome.violations += run.history.problems
    for event in run.history.events:
        reading = event.reading
        if reading is None:
            continue
        wrong = _differs(stand, (reading.installation, reading.pass_number, reading.point), reading.mean)
        begun_s = reading.time_s or 0.0
        for name, nominal_v in (("p15", 15.0), ("n15", -15.0)):
            for look in range(LOOKS):
                at_s = begun_s + (event.bench_s - begun_s) * look / LOOKS
                true_v = watch.power.rail_v(name, at_s)
                if abs(true_v - nominal_v) > 0.2 + READBACK_V:
                    wrong = wrong or f"rail {name} had {true_v:.4g} V while {reading} was taken"
            if abs(reading.rails[name].voltage_v - watch.power.rail_v(name, begun_s)) > 0.2 + READBACK_V:
                wrong = wrong or f"rail {name} is recorded with {reading.rails[name]} V"
        if wrong:
            outcome.wrong_values += 1
            outcome.violations.append(f"wrong value: {wrong}")


def _differs(stand: FedStand, place: Place, mean: Sequence[float]) -> str:
    """Return how a reading differs from that of the undisturbed run; "" if it does not."""
    expected = stand.values[place]
    if all(abs(one - other) <= VALUE_V for one, other in zip(mean, expected, strict=True)):
        return ""
    return f"{list(mean)} V on record at {place}, {list(expected)} V undisturbed"


def judge_finished(run: Run, outcome: FedOutcome) -> None:
    """Note a fault unless a finished run has the planned readings, which agree with the undisturbed run's."""
    if run.history.state != "finished":
        outcome.violations.append(f"the run is {run.history.state}, not finished")
    found = values_of(run)
    if set(found) != set(outcome.trial.stand.values) or len(found) != READINGS:
        outcome.violations.append(f"not the readings planned: {sorted(found)}")
        return
    for place, mean in found.items():
        if wrong := _differs(outcome.trial.stand, place, mean):
            outcome.wrong_values += 1
            outcome.violations.append(f"wrong value: {wrong}")


def judge_stop(status: Any, outcome: FedOutcome) -> None:
    """Note a fault unless a stopped run names the supply and the rail or output, without a traceback."""
    outcome.judge_stop(status)
    said = outcome.said
    named = (
        "rail p15", "rail n15", "its output", "did not answer", "no answer", "its settings changed", "is off",
    )  # fmt: skip
    if "power_supply:" not in said or not any(words in said for words in named):
        outcome.violations.append(f"the cause is not named: {said.strip()}")


def _judge_visits(run: Run, before: set[int], outcome: FedOutcome) -> None:
    """Note a fault if readings in a mounting from before and after the block was off belong to the same series."""
    visits: dict[str, set[int]] = {}
    later: dict[str, set[int]] = {}
    for step, reading in run.history.readings.items():
        (visits if step in before else later).setdefault(reading.installation, set()).add(reading.series)
    for installation in visits.keys() & later.keys():
        if visits[installation] & later[installation]:
            outcome.violations.append(f"one visit to installation {installation} before and after it was off")


# --- drawn trials ----------------------------------------------------------------------------------------


SHORTEST_S: Final = 5.0
"""Longest drop, s, that may begin and end within a reading, between the checks before it and after it."""


def _lasting(generator: random.Random) -> float:
    """Return the random duration of a disturbance, s: from seconds to an hour, or infinite."""
    if generator.random() < 0.5:
        return math.inf
    return math.exp(generator.uniform(math.log(SHORTEST_S), math.log(3600.0)))


KINDS: Final = ("drop", "trip", "limit", "drift", "open", "off", "cut")


def _drawn(kind: str, generator: random.Random, stand: FedStand, at_s: float, output: str) -> Disturbance:
    """Draw a disturbance of a kind.

    For a trip, the voltage rises until the protection acts, or a contact is lost.
    """
    protected = stand.fed.over_voltage_v is not None
    match kind:
        case "drop":
            return Disturbance("sag", at_s, output, generator.uniform(0.02, 0.95), _lasting(generator))
        case "trip" if protected:
            sign = 1.0 if output == stand.fed.outputs[0] else -1.0
            return Disturbance("drift", at_s, output, sign * generator.uniform(0.05, 2.0) * 3600.0)
        case "limit":
            return Disturbance("load", at_s, output, generator.uniform(2.2, 30.0), _lasting(generator))
        case "drift":  # as slow as supplies drift; what has a protection may be faster
            size = generator.uniform(0.5, 60.0 if protected else 6.0) * generator.choice((-1.0, 1.0))
            return Disturbance("drift", at_s, output, size)
        case "off":
            return Disturbance("off", at_s, output)
        case "cut":
            return Disturbance("cut", at_s, lasts_s=math.exp(generator.uniform(0.0, math.log(7200.0))))
    return Disturbance("open", at_s, output, lasts_s=_lasting(generator))


def draw(count: int, seed: int, benches: Sequence[FedStand]) -> list[FedTrial]:
    """Draw `count` trials, using the kinds of disturbance in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    trials = []
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        able = [b for b in benches if kind != "trip" or b.fed.over_voltage_v is not None]
        stand = generator.choice(able or list(benches))
        at_s = generator.uniform(0.0, stand.duration_s)
        disturbance = _drawn(kind, generator, stand, at_s, generator.choice(stand.fed.outputs))
        trials.append(FedTrial(str(number), stand, kind, disturbance))
    return trials


def violations(outcomes: Sequence[FedOutcome]) -> list[str]:
    """Return every violation, with the disturbance that led to it."""
    return [
        f"{outcome.trial.stand.fed.name} {outcome.trial.disturbance}: {text}"
        for outcome in outcomes
        for text in outcome.violations
    ]
