"""Whole runs whose questions a living person answers: paused, taken again, stopped, with who it was on record."""

import threading
import time

import pytest

from bench.run import listening
from bench.run.events import RunState, Wish
from bench.run.interrupts import Interrupts
from bench.run.listening import Asker, WishListener
from bench.run.person import (
    ControlFile,
    LeftAnswer,
    OpenPrompt,
    RunControl,
    WishAuthor,
    leave_answer,
    leave_wish,
)
from bench.run.record import Record, read_history, resume_point
from bench.run.runner import RunAborted
from tests.support.runner_bench import NOON, READS, Bench, changed, make_runner, new_record, recorded

ANN = WishAuthor("Ann", "operator", "panel")


class Panel:
    """Somebody who follows the events of a run and answers in its folder; `instead` is done at some questions once.

    An observer of the run, in its thread: what is left is there when the question waits.
    """

    def __init__(self, folder, instead=None):
        self.folder, self.instead = folder, dict(instead or {})
        self.open = OpenPrompt()
        self.seen = []

    def __call__(self, event):
        self.open.take(event)
        if event.type not in {"asked", "wish_refused"} or self.open.prompt is None:
            return  # a refused wish leaves its question open
        prompt = self.open.prompt.prompt
        if event.type == "asked":
            self.seen.append(prompt)
        key = next((key for key in self.instead if prompt.id.startswith(key)), None)
        if key is not None:
            leave_wish(self.folder, RunControl(self.instead.pop(key), "why", who=ANN))
            return
        text = {"confirm": "yes", "number": "7", "choose": (*prompt.choices, "")[0]}[prompt.kind]
        leave_answer(self.folder, LeftAnswer(prompt.id, text, ANN))


@pytest.fixture
def living(tmp_path, monkeypatch):
    """Return what carries out a run of which everything is answered in the folder, and what stopped it."""
    monkeypatch.setattr(listening, "LISTEN_S", 0.001)

    def carry_out(instead=None, bench=None, resumed=False, **options):
        folder = tmp_path / "run"
        bench = bench or Bench()
        wishes = WishListener(ControlFile(folder))
        history = None
        if resumed:
            record, history = Record.reopen(folder, lambda: NOON)
            options["progress"] = history.progress.copy()
        else:
            record = new_record(tmp_path)
        heard = 0 if history is None else history.progress.answers_heard
        asker = Asker(folder, record, lambda kind, data: record.append(kind, 0.0, **data), answers_read=heard)
        with Interrupts() as signals, wishes:
            runner = make_runner(
                bench,
                record,
                asker=asker,
                controls=wishes,
                observers=(Panel(folder, instead),),
                hold_signals=signals.hold,
                **options,
            )
            runner = changed(runner, person=asker)
            try:
                runner.run(None if history is None else resume_point(runner.plan, history))
            except KeyboardInterrupt:
                pass
            finally:
                record.close()
        history, keys, _ = recorded(folder)
        return history, keys

    return carry_out


def told(history, kind):
    return [event.data for event in history.events if event.type == kind]


def test_a_whole_run_is_answered_in_its_folder(living):
    history, keys = living()
    assert keys == READS
    assert history.state is RunState.FINISHED
    assert len(told(history, "asked")) == len(told(history, "answered")) == 3
    assert history.progress.answers_heard == 3
    assert history.progress.asked.prompt is None


def test_a_pause_is_a_question_wherever_it_came_from(living):
    history, keys = living({"m2": Wish.PAUSE})
    assert keys == READS
    assert told(history, "run_paused") == [{"reason": "why", **ANN.to_json()}]
    assert told(history, "run_continued") == [ANN.to_json()]
    assert [asked["id"].partition("@")[0] for asked in told(history, "asked")] == [
        "a#1",
        "m1#1",
        "m2#1",
        "pause",
        "m2#1",
    ]


@pytest.mark.slow
def test_a_wish_at_a_question_takes_the_last_point_again_by_who_had_it(living):
    history, keys = living({"m2": Wish.REPEAT_POINT, "m1": Wish.REPEAT_PASS})
    assert keys == [*READS[:3], READS[2], *READS[3:]]
    (redo,) = told(history, "redo")
    assert (redo["wish"], redo["by"]) == ("redo", "Ann")
    (refused,) = told(history, "wish_refused")  # nothing was measured before the first mounting
    assert (refused["wish"], refused["by"]) == ("redo-pass", "Ann")


def test_stop_at_a_question_leaves_the_run_to_be_resumed_and_the_question_is_put_anew(living, tmp_path):
    history, keys = living({"m2": Wish.STOP})
    assert keys == READS[:3]
    assert history.state is RunState.INTERRUPTED
    assert told(history, "run_interrupted") == [{"reason": "why", **ANN.to_json()}]
    assert history.progress.asked.prompt is None
    late = told(history, "asked")[-1]["id"]
    leave_answer(tmp_path / "run", LeftAnswer(late, "yes", ANN))
    history, keys = living(resumed=True)
    assert keys == READS
    assert [refused["id"] for refused in told(history, "answer_refused")] == [late]
    assert len({asked["id"] for asked in told(history, "asked")}) == len(told(history, "asked"))


def test_stop_is_heard_in_the_middle_of_a_movement(living, tmp_path):
    class Slow(Bench):
        def act(self, *what):
            super().act(*what)
            if what == ("move", "t12"):
                threading.Timer(0.05, leave_wish, (tmp_path / "run", RunControl(Wish.STOP, who=ANN))).start()
                time.sleep(60.0)

    begun = time.monotonic()
    history, keys = living(bench=Slow())
    assert time.monotonic() - begun < 30.0
    assert keys == READS[:1]
    assert told(history, "run_interrupted") == [{"reason": "", **ANN.to_json()}]
    assert read_history(tmp_path / "run").state is RunState.INTERRUPTED


def test_abort_at_a_question_is_for_good(living):
    with pytest.raises(RunAborted):
        living({"m1": Wish.ABORT})
