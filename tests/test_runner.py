"""The runner: each step recorded before the next, each way out leaves the bench closed, no reading twice."""

from datetime import UTC, datetime

import pytest

from bench.plan import Ask, Mount, Plan, Read, SetTemperature, Turn, Wait
from bench.record import Record, RecordError, read_history
from bench.resume import resume_point
from bench.run_folder import readings_of
from bench.runner import TRANSITIONS, Instruments, Runner, State
from drivers.interfaces import (
    Answer,
    BadReading,
    BenchError,
    HeadPosition,
    Identity,
    InstrumentLost,
    NotConnected,
    PromptKind,
)
from sim.clock import VirtualClock

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


def make_plan():
    steps = [Wait("w", 3600.0, "warm-up"), Ask("a", PromptKind.NUMBER, "Supply", unit="V")]
    for installation in "12":
        steps.append(Mount(f"m{installation}", installation, 1))
        for point in (1, 2, 3):
            where = (installation, 1, 1, point, 0.5 * point)
            steps.append(Turn(f"t{installation}{point}", *where, 1))
            steps.append(Wait(f"s{installation}{point}", 5.0, "settling"))
            steps.append(Read(f"r{installation}{point}", *where, 1, 2, 10.0))
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


def test_a_run_records_every_step_and_closes_the_bench(tmp_path):
    bench = Bench()
    make_runner(bench, new_record(tmp_path)).run()
    history, keys, rows = recorded(tmp_path / "run")
    assert keys == READS
    assert history.state == "finished"
    assert set(bench.closed) == ALL
    assert [e.data["key"] for e in history.events if e.type == "step_done"] == [s.key for s in PLAN.steps]
    table = readings_of(rows, "run")
    assert table.signal.tolist() == [[1.5, 1.5, 1.5]] * 6
    assert table.angle_rad == pytest.approx([p * 0.5 + 1e-5 for p in (1, 2, 3)] * 2, abs=1e-11)
    assert history.events[0].data["instruments"]["voltmeter.x"] == "HEWLETT-PACKARD 34401A"


def test_all_meters_are_started_before_the_first_is_fetched(tmp_path):
    bench = Bench()
    make_runner(bench, new_record(tmp_path)).run()
    names = [what[0] for what in bench.done if what[0] in {"start", "fetch"}]
    assert names == (["start"] * 3 + ["fetch"] * 3) * 6
    assert sum(what[0] == "configure" for what in bench.done) == 3  # once, not at each reading


@pytest.mark.parametrize("trouble", [KeyboardInterrupt(), BadReading("voltmeter.y", "overload", "see range")])
def test_stopped_at_any_action_and_resumed_it_ends_with_every_reading_once(tmp_path, trouble):
    undisturbed = Bench()
    make_runner(undisturbed, new_record(tmp_path, "whole")).run()
    _, _, expected = recorded(tmp_path / "whole")
    for at in range(len(undisturbed.done)):
        folder = tmp_path / f"run{at}"
        record = new_record(tmp_path, folder.name)
        bench = Bench(trouble, at)
        with pytest.raises(type(trouble)):
            make_runner(bench, record).run()
        record.close()
        assert set(bench.closed) == ALL
        state = recorded(folder)[0].state
        assert state == ("interrupted" if isinstance(trouble, KeyboardInterrupt) else "failed")

        record, history = Record.reopen(folder, lambda: NOON)
        again = Bench()
        make_runner(again, record).run(resume_point(PLAN, history))
        record.close()
        history, keys, rows = recorded(folder)
        assert history.state == "finished"
        assert keys == READS
        assert [r["angle_deg"] for r in rows] == [r["angle_deg"] for r in expected]
        # an unfinished point begins with its turn again: never a reading without one before it
        kinds = [what[0] for what in again.done if what[0] in {"move", "start"}]
        assert kinds == ["move", "start", "start", "start"] * (len(kinds) // 4)


def test_a_resumed_run_counts_bench_time_on(tmp_path):
    record = new_record(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        make_runner(Bench(KeyboardInterrupt(), 20), record).run()
    record.close()
    record, history = Record.reopen(tmp_path / "run", lambda: NOON)
    point = resume_point(PLAN, history)
    assert point.bench_s >= 3600.0
    told = []
    make_runner(Bench(), record, at_resumed_time=told.append).run(point)
    times = [r["time_s"] for r in recorded(tmp_path / "run")[2]]
    assert told == [point.bench_s]
    assert times == sorted(times)
    assert times[0] >= 3600.0


def test_every_absent_instrument_is_named_at_once(tmp_path):
    bench = Bench()
    with pytest.raises(NotConnected) as error:
        make_runner(bench, new_record(tmp_path), absent=("x", "z")).run()
    assert "voltmeter.x" in str(error.value)
    assert "voltmeter.z" in str(error.value)
    assert set(bench.closed) == ALL
    assert recorded(tmp_path / "run")[0].state == "failed"


def test_a_full_disk_stops_the_run_with_the_bench_closed(tmp_path, monkeypatch):
    record = new_record(tmp_path)
    bench = Bench()
    whole = record.append

    def append(kind, bench_s, **data):
        if data.get("key") == "s12":
            raise RecordError("disk full")
        return whole(kind, bench_s, **data)

    monkeypatch.setattr(record, "append", append)
    with pytest.raises(RecordError, match="disk full"):
        make_runner(bench, record).run()
    assert set(bench.closed) == ALL
    assert recorded(tmp_path / "run")[1] == ["r11"]


def test_a_temperature_without_a_chamber_is_refused(tmp_path):
    plan = Plan("hot", (SetTemperature("t", 50.0),), "")
    with pytest.raises(BenchError, match="has no chamber"):
        make_runner(Bench(), new_record(tmp_path), plan=plan).run()


def test_the_table_of_transitions_has_no_dead_end_but_the_two_ends():
    reachable = {State.READY}
    for _ in State:
        reachable |= {after for state in reachable for after in TRANSITIONS[state].values()}
    assert reachable == set(State)
    assert {state for state in State if not TRANSITIONS[state]} == {State.FINISHED, State.ABORTED}
