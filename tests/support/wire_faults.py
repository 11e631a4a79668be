"""Runs with faults on the wire: no hang, no traceback, no wrong value.

Every trial is a dry run of a short procedure by the command line. Its bench file is a shipped one, without
errors of stand, voltmeters and operator, and with short timeouts. One fault of a random kind affects one
instrument at a random exchange; in a storm there are five. The judge checks the text on standard error, the
record's chain of hashes, and every recorded sample against the forward model at the recorded angle. It checks
the duration of a run against the limit that the caller states. A stopped run must name the instrument, and end
with all planned readings when it is resumed without faults.
"""

import contextlib
import functools
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import yaml

import bench.run.assembly.served
from bench.config.bench_file.file import BenchFile, load_bench
from bench.model import Conditions, ForwardModel, stand_errors
from bench.run.folder import Run
from benchmarks.campaign import ROOT, command
from sim.bench import SimulatedBench
from sim.wires.faults import OF_INSTRUMENT, Fault, FaultKind, FaultyInstrument
from sim.wires.session import ServedInstrument, WireFault

VALUE_V: Final = 1e-7
LARGEST_V: Final = 2.5
ENCODER_RAD: Final = math.radians(0.00005)
"""Half the last digit of the simulated encoder's angle."""
TEMPERATURE_C: Final = 0.5

PROCEDURE: Final = """\
procedure: short
title: Three points
reading: {{samples: 2, nplc: 1, settle: 1 s}}
steps:
{temperature}  - installation:
      label: 1
      steps:
        - turn: {{angles: [10 deg, 55 deg, 100 deg]}}
"""
TEMPERATURE: Final = "  - temperature: {at: 30 degC, soak: 20 min}\n"
READINGS: Final = 3


@dataclass(frozen=True)
class Stand:
    """A bench file without errors, its procedure, and the number of exchanges of each instrument in a run."""

    name: str
    bench: Path
    procedure: Path
    exchanges: Mapping[str, int]
    able: Mapping[str, tuple[str, ...]]
    """The instruments that can have each kind of fault."""
    behind_adapter: tuple[str, ...]
    """The meters that a fault of the GPIB adapter affects."""


@dataclass(frozen=True)
class Trial:
    """One run with its faults."""

    name: str
    stand: Stand
    kind: str
    faults: tuple[Fault, ...]


@dataclass
class Tried:
    """The outcome of a run with a disturbance: whether it ended, whether it was resumed, and its faults."""

    trial: Any
    completed: bool = False
    resumed: bool = False
    time_s: float = 0.0
    wrong_values: int = 0
    said: str = ""
    violations: list[str] = field(default_factory=list)

    def judge_stop(self, status: Any) -> None:
        """Note a fault unless a stopped run states its reason in lines of its own, without a traceback."""
        if status != 2:
            self.violations.append(f"exit status {status}: {self.said.strip()}")
        if "Traceback" in self.said or "unexpected" in self.said:
            self.violations.append(f"not one of our errors: {self.said.strip()}")


@dataclass
class Outcome(Tried):
    """The outcome of a trial; `struck` are the faults that occurred."""

    struck: int = 0


# --- the benches ------------------------------------------------------------------------------------


def exact(data: dict[str, Any], timeout: str) -> dict[str, Any]:
    """Return a bench file's data without errors of stand, voltmeters and operator, with these timeouts.

    The disturbances of wires and inputs on a harsh bench remain; `slack_v` is their bound.
    """
    for name, size in data["stand"].items():
        size["limit"] = "0 V" if name == "voltmeter_error" else "0 arcsec"
    simulation = data.setdefault("simulation", {})
    simulation["voltmeter"] = simulation.get("voltmeter", {}) | {"noise": False, "accuracy": None}
    simulation.setdefault("operator", {})["slip_probability"] = 0.0
    if "sensor_noise" in simulation.get("chamber", {}):
        simulation["chamber"]["sensor_noise"] = "0 K"
    data.pop("effects", None)
    instruments = data["instruments"]
    with_wire = [part for part in (instruments["head"], instruments.get("chamber")) if part]
    for section in [*instruments["voltmeters"], *with_wire]:
        if "resource" in section:
            section["timeout"] = timeout
    return data


def exact_bench(
    folder: Path, shipped: str, timeout: str, name: str = "", change: Callable[[Any], None] | None = None
) -> tuple[Path, dict[str, Any]]:
    """Write a shipped bench file without errors, modified by `change`; return the file and its data."""
    text = (ROOT / "config" / f"{shipped}.yaml").read_text(encoding="utf-8")
    data = exact(yaml.safe_load(text), timeout)
    if change is not None:
        change(data)
    path = folder / f"{name or shipped}.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path, data


def stands(folder: Path, names: Sequence[str], timeout: str) -> list[Stand]:
    """Make the benches of these bench files; a run without faults on each counts the exchanges.

    Raises `RuntimeError` if that run fails.
    """
    made = []
    for name in names:
        bench_file, data = exact_bench(folder, name, timeout)
        chamber = data["instruments"].get("chamber") or {}
        heated = chamber.get("driver", "manual-chamber") != "manual-chamber"
        procedure = folder / f"{name}-procedure.yaml"
        procedure.write_text(PROCEDURE.format(temperature=TEMPERATURE if heated else ""), encoding="utf-8")
        on_bus = tuple(n for meter in data["instruments"]["voltmeters"] for n in _on_bus(meter))
        bare = Stand(name, bench_file, procedure, {}, {}, on_bus)
        with watched(()) as watch:
            status, _, said, _ = command(*run_arguments(bare, folder, f"{name}-undisturbed"))
        if status != 0:
            raise RuntimeError(f"{name}: the run without faults ended with {status}: {said}")
        exchanges = {w.name: w.exchanges for w in watch.wires}
        able = {
            str(kind): tuple(w.name for w in watch.wires if w.exchanges and w.can_have(kind))
            for kind in FaultKind
        }
        made.append(Stand(name, bench_file, procedure, exchanges, able, on_bus))
    return made


def _on_bus(meter: Mapping[str, Any]) -> list[str]:
    """Return a list with the name of a meter that is reached through a GPIB adapter; empty for any other meter."""
    channels = meter.get("channels") or list(meter.get("inputs", {}))
    name = meter.get("name", f"voltmeter.{''.join(channels)}")
    return [name] if meter["resource"].lower().startswith("prologix") else []


def run_arguments(stand: Any, runs: Path, name: str) -> list[str]:
    """Return the command line of a dry run."""
    chosen = ["--bench", str(stand.bench), "--name", name, "--runs", str(runs)]
    return ["run", str(stand.procedure), "--dry-run", *chosen]


# --- faults in a run --------------------------------------------------------------------------------


class WatchedWire:
    """A simulated instrument that counts its exchanges, and those that its wire disturbed."""

    def __init__(self, faulty: FaultyInstrument, wired: ServedInstrument) -> None:
        self.name = faulty.name
        self.exchanges = 0
        self.spoilt = 0
        self._faulty = faulty
        self._handle = faulty.handle
        self._has_wire = wired.dialect is faulty  # a meter on a GPIB bus has no connection of its own
        faulty.handle = self._count  # type: ignore[method-assign]
        if self._has_wire:
            wired.fault = self._spoil

    def can_have(self, kind: FaultKind) -> bool:
        """Whether this instrument can have faults of a kind."""
        of_wire = kind not in OF_INSTRUMENT
        return (self._has_wire or not of_wire) and self._faulty.can_have(kind)

    def _count(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        self.exchanges += 1
        return self._handle(message, interrupted)

    def _spoil(self, message: bytes, reply: bytes | None) -> WireFault | None:
        made = self._faulty.wire_fault(message, reply)
        self.spoilt += made is not None
        return made


@dataclass
class Watch:
    """A watch that injects faults into the simulated bench of the next run, and counts them."""

    faults: Sequence[Fault]
    wires: list[WatchedWire] = field(default_factory=list)

    def __call__(self, *arguments: Any, **named: Any) -> SimulatedBench:
        """Make the simulated bench, in place of the class `SimulatedBench` in the composition root."""
        simulated = SimulatedBench(*arguments, **named)
        for fault in self.faults:
            simulated.arm(fault)
        for name, faulty in simulated.faulty.items():
            self.wires.append(WatchedWire(faulty, simulated.wired[name]))
        return simulated

    @property
    def struck(self) -> int:
        """The number of faults that have occurred, as far as this can be observed."""
        by_name = {wire.name: wire for wire in self.wires}
        seen = sum(wire.spoilt for wire in self.wires)
        for fault in self.faults:
            if fault.kind in OF_INSTRUMENT and fault.at is not None and fault.instrument in by_name:
                seen += by_name[fault.instrument].exchanges >= fault.at
        return seen


@contextlib.contextmanager
def watched(faults: Sequence[Fault]) -> Iterator[Watch]:
    """Within the context, inject these faults into a dry run."""
    watch = Watch(faults)
    with mock.patch.object(bench.run.assembly.served, "SimulatedBench", watch):
        yield watch


# --- a trial ----------------------------------------------------------------------------------------


def carry_out(trial: Trial, folder: Path, limit_s: float) -> Outcome:
    """Carry out and judge a run of at most `limit_s`, s; if it stopped, resume it and judge it again."""
    outcome = Outcome(trial)
    name = f"trial-{trial.name}"
    with watched(trial.faults) as watch:
        status, _, outcome.said, outcome.time_s = command(*run_arguments(trial.stand, folder, name))
    outcome.struck = watch.struck
    run = Run(folder / name)
    outcome.completed = status == 0
    judge_record(run, outcome)
    if outcome.time_s > limit_s:
        outcome.violations.append(f"hang: the run took {outcome.time_s:.1f} s")
    if status == 0:
        judge_finished(run, outcome)
    else:
        judge_stop(status, outcome)
        with watched(()):
            status, _, said, _ = command("resume", name, "--runs", folder)
        resumed = Run(folder / name)
        judge_record(resumed, outcome)
        judge_finished(resumed, outcome)
        if status == 0:
            outcome.resumed = True
        else:
            outcome.violations.append(f"the resumed run ended with {status}: {said.strip()}")
    return outcome


def judge_stop(status: Any, outcome: Outcome) -> None:
    """Note a fault unless a stopped run states its reason and the instrument's name, without a traceback."""
    outcome.judge_stop(status)
    said = outcome.said
    struck = {fault.instrument for fault in outcome.trial.faults}
    behind = outcome.trial.stand.behind_adapter if "adapter" in struck else ()
    if not any(f"{name}:" in said for name in (*struck, *behind)):
        outcome.violations.append(f"the instrument is not named: {said.strip()}")


def judge_record(run: Run, outcome: Outcome) -> None:
    """Note a fault unless the chain of hashes is intact and every recorded value is true."""
    history = run.history
    outcome.violations += history.problems
    if history.torn:
        outcome.violations.append("the last line of the record is torn")
    taken = [event.data for event in history.events if "reading" in event.data]
    wrong = [text for step in taken for text in judged(outcome, step)]
    outcome.wrong_values += len(wrong)
    outcome.violations += wrong


@functools.cache
def _bench_file(path: Path) -> BenchFile:
    return load_bench(path)


def judged(outcome: Outcome, step: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with a recorded reading, compared with the forward model at the recorded angle."""
    reading = step["reading"]
    stand = _bench_file(outcome.trial.stand.bench)
    conditions = Conditions.of(
        [reading["installation"]], [np.radians(reading["angle_deg"])], series=[reading["series"]],
        direction=[reading["direction"]], time_s=[reading["time_s"]], temperature_c=[0.0],
    )  # fmt: skip
    model = ForwardModel(stand.installation_models())
    true_v = model.readings(stand.simulated_block(), conditions, stand_errors()[np.newaxis, :], 0.0)[0]
    taken_v = np.array([reading["mean"], *zip(*(reading["samples"][c] for c in "xyz"), strict=True)])
    wrong = []
    if not np.all(np.abs(taken_v - true_v) <= VALUE_V + slack_v(stand)):
        wrong.append(
            f"wrong value: {taken_v.tolist()} V on record, {true_v.tolist()} V is true ({step['key']})"
        )
    if abs(reading["angle_deg"] - reading["target_deg"]) > 0.01:
        wrong.append(f"wrong angle: {reading['angle_deg']}° for {reading['target_deg']}°")
    if reading["temperature_c"] is not None:
        true_c = 30.0 if TEMPERATURE in outcome.trial.stand.procedure.read_text(encoding="utf-8") else 23.0
        if abs(reading["temperature_c"] - true_c) > TEMPERATURE_C:
            wrong.append(f"wrong temperature: {reading['temperature_c']} °C on record, {true_c} °C is true")
    return wrong


def slack_v(stand: BenchFile) -> float:
    """Return the largest deviation of a reading, V.

    It is due to 1/f noise (twenty sines), the loading of the input, and the last digit of an encoder's angle.
    """
    flaws = stand.simulation.voltmeter
    noise_v = flaws.flicker + flaws.reference_flicker * LARGEST_V
    rounded_rad = ENCODER_RAD if stand.instruments.head.driver == "heidenhain-nd28x" else 0.0
    return 20.0 * math.sqrt(0.5) * noise_v + (flaws.source_ohm / 10e9 + rounded_rad) * LARGEST_V


def judge_finished(run: Run, outcome: Outcome) -> None:
    """Note a fault unless a finished run has exactly the planned readings."""
    if run.history.state != "finished":
        outcome.violations.append(f"the run is {run.history.state}, not finished")
        return
    targets = [round(float(t)) for t in np.degrees(run.readings().target_rad)]
    if targets != [10, 55, 100]:
        outcome.violations.append(f"not the readings planned: {targets}")


# --- drawn trials ----------------------------------------------------------------------------------------


STORM: Final = "storm"
STORM_FAULTS: Final = 5
KINDS: Final = (*FaultKind, STORM)
_LAST_OF_SECONDS: Final = 0.6
_ERRORS: Final = (-222, -113, -410)


def draw(count: int, seed: int, benches: Sequence[Stand]) -> list[Trial]:
    """Draw trials with at least `count` faults in all, using the kinds of fault in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    trials: list[Trial] = []
    faults = 0
    while faults < count:
        kind = KINDS[len(trials) % len(KINDS)]
        stand = generator.choice([b for b in benches if kind == STORM or b.able[kind]])
        if kind == STORM:
            able = [k for k in FaultKind if stand.able[k]]
            drawn = tuple(draw_fault(generator, stand, generator.choice(able)) for _ in range(STORM_FAULTS))
        else:
            drawn = (draw_fault(generator, stand, FaultKind(kind)),)
        trials.append(Trial(str(len(trials)), stand, kind, drawn))
        faults += len(drawn)
    return trials


def draw_fault(generator: random.Random, stand: Stand, kind: FaultKind) -> Fault:
    """Return a random fault of a kind: its instrument, exchange and duration."""
    instrument = generator.choice(stand.able[kind])
    seconds = 0.0
    if kind is FaultKind.LATE:
        seconds = generator.uniform(0.02, _LAST_OF_SECONDS)
    elif kind in (FaultKind.REFUSE, FaultKind.HANG):
        seconds = generator.choice((0.0, 0.1, _LAST_OF_SECONDS))
    exchanges = stand.exchanges[instrument]
    # Half of them in the second half, where the readings are.
    first = generator.choice((1, max(1, exchanges // 2)))
    return Fault(
        kind, at=generator.randint(first, exchanges), seconds=seconds, error=generator.choice(_ERRORS),
        instrument=instrument,
    )  # fmt: skip


def violations(outcomes: Sequence[Outcome]) -> list[str]:
    """Return every violation, with the faults that led to it."""
    told = []
    for outcome in outcomes:
        faults = "; ".join(str(fault.told()) for fault in outcome.trial.faults)
        told += [f"{outcome.trial.stand.name} {faults}: {text}" for text in outcome.violations]
    return told
