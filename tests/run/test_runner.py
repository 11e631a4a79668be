"""The runner: each step recorded before the next, each way out leaves the bench closed, no reading twice."""

import contextlib
import dataclasses
from datetime import UTC, datetime

import pytest

from bench.procedure.plan import Ask, Mount, OnFailure, Plan, Read, SetTemperature, Turn, Wait
from bench.readings.reading import Reading, readings_of
from bench.run.control import OperatorWish, RunControl
from bench.run.events import Event
from bench.run.record import Record, RecordError, read_history
from bench.run.resume import Progress, resume_point
from bench.run.runner import RunAborted, Runner
from bench.run.states import HEARD, TRANSITIONS, RunState, Wish, state_after
from bench.run.workbench import Instruments
from drivers.interfaces import (
    Answer,
    BadReading,
    BenchError,
    HeadPosition,
    Identity,
    InstrumentLost,
    LimitExceeded,
    NotConnected,
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


def test_a_run_records_every_step_and_closes_the_bench(tmp_path):
    bench = Bench()
    make_runner(bench, new_record(tmp_path)).run()
    history, keys, rows = recorded(tmp_path / "run")
    assert keys == READS
    assert history.state == "finished"
    assert set(bench.closed) == ALL
    assert [e.data["key"] for e in history.events if e.type == "step_done"] == [s.key for s in PLAN.steps]
    table = readings_of([Reading.from_json(row) for row in rows], "run")
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
        make_runner(again, record, progress=Progress.of(history)).run(resume_point(PLAN, history))
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
    make_runner(Bench(), record, at_resumed_time=told.append, progress=Progress.of(history)).run(point)
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


class Said:
    """Wishes that are left at the n-th time the runner listens."""

    def __init__(self, wishes):
        self.wishes = dict(wishes)
        self.count = -1

    def poll(self):
        self.count += 1
        return self.wishes.pop(self.count, None)


def listening(tmp_path, wishes, person=None, **options):
    """Run with wishes; return the history, the keys read, and the bench."""
    bench = Bench()
    record = new_record(tmp_path)
    runner = make_runner(bench, record, controls=Said(wishes), patience=VirtualClock(), **options)
    if person is not None:
        runner = dataclasses.replace(runner, person=person)
    try:
        runner.run()
    finally:
        record.close()
        history, keys, _ = recorded(tmp_path / "run")
    return history, keys, bench


def poll_at(key, kind="step_done"):
    """Which time the runner listens right after a step of the plan (naps listen, too)."""
    said = Said({})
    at = []
    runner = make_runner(
        Bench(), FakeRecord(lambda k, d: k == kind and d["key"] == key and at.append(said.count))
    )
    runner = dataclasses.replace(runner, controls=said)
    runner.run()
    return at[0] + 1


class FakeRecord:
    def __init__(self, see):
        self.see = see
        self.number = 0

    def append(self, kind, bench_s, **data):
        self.number += 1
        self.see(kind, data)
        return Event(self.number, "", bench_s, kind, data)


def test_redo_takes_the_last_point_again_and_its_last_reading_counts(tmp_path):
    history, keys, bench = listening(tmp_path, {poll_at("r12"): RunControl(Wish.REPEAT_POINT)})
    assert keys == ["r11", "r12", "r12", "r13", "r21", "r22", "r23"]
    attempts = [e.data["attempt"] for e in history.events if e.type == "step_done" and "reading" in e.data]
    assert attempts == [1, 1, 2, 1, 1, 1, 1]
    assert [w[1] for w in bench.done if w[0] == "move"][:4] == ["t11", "t12", "t12", "t13"]


def test_redo_pass_goes_back_to_its_first_turn(tmp_path):
    _, keys, _ = listening(tmp_path, {poll_at("r22"): RunControl(Wish.REPEAT_PASS)})
    assert keys == ["r11", "r12", "r13", "r21", "r22", "r21", "r22", "r23"]


def test_redo_with_nothing_measured_since_the_mounting_is_refused(tmp_path):
    history, keys, _ = listening(tmp_path, {poll_at("m2"): RunControl(Wish.REPEAT_POINT)})
    assert keys == READS
    refused = [e for e in history.events if e.type == "wish_refused"]
    assert refused[0].data["why"] == "no point was measured since the block was mounted"


def test_skip_leaves_the_point_out_with_its_reason(tmp_path):
    history, keys, bench = listening(tmp_path, {poll_at("r11"): RunControl(Wish.SKIP, "cable loose")})
    assert keys == ["r11", "r13", "r21", "r22", "r23"]
    assert ("move", "t12") not in bench.done
    skipped = [e.data for e in history.events if e.type == "skipped"]
    assert skipped[0]["reason"] == "cable loose"
    assert history.state == "finished"


def test_abort_ends_the_run_for_good_with_the_bench_closed(tmp_path):
    with pytest.raises(RunAborted):
        listening(tmp_path, {poll_at("r11"): RunControl(Wish.ABORT, "wrong block")})
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == ["r11"]
    assert history.state is RunState.ABORTED
    assert resume_point(PLAN, history).step > 0


def test_a_pause_lasts_until_somebody_wishes_something_else(tmp_path):
    at = poll_at("r11")
    history, keys, _ = listening(tmp_path, {at: RunControl(Wish.PAUSE), at + 5: RunControl(Wish.CONTINUE)})
    assert keys == READS
    changes = [e.type for e in history.events if e.type.startswith("run_")]
    assert changes == ["run_started", "run_paused", "run_continued", "run_finished"]


def test_redo_out_of_a_pause(tmp_path):
    at = poll_at("r12")
    wishes = {at: RunControl(Wish.PAUSE), at + 3: RunControl(Wish.REPEAT_POINT)}
    history, keys, _ = listening(tmp_path, wishes)
    assert keys == ["r11", "r12", "r12", "r13", "r21", "r22", "r23"]
    assert history.state == "finished"


def test_a_pause_typed_at_the_head_is_asked_how_to_go_on(tmp_path):
    class Typist(Person):
        def ask(self, prompt):
            if prompt.id.startswith("m2") and "typed" not in self.__dict__:
                self.typed = True
                raise OperatorWish(RunControl(Wish.PAUSE, by_person=True))
            return super().ask(prompt)

    bench = Bench()
    history, keys, _ = listening(tmp_path, {}, person=Typist(bench))
    assert keys == READS
    assert [e.type for e in history.events if e.type.startswith("run_")][1:3] == [
        "run_paused",
        "run_continued",
    ]
    assert [w[1].partition("@")[0] for w in bench.done if w[0] == "ask" and "pause" in w[1]] == ["pause"]


@pytest.mark.parametrize(
    ("policy", "failures", "expected"),
    [
        (OnFailure(2, "stop"), 2, "finished"),
        (OnFailure(1, "stop"), 2, "failed"),
        (OnFailure(1, "continue"), 2, "finished"),
    ],
)
def test_a_failed_reading_is_met_as_its_step_says(tmp_path, policy, failures, expected):
    plan = make_plan(policy)
    bench = Bench()
    left = [failures]
    whole = bench.act

    def act(*what):
        if what[0] == "fetch" and len([w for w in bench.done if w[0] == "move"]) == 2 and left[0]:
            left[0] -= 1
            raise BadReading(what[1], "overload", "see the range")
        whole(*what)

    bench.act = act
    record = new_record(tmp_path)
    with contextlib.suppress(BadReading):
        make_runner(bench, record, plan=plan).run()
    record.close()
    history, keys, _ = recorded(tmp_path / "run")
    assert history.state == expected
    failed = [e.data["key"] for e in history.events if e.type == "step_failed"]
    if expected == "failed":
        assert failed == ["r12"]
        assert keys == ["r11"]
    elif policy.then == "continue":
        assert keys == [k for k in READS if k != "r12"]
    else:
        assert failed == ["r12", "r12"]
        assert keys == READS


def test_a_chamber_is_made_safe_on_every_way_out(tmp_path):
    class Chamber:
        name = "chamber"
        asks_person = False

        def __init__(self):
            self.calls = []

        def open(self):
            return Identity("maker", "chamber")

        def close(self):
            self.calls.append("close")

        def set_temperature(self, target_c, key):
            self.calls.append(target_c)

        def temperature(self, key):
            return 23.0

        def make_safe(self):
            self.calls.append("safe")
            return "open the door"

    for name, trouble, at in (
        ("end", None, None),
        ("ctrl-c", KeyboardInterrupt(), 4),
        ("error", BadReading("a", "b", "c"), 4),
    ):
        bench, chamber = Bench(trouble, at), Chamber()
        record = new_record(tmp_path, name)
        runner = make_runner(bench, record)
        together = Instruments(runner.instruments.voltmeters, runner.instruments.head, chamber)
        with contextlib.suppress(KeyboardInterrupt, BadReading):
            dataclasses.replace(runner, instruments=together).run()
        record.close()
        assert chamber.calls[-2:] == ["safe", "close"]
        assert recorded(tmp_path / name)[0].events[-1].data == {"to_do": {"chamber": "open the door"}}


def test_a_block_that_is_too_hot_stops_the_run(tmp_path):
    class Oven:
        name, asks_person = "chamber", False

        def open(self):
            return Identity("maker", "chamber")

        def close(self): ...

        def make_safe(self):
            return ""

        def temperature(self, key):
            return 23.0 if key < "r2" else 75.0

    runner = make_runner(Bench(), new_record(tmp_path), block_limits_c=(-40.0, 60.0))
    together = Instruments(runner.instruments.voltmeters, runner.instruments.head, Oven())
    with pytest.raises(LimitExceeded, match="75 °C"):
        dataclasses.replace(runner, instruments=together).run()
    assert recorded(tmp_path / "run")[1] == ["r11", "r12", "r13"]


def test_the_table_of_transitions_has_no_dead_end_but_the_two_ends():
    reachable = {RunState.READY}
    for _ in RunState:
        reachable |= {after for state in reachable for after in TRANSITIONS[state].values()}
    assert reachable == set(RunState)
    assert {state for state in RunState if not TRANSITIONS[state]} == {RunState.FINISHED, RunState.ABORTED}
    assert set(HEARD) == {RunState.RUNNING, RunState.PAUSED}


@pytest.mark.parametrize("state", list(RunState))
def test_every_transition_leads_where_the_table_says_and_no_other_is_allowed(state):
    ways = {
        RunState.READY: [],
        RunState.RUNNING: ["run_started"],
        RunState.PAUSED: ["run_started", "run_paused"],
        RunState.FINISHED: ["run_started", "run_finished"],
        RunState.FAILED: ["run_started", "run_failed"],
        RunState.INTERRUPTED: ["run_started", "run_interrupted"],
        RunState.ABORTED: ["run_started", "run_aborted"],
    }
    way = ways[state]
    assert state_after(way) is state
    events = {event for row in TRANSITIONS.values() for event in row}
    for event in events:
        if event in TRANSITIONS[state]:
            assert state_after([*way, event]) is TRANSITIONS[state][event]
        elif event == "run_resumed" and state in {RunState.RUNNING, RunState.PAUSED}:
            assert state_after([*way, event]) is state  # its program had died
        else:
            with pytest.raises(ValueError, match="cannot follow"):
                state_after([*way, event])
