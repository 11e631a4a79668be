"""A bench in memory, a plan of two installations, and runners over them."""

from datetime import UTC, datetime

from bench.procedure.plan import Ask, Mount, OnFailure, Plan, Read, Turn, Wait
from bench.run.record import Record, read_history
from bench.run.runner import Runner
from bench.run.workbench import Instruments
from drivers.interfaces import (
    Answer,
    HeadPosition,
    Identity,
    InstrumentLost,
    PromptKind,
)
from sim.world.clock import VirtualClock

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


class Bench:
    """A bench in memory that keeps what was done to it; `trouble` raises at the n-th action."""

    def __init__(self, trouble=None, at=None):
        self.done = []
        self.closed = []
        self.trouble = trouble
        self.at = at

    def act(self, *what):
        if self.trouble is not None and len(self.done) == self.at:
            trouble, self.trouble = self.trouble, None
            raise trouble
        self.done.append(what)


class Meter:
    def __init__(self, bench, channel, absent=False):
        self.bench, self.channels, self.absent = bench, (channel,), absent
        self.name = f"voltmeter.{channel}"

    def open(self):
        if self.absent:
            raise InstrumentLost(self.name, "no answer", "check the cable")
        return Identity("HEWLETT-PACKARD", "34401A")

    def close(self):
        self.bench.closed.append(self.name)

    def configure(self, settings):
        self.bench.act("configure", self.name, settings)

    def start(self):
        self.bench.act("start", self.name)

    def fetch(self):
        self.bench.act("fetch", self.name)
        return {self.channels[0]: (1.0, 2.0)}


class Head:
    name = "head"

    def __init__(self, bench):
        self.bench = bench

    def open(self):
        return Identity("manual", "head")

    def close(self):
        self.bench.closed.append(self.name)

    def move(self, target_rad, direction, key):
        self.bench.act("move", key)
        return HeadPosition(target_rad + 1e-5, direction)


class Person:
    def __init__(self, bench):
        self.bench = bench

    def ask(self, prompt):
        self.bench.act("ask", prompt.id)
        return Answer(prompt.id, prompt.default or "7")


STOP = OnFailure(repeats=0, then="stop")


def make_plan(on_failure=STOP):
    steps = [Wait("w", 3600.0, "warm-up"), Ask("a", PromptKind.NUMBER, "Supply", unit="V")]
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


def instruments(bench, absent=()):
    return Instruments([Meter(bench, c, c in absent) for c in "xyz"], Head(bench))


def make_runner(bench, record, plan=PLAN, **options):
    return Runner(
        plan,
        instruments(bench, options.pop("absent", ())),
        Person(bench),
        VirtualClock(),
        record,
        10.0,
        **options,
    )


def new_record(tmp_path, name="run"):
    return Record.create(tmp_path / name, {}, {}, lambda: NOON)


def recorded(folder):
    history = read_history(folder)
    assert history.problems == ()
    done = [e for e in history.events if e.type == "step_done" and "reading" in e.data]
    return history, [e.data["key"] for e in done], [e.data["reading"] for e in done]
