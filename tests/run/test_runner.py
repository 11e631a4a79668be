"""Runs of a plan: carried out, recorded, resumed; states and certificates on the way."""

import contextlib
from functools import reduce

import pytest

from bench.config.procedure.plan import OnFailure, Plan, SetTemperature
from bench.readings.table import Reading, readings_of
from bench.run.events import ENDED, HEARD, TRANSITIONS, RecordError, RunState, state_after_one
from bench.run.instruments import Instruments
from bench.run.person import UNTOUCHED
from bench.run.record import Record, resume_point
from drivers.interfaces import BadReading, BenchError, Identity, LimitExceeded, NotConnected
from drivers.person import Answer
from tests.support.runner_bench import (
    ALL,
    NOON,
    PLAN,
    READS,
    Bench,
    Person,
    changed,
    make_plan,
    make_runner,
    new_record,
    recorded,
)


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
    assert next(iter(history.events)).data["instruments"]["voltmeter.x"] == "HEWLETT-PACKARD 34401A"


def test_all_meters_are_started_before_the_first_is_fetched(tmp_path):
    bench = Bench()
    make_runner(bench, new_record(tmp_path)).run()
    names = [what[0] for what in bench.done if what[0] in {"start", "fetch"}]
    assert names == (["start"] * 3 + ["fetch"] * 3) * 6
    assert sum(what[0] == "configure" for what in bench.done) == 3  # once, not at each reading


@pytest.mark.slow
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
        make_runner(again, record, progress=history.progress.copy()).run(resume_point(PLAN, history))
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
    make_runner(Bench(), record, at_resumed_time=told.append, progress=history.progress.copy()).run(point)
    times = [r["time_s"] for r in recorded(tmp_path / "run")[2]]
    assert told == [point.bench_s]
    assert times == sorted(times)
    assert times[0] >= 3600.0


def test_a_block_that_was_mounted_again_meanwhile_makes_another_visit_of_what_follows(tmp_path):
    """Its readings have the stand errors of a mounting of their own: a number that no mounting of the plan has."""

    class Honest(Person):
        def ask(self, prompt):
            answer = super().ask(prompt)
            return Answer(prompt.id, prompt.choices[-1]) if UNTOUCHED in prompt.choices else answer

    record = new_record(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        make_runner(Bench(KeyboardInterrupt(), 20), record).run()
    record.close()
    record, history = Record.reopen(tmp_path / "run", lambda: NOON)
    runner = make_runner(Bench(), record, progress=history.progress.copy())
    changed(runner, person=Honest(Bench())).run(resume_point(PLAN, history))
    record.close()
    _, keys, rows = recorded(tmp_path / "run")
    assert keys == READS
    assert [row["series"] for row in rows] == [1, 1, 2, 1, 1, 1]  # installation 2 was mounted as planned


def test_every_absent_instrument_is_named_at_once(tmp_path):
    bench = Bench()
    with pytest.raises(NotConnected) as error:
        make_runner(bench, new_record(tmp_path), absent=("x", "z")).run()
    text = str(error.value)
    assert text.startswith("2 instruments: not connected: voltmeter.x: ")
    assert ", voltmeter.z: " in text
    assert text.count(error.value.failures[0].remedy) == 1
    assert set(bench.closed) == ALL
    assert recorded(tmp_path / "run")[0].state == "failed"


def resumed(folder, bench, **options):
    """Go on with a run on a bench; the record is let go however that ends."""
    record, history = Record.reopen(folder, lambda: NOON)
    with contextlib.closing(record):
        make_runner(bench, record, progress=history.progress.copy(), **options).run(
            resume_point(PLAN, history)
        )


@pytest.mark.parametrize("trouble", [KeyboardInterrupt(), BadReading("voltmeter.y", "overload", ""), None])
def test_resumed_with_the_instruments_still_off_a_run_stays_as_it_was(tmp_path, trouble):
    absent, raised = (("x", "y"), NotConnected) if trouble is None else ((), type(trouble))
    with contextlib.closing(new_record(tmp_path)) as record, pytest.raises(raised):
        make_runner(Bench(trouble, 20), record, absent=absent).run()
    before = recorded(tmp_path / "run")
    for _ in range(2):
        with pytest.raises(NotConnected):
            resumed(tmp_path / "run", Bench(), absent=("x", "z"))
        history, keys, _ = recorded(tmp_path / "run")
        assert (history.state, keys) == (before[0].state, before[1])
    assert "voltmeter.z" in history.events.last.data["error"]
    resumed(tmp_path / "run", Bench())
    assert recorded(tmp_path / "run")[1] == READS


def test_a_run_whose_program_was_killed_while_it_was_paused_goes_on_to_its_end(tmp_path):
    with contextlib.closing(new_record(tmp_path)) as record:
        record.append("run_started", 0.0, step=0, instruments={})
        record.append("run_paused", 0.0, reason="")
    resumed(tmp_path / "run", Bench())
    history, keys, _ = recorded(tmp_path / "run")
    assert (history.state, keys) == ("finished", READS)


def test_stopped_at_the_task_to_mount_it_asks_for_that_mounting_and_not_for_the_one_before(tmp_path):
    class Killed(Bench):
        def act(self, *what):
            if what == ("ask", "m2#1"):
                raise KeyboardInterrupt
            super().act(*what)

    with contextlib.closing(new_record(tmp_path)) as record, pytest.raises(KeyboardInterrupt):
        make_runner(Killed(), record).run()
    bench = Bench()
    resumed(tmp_path / "run", bench)
    assert [what for what in bench.done if what[0] == "ask"] == [("ask", "m2#1")]
    assert recorded(tmp_path / "run")[1] == READS


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


def test_a_block_that_is_too_hot_stops_the_run(tmp_path):
    class Oven:
        name, asks_person = "chamber", False

        def open(self):
            return Identity("maker", "chamber")

        def close(self): ...

        def make_safe(self):
            return "open the door"

        def temperature(self, key):
            return 23.0 if key < "r2" else 75.0

    runner = make_runner(Bench(), new_record(tmp_path), block_limits_c=(-40.0, 60.0))
    together = Instruments(runner.bench.instruments.voltmeters, runner.bench.instruments.head, Oven())
    with pytest.raises(LimitExceeded, match="75 °C"):
        changed(runner, instruments=together).run()
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == ["r11", "r12", "r13"]
    assert history.events.last.data == {"to_do": {"chamber": "open the door"}}


def test_the_table_of_transitions_has_no_dead_end_but_the_two_ends():
    reachable = {RunState.READY}
    for _ in RunState:
        reachable |= {after for state in reachable for after in TRANSITIONS[state].values()}
    assert reachable == set(RunState)
    assert {state for state in RunState if not TRANSITIONS[state]} == {RunState.FINISHED, RunState.ABORTED}
    assert set(HEARD) == {RunState.RUNNING, RunState.PAUSED}


def state_after(events):
    return reduce(state_after_one, events, RunState.READY)


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
        else:
            with pytest.raises(ValueError, match="cannot follow"):
                state_after([*way, event])


@pytest.mark.parametrize("stopped", ["run_failed", "run_interrupted"])
@pytest.mark.parametrize("attempt", ["run_failed", "run_interrupted"])
def test_an_attempt_to_go_on_that_fails_leaves_a_run_as_it_was(stopped, attempt):
    """Records that earlier versions wrote so are read as what they are."""
    before = state_after(["run_started", stopped])
    assert state_after(["run_started", stopped, attempt, attempt]) is before
    assert state_after(["run_started", stopped, attempt, "run_resumed"]) is RunState.RUNNING


@pytest.mark.parametrize("state", [state for state in RunState if state not in ENDED])
def test_whatever_a_program_left_a_run_at_another_takes_it_up_or_ends_it(state):
    assert TRANSITIONS[state]["run_resumed"] is RunState.RUNNING
    assert TRANSITIONS[state]["run_aborted"] is RunState.ABORTED


def test_what_is_to_be_said_of_certificates_is_recorded_before_the_first_step(tmp_path):
    asked = []

    def said(serials):
        asked.append(dict(serials))
        return ["the certificate of x is of MY1, but MY2 answered"]

    runner = make_runner(Bench(), new_record(tmp_path), certificates=said)
    meter = runner.bench.instruments.voltmeters[0]
    meter.open = lambda: Identity("K", "34461A", "MY2")
    runner.run()
    serials = {"voltmeter.x": "MY2", "voltmeter.y": "", "voltmeter.z": "", "head": ""}
    assert asked == [serials]
    history, _, _ = recorded(tmp_path / "run")
    first, second, third = list(history.events)[:3]
    assert (first.type, second.type, third.type) == ("run_started", "certificate", "step_started")
    assert second.data["words"] == "the certificate of x is of MY1, but MY2 answered"
    assert history.serials == serials
    assert history.state == "finished"


def test_without_certificates_a_record_is_as_it_was(tmp_path):
    make_runner(Bench(), new_record(tmp_path)).run()
    history, _, _ = recorded(tmp_path / "run")
    assert set(next(iter(history.events)).data) == {"step", "instruments"}
    assert history.serials == {}
