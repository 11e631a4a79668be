"""The way out: no signal and no failing instrument cuts it short, and the first cause stays what is told."""

import os
import signal
from contextlib import closing

import pytest

from bench.config.procedure.plan import Plan, SetTemperature, Settle, Wait
from bench.run.events import EventType, Wish
from bench.run.expectation import EarlySign
from bench.run.instruments import with_notes
from bench.run.interrupts import SIGNALS, Interrupts
from bench.run.person import OperatorWish, RunControl
from bench.run.record import Record, RecordError, resume_point
from bench.run.runner import Recorder, RunAborted
from drivers.interfaces import BenchError, Identity, InstrumentLost, LimitExceeded, NoAnswer
from drivers.person import Answer
from tests.support.runner_bench import (
    ALL,
    NOON,
    READS,
    Bench,
    Person,
    Wishing,
    changed,
    instruments,
    make_plan,
    make_runner,
    new_record,
    recorded,
)

LOST = InstrumentLost("voltmeter.y", "it is gone", "check the cable")
SIGNALLED = [signal.Signals(number) for number in SIGNALS]


class Chamber:
    name = "chamber"
    asks_person = False

    def __init__(self, bench, refuses=None, trouble=None):
        self.bench, self.refuses, self.trouble = bench, refuses, trouble

    def open(self):
        return Identity("Espec", "P300")

    def close(self):
        self.bench.closed.append(self.name)

    def set_temperature(self, target_c, key):
        if self.refuses is not None:
            raise self.refuses

    def temperature(self, key, *, settling=False):
        return 20.0

    def make_safe(self):
        self.bench.closed.append("standby")
        if self.trouble is not None:
            raise self.trouble
        return ""


def with_chamber(runner, chamber, meter_trouble=None):
    """Put a chamber on the bench of a runner; closing its first meter does what `meter_trouble` does."""
    bench = instruments(chamber.bench)
    close = bench.voltmeters[0].close

    def troubled():
        close()
        meter_trouble()

    if meter_trouble is not None:
        bench.voltmeters[0].close = troubled
    object.__setattr__(bench, "chamber", chamber)
    return changed(runner, instruments=bench)


def hit(*numbers):
    def strike():
        for number in numbers:
            os.kill(os.getpid(), number)

    return strike


def heated(*steps):
    return Plan("test", (SetTemperature("1/temperature", 40.0), *steps, *make_plan().steps), "")


@pytest.mark.parametrize("number", SIGNALLED, ids=lambda number: number.name)
@pytest.mark.parametrize("trouble", [None, LOST, KeyboardInterrupt()], ids=["end", "error", "signal"])
def test_signals_on_the_way_out_cancel_nothing_and_hide_no_cause(tmp_path, capsys, trouble, number):
    bench = Bench(trouble, at=None if trouble is None else 9)
    with closing(new_record(tmp_path)) as record, Interrupts() as interrupts:
        runner = make_runner(bench, record, hold_signals=interrupts.hold)
        runner = with_chamber(runner, Chamber(bench), hit(number, number, signal.SIGINT))
        if trouble is None:
            runner.run()
        else:
            with pytest.raises(type(trouble)):
                runner.run()
        assert interrupts.haste.asked
    assert bench.closed[0] == "standby"
    assert set(bench.closed[1:]) == ALL | {"chamber"}
    history, _, _ = recorded(tmp_path / "run")
    assert history.state == {None: "finished", LOST: "failed"}.get(trouble, "interrupted")
    assert "making the bench safe" in capsys.readouterr().err


@pytest.mark.parametrize(
    "failure", [OSError(5, "Input/output error"), LOST, ZeroDivisionError("x")], ids=repr
)
def test_whatever_an_instrument_raises_the_others_are_let_go_and_the_first_cause_stays(tmp_path, failure):
    bench = Bench(BenchError("voltmeter.z", "it smokes", "pull the plug"), at=9)

    def fail():
        raise failure

    with closing(new_record(tmp_path)) as record:
        runner = with_chamber(make_runner(bench, record, heated()), Chamber(bench, trouble=failure), fail)
        with pytest.raises(BenchError, match="it smokes") as stopped:
            runner.run()
    assert set(bench.closed) == ALL | {"chamber", "standby"}
    assert with_notes(stopped.value) == "voltmeter.z: it smokes; pull the plug"
    history, _, _ = recorded(tmp_path / "run")
    failed, left = [*history.events][-2:]
    assert failed.data["error"] == "voltmeter.z: it smokes; pull the plug"
    to_do = left.data["to_do"]
    assert to_do["chamber"].startswith("is still conditioning at 40 °C: switch it off by hand")
    assert to_do["voltmeter.x"].startswith("could not be released: ")
    assert len(to_do) == 2


@pytest.mark.parametrize(
    ("refuses", "told"),
    [
        (InstrumentLost("chamber", "it is gone", "check the cable"), "is still conditioning at 40 °C"),
        (LimitExceeded("chamber", "40 °C is too hot", "ask for less"), "if it still runs"),
    ],
)
def test_a_demand_that_may_have_been_taken_is_told_and_one_never_sent_is_not(tmp_path, refuses, told):
    bench = Bench()
    with closing(new_record(tmp_path)) as record:
        runner = with_chamber(make_runner(bench, record, heated()), Chamber(bench, refuses, LOST))
        with pytest.raises(BenchError) as stopped:
            runner.run()
    assert with_notes(stopped.value) == str(refuses)
    assert told in [*recorded(tmp_path / "run")[0].events][-1].data["to_do"]["chamber"]


def test_instruments_that_were_opened_before_one_failed_are_let_go(tmp_path):
    bench = Bench()
    with closing(new_record(tmp_path)) as record:
        runner = make_runner(bench, record)
        runner.bench.instruments.voltmeters[1].open = lambda: 1 / 0
        with pytest.raises(ZeroDivisionError):
            runner.run()
    assert set(bench.closed) == ALL
    history, _, _ = recorded(tmp_path / "run")
    assert history.state == "failed"


def test_a_record_that_cannot_be_written_on_the_way_out_does_not_hide_the_cause(tmp_path):
    bench = Bench(LOST, at=9)
    with closing(new_record(tmp_path)) as record:
        runner = with_chamber(make_runner(bench, record), Chamber(bench), lambda: 1 / 0)
        append = record.append

        def full(kind, bench_s, **data):
            if kind == "run_failed":
                raise RecordError("run: cannot be written (no space left on device)")
            return append(kind, bench_s, **data)

        record.append = full
        with pytest.raises(InstrumentLost) as stopped:
            runner.run()
    said = with_notes(stopped.value)
    assert said.startswith(
        f"{LOST}; run: cannot be written (no space left on device); voltmeter.x: could not"
    )
    assert set(bench.closed) == ALL | {"chamber", "standby"}


def test_a_terminal_that_cannot_be_written_to_any_more_stops_no_run(tmp_path):
    bench = Bench()

    def gone(event):
        raise OSError(5, "Input/output error")

    seen = []
    with closing(new_record(tmp_path)) as record:
        make_runner(bench, record, observers=[gone, seen.append]).run()
    _, keys, _ = recorded(tmp_path / "run")
    assert keys == READS
    assert seen[-1].type == "run_finished"


def test_a_signal_while_an_event_cannot_be_written_leaves_the_disk_as_the_cause():
    def write(interrupts):
        with interrupts.shield():
            os.kill(os.getpid(), signal.SIGTERM)
            raise RecordError("disk full")

    with Interrupts() as interrupts, pytest.raises(RecordError, match="disk full"):
        write(interrupts)


# --- back at a temperature --------------------------------------------------------------------------


@pytest.mark.parametrize("stopped_after", ["r11", "s11", "1/wait", "r23"])
def test_a_run_resumed_at_a_temperature_lets_the_block_soak_again(tmp_path, monkeypatch, stopped_after):
    """The chamber was in standby meanwhile. After the last reading at a temperature nothing is waited for."""
    plan = heated(Settle("1/settle", "signals", 1.0, 30.0, 600.0, 10.0), Wait("1/wait", 7200.0, "soak"))
    last = Plan(
        "test", (*plan.steps, SetTemperature("2/temperature", 20.0), Wait("2/wait", 60.0, "soak")), ""
    )
    emit = Recorder.emit

    def stop(self, kind, **data):
        emit(self, kind, **data)
        if kind is EventType.STEP_DONE and data["key"] == stopped_after:
            raise KeyboardInterrupt

    with closing(new_record(tmp_path)) as record, monkeypatch.context() as stopping:
        stopping.setattr(Recorder, "emit", stop)
        bench = Bench()
        with pytest.raises(KeyboardInterrupt):
            with_chamber(make_runner(bench, record, last), Chamber(bench)).run()
    record, history = Record.reopen(tmp_path / "run", lambda: NOON)
    with closing(record):
        bench = Bench()
        runner = make_runner(bench, record, last, progress=history.progress.copy())
        with_chamber(runner, Chamber(bench)).run(resume_point(last, history))
    events = [e for e in recorded(tmp_path / "run")[0].events if e.number > history.events.last.number]
    keys = [e.data["key"] for e in events if e.type == "step_done"]
    first = ["2/temperature"] if stopped_after == "r23" else ["1/settle", "1/wait", "w"]
    assert keys[: len(first)] == first
    assert recorded(tmp_path / "run")[1] == READS


OFF = "x is off"


class Deciding(Person):
    """A person who gives `decisions` on readings in doubt, and then no answer."""

    def __init__(self, bench, *decisions):
        super().__init__(bench)
        self.decisions = [*decisions]

    def ask(self, prompt):
        if not prompt.id.startswith("halt"):
            return super().ask(prompt)
        self.bench.act("ask", "halt")
        if not self.decisions:
            raise NoAnswer("operator", "nobody answered", "answer")
        if isinstance(decision := self.decisions.pop(0), RunControl):
            raise OperatorWish(decision)
        return Answer(prompt.id, decision)


def in_doubt_at(key):
    """Return a watch that finds the first reading at step `key` (its point, of installation 2) off."""
    signs = [EarlySign(OFF, "there", ("x",), (9.0, 0.0, 0.0), 1e-9, ("cable",), 1, confident=True)]

    def watch(reading):
        here = f"r{reading.installation}{reading.point}" == key
        return [signs.pop()] if here and signs else []

    return watch


def stop_in_doubt(tmp_path, plan, key):
    with closing(new_record(tmp_path)) as record:
        bench = Bench()
        runner = make_runner(bench, record, plan, watch=in_doubt_at(key), decider=Deciding(bench))
        with pytest.raises(NoAnswer, match=OFF):
            with_chamber(runner, Chamber(bench)).run()


def decide(folder, plan, *decisions):
    """Resume the run in `folder` with a person who decides; return what was done, in order."""
    record, history = Record.reopen(folder, lambda: NOON)
    with closing(record):
        bench = Bench()
        decider = Deciding(bench, *decisions)
        runner = make_runner(bench, record, plan, progress=history.progress.copy(), decider=decider)
        with_chamber(runner, Chamber(bench)).run(resume_point(plan, history))
    events = [e for e in recorded(folder)[0].events if e.number > history.events.last.number]
    return [
        e.data["key"] if e.type == "step_done" else e.type
        for e in events
        if e.type in {"step_done", "went_on", "redo", "remounted", "run_aborted"}
    ]


@pytest.mark.parametrize(
    ("key", "decisions", "first"),
    [
        ("r21", ["go on it is the cable"], ["went_on", "1/wait", "w", "t22"]),
        ("r21", ["redo point"], ["redo", "1/wait", "w", "t21"]),
        ("r21", [RunControl(Wish.PAUSE, by_person=True), "redo point"], ["redo", "1/wait", "w", "t21"]),
        ("r22", ["mount again"], ["redo", "1/wait", "w", "m2", "t21"]),
        ("r23", ["go on it is the cable"], ["went_on"]),
        ("r23", ["redo point"], ["redo", "1/wait", "w", "t23"]),
    ],
)
def test_a_run_resumed_in_doubt_asks_before_the_block_soaks(tmp_path, key, decisions, first):
    """The question waits for no soak of hours, and a soak is waited for once, if a reading still needs it."""
    plan = heated(Wait("1/wait", 7200.0, "soak"))
    stop_in_doubt(tmp_path, plan, key)
    done = decide(tmp_path / "run", plan, *decisions)
    assert done[: len(first)] == first
    assert done.count("1/wait") == first.count("1/wait")
    assert recorded(tmp_path / "run")[1][-1] == "r23"


def test_a_block_mounted_again_in_a_resumed_run_soaks_once(tmp_path):
    steps = [*make_plan().steps]
    turn = next(i for i, step in enumerate(steps) if step.key == "t13")
    steps[turn:turn] = [SetTemperature("1/temperature", 40.0), Wait("1/wait", 7200.0, "soak")]
    plan = Plan("test", tuple(steps), "")
    stop_in_doubt(tmp_path, plan, "r13")
    done = decide(tmp_path / "run", plan, "mount again")
    assert done[:4] == ["redo", "remounted", "1/wait", "t13"]
    assert done.count("1/wait") == 1


def test_a_run_resumed_in_doubt_and_aborted_does_not_soak(tmp_path):
    plan = heated(Wait("1/wait", 7200.0, "soak"))
    stop_in_doubt(tmp_path, plan, "r21")
    with pytest.raises(RunAborted):
        decide(tmp_path / "run", plan, RunControl(Wish.ABORT, "enough", by_person=True))
    waits = [e for e in recorded(tmp_path / "run")[0].events if e.data.get("key") == "1/wait"]
    assert len(waits) == 2  # begun and done, before the stop


def test_a_block_mounted_again_at_a_temperature_soaks_again(tmp_path):
    bench = Bench()

    class MountedAgain(Wishing):
        def poll(self):
            is_read = ("move", "t13") in bench.done and bench.done[-1][0] == "fetch"
            return super().poll() if is_read else None

    steps = [*make_plan().steps]
    turn = next(i for i, step in enumerate(steps) if step.key == "t13")
    steps[turn:turn] = [SetTemperature("1/temperature", 40.0), Wait("1/wait", 7200.0, "soak")]
    plan = Plan("test", tuple(steps), "")
    with closing(new_record(tmp_path)) as record:
        wish = MountedAgain(RunControl(Wish.MOUNT_AGAIN))
        with_chamber(make_runner(bench, record, plan, controls=wish), Chamber(bench)).run()
    keys = [e.data["key"] for e in recorded(tmp_path / "run")[0].events if e.type == "step_done"]
    again = keys.index("r13") + 1
    assert keys[again : again + 2] == ["1/wait", "t13"]
