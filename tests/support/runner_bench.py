"""A bench in memory, a plan of two installations, and runners over them."""

from collections.abc import Collection
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.base.arrays import CHANNELS
from bench.config.procedure.plan import Ask, Mount, OnFailure, Plan, Read, Step, Turn, Wait
from bench.run.events import EventType
from bench.run.instruments import Instruments
from bench.run.person import RunControl
from bench.run.record import History, Record, read_history
from bench.run.runner import People, Recorder, Runner
from bench.run.workbench import BenchSetup
from drivers.clock import Clock
from drivers.interfaces import Channel, Direction, HeadPosition, Identity, InstrumentLost, VoltmeterSettings
from drivers.person import Answer, Prompt, PromptKind
from sim.world.clock import VirtualClock

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


class Bench:
    """A bench in memory that lists its actions in `done`; after `at` of them, `trouble` is raised once."""

    def __init__(self, trouble: BaseException | None = None, at: int | None = None) -> None:
        self.done: list[tuple[Any, ...]] = []
        self.closed: list[str] = []
        self.trouble = trouble
        self.at = at

    def act(self, *what: object) -> None:
        if self.trouble is not None and len(self.done) == self.at:
            trouble, self.trouble = self.trouble, None
            raise trouble
        self.done.append(what)


class Meter:
    def __init__(self, bench: Bench, channel: Channel, absent: bool = False) -> None:
        self.bench, self.channel, self.absent = bench, channel, absent
        self.channels: tuple[Channel, ...] = (channel,)
        self.name = f"voltmeter.{channel}"
        self.samples = 2

    def open(self) -> Identity:
        if self.absent:
            raise InstrumentLost(self.name, "no answer", "check the cable")
        return Identity("HEWLETT-PACKARD", "34401A")

    def close(self) -> None:
        self.bench.closed.append(self.name)

    def configure(self, settings: VoltmeterSettings) -> None:
        self.bench.act("configure", self.name, settings)
        self.samples = settings.samples

    def start(self) -> None:
        self.bench.act("start", self.name)

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        self.bench.act("fetch", self.name)
        return {self.channel: (1.0, *[2.0] * (self.samples - 1))}


class Head:
    name = "head"

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def open(self) -> Identity:
        return Identity("manual", "head")

    def close(self) -> None:
        self.bench.closed.append(self.name)

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        self.bench.act("move", key)
        return HeadPosition(target_rad + 1e-5, direction)


class Person:
    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def ask(self, prompt: Prompt) -> Answer:
        self.bench.act("ask", prompt.id)
        return Answer(
            prompt.id,
            prompt.default or {"choose": prompt.choices[:1], "confirm": ("yes",)}.get(prompt.kind, ("7",))[0],
        )


class Wishing:
    """A run control that returns or raises `what` at its `at`-th poll, once; None means no wish."""

    def __init__(self, what: RunControl | BaseException | None, at: int = 1) -> None:
        self.what, self.left, self.stopped = what, at, None

    def poll(self) -> RunControl | None:
        self.left -= 1
        if self.left:
            return None
        if isinstance(self.what, BaseException):
            raise self.what
        return self.what


STOP = OnFailure(repeats=0, then="stop")


def make_plan(on_failure: OnFailure = STOP) -> Plan:
    steps: list[Step] = [Wait("w", 3600.0, "warm-up"), Ask("a", PromptKind.NUMBER, "Supply", unit="V")]
    for installation in "12":
        steps.append(Mount(f"m{installation}", installation, 1))
        for point in (1, 2, 3):
            where = (installation, 1, 1, point, 0.5 * point)
            steps.append(Turn(f"t{installation}{point}", *where, 1, STOP))
            steps.append(Wait(f"s{installation}{point}", 5.0, "settling"))
            steps.append(Read(f"r{installation}{point}", *where, 1, 2, 10.0, on_failure))
    return Plan("test", tuple(steps), "")


PLAN = make_plan()
READS = [step.key for step in PLAN.steps if isinstance(step, Read)]
ALL = {"voltmeter.x", "voltmeter.y", "voltmeter.z", "head"}


def instruments(bench: Bench, absent: Collection[str] = ()) -> Instruments:
    return Instruments([Meter(bench, c, c in absent) for c in CHANNELS], Head(bench))


def make_runner(
    bench: Bench, record: Record, plan: Plan = PLAN, absent: Collection[str] = (), **options: Any
) -> Runner:
    return runner_of(plan, instruments(bench, absent), Person(bench), VirtualClock(), record, **options)


def runner_of(
    plan: Plan, having: Instruments, person: Any, clock: Clock, record: Record, **options: Any
) -> Runner:
    """Return a runner; each option goes to its bench, people, recorder or itself, by name."""
    setup = BenchSetup(having, clock, options.pop("range_v", 10.0), **_of(BenchSetup, options))
    people, recorder = People(person, **_of(People, options)), Recorder(record, **_of(Recorder, options))
    return Runner(plan, setup, people, recorder, **options)


def changed(runner: Runner, **options: Any) -> Runner:
    """Return the runner with other options, distributed as in `runner_of`."""
    setup = replace(runner.bench, **_of(BenchSetup, options))
    people = replace(runner.people, **_of(People, options))
    recorder = replace(runner.recorder, **_of(Recorder, options))
    return replace(runner, bench=setup, people=people, recorder=recorder, **options)


def _of(part: type, options: dict[str, Any]) -> dict[str, Any]:
    """Remove the options that are fields of `part`, and return them."""
    return {name: options.pop(name) for name in [f.name for f in fields(part)] if name in options}


def new_record(tmp_path: Path, name: str = "run") -> Record:
    return Record.create(tmp_path / name, {}, {}, lambda: NOON)


def recorded(folder: Path) -> tuple[History, list[str], list[dict[str, Any]]]:
    history = read_history(folder)
    assert history.problems == ()
    done = [e for e in history.events if e.type == "step_done" and "reading" in e.data]
    return history, [e.data["key"] for e in done], [e.data["reading"] for e in done]


def interrupt_at(event: int) -> Any:
    """Return a `Recorder.emit` that raises Ctrl-C once, right after it wrote the event of this number."""
    original = Recorder.emit
    left = [event]

    def emit(self: Recorder, kind: EventType, **data: Any) -> None:
        original(self, kind, **data)
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    return emit
