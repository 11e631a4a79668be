"""Signals: held back while an event is written, heard once, real ones against a real process."""

import os
import shutil
import signal
import subprocess
import time
import weakref
from pathlib import Path

import numpy as np
import pytest

from bench.run.folder import Run
from bench.run.interrupts import SIGNALS, Interrupts, stopped_by
from bench.run.record import read_history
from benchmarks.campaign import PROGRAM
from tests.support.commands import refused
from tests.support.pages import ROOT
from tests.support.patience import PATIENCE_S, wait_for

LONG = """\
procedure: long
title: Many passes
reading: {samples: 10, nplc: 10, settle: 10 s}
steps:
  - installation:
      label: 1
      steps:
        - repeat: {times: 40, steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]}
"""


def test_a_signal_within_the_shield_is_heard_at_its_end():
    done = []
    with Interrupts() as interrupts, pytest.raises(KeyboardInterrupt):  # noqa: PT012
        with interrupts.shield():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("whole")
        done.append("not reached")
    assert done == ["whole"]


def test_sigterm_is_heard_like_ctrl_c_and_a_second_signal_does_not_cut_the_way_out(capsys):
    with Interrupts():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
    assert "making the bench safe" in capsys.readouterr().err


def test_one_that_is_heard_while_the_bench_is_left_safe_stops_what_comes_after():
    with Interrupts() as interrupts:
        interrupts.hold()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupts.haste.asked
        with pytest.raises(KeyboardInterrupt):
            interrupts.release("stopped")


def test_when_the_bench_is_safe_a_second_signal_ends_the_program_at_once(capsys):
    ended = []
    with Interrupts(end=ended.append) as interrupts:
        interrupts.hold()
        interrupts.release("stopped before the results were ready")
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):  # the stand-in for the end of the program goes on
                os.kill(os.getpid(), signal.SIGTERM)
    assert ended == [2]
    assert capsys.readouterr().err == "bench: stopped before the results were ready\n"


@pytest.mark.parametrize("number", SIGNALS)
def test_an_error_on_its_way_to_be_told_is_hidden_by_no_signal(number):
    with Interrupts():
        with pytest.raises(ValueError, match="why"), Interrupts():
            raise ValueError("why")
        os.kill(os.getpid(), number)
    with Interrupts(), pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), number)


class Hit:
    """Is hit by Ctrl-C where Python drops what is raised: as it is deleted."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)


def hit_in_callback():
    thing = set()
    watched.append(weakref.ref(thing, lambda reference: os.kill(os.getpid(), signal.SIGINT)))
    return thing


watched = []


@pytest.mark.parametrize("dropping", [Hit, hit_in_callback])
@pytest.mark.parametrize("released", [True, False])
def test_a_signal_that_python_would_drop_is_raised_again(capsys, dropping, released):
    with Interrupts() as interrupts, pytest.raises(KeyboardInterrupt):  # noqa: PT012
        if released:
            interrupts.release("stopped")
        kept = dropping()
        del kept
        time.sleep(30.0)  # until the signal
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_at_a_question_before_the_run_goes_on_is_named_and_the_way_to_resume(
    bench, monkeypatch, number
):
    shutil.copytree(ROOT / "tests/data/records/interrupted", "runs/one")
    monkeypatch.setattr(Interrupts, "heard", 0)
    monkeypatch.setattr("bench.services.execution.accept_changes", lambda *_: os.kill(os.getpid(), number))
    name = "SIGTERM" if number == signal.SIGTERM else "Ctrl-C"
    refused(
        bench("resume", "one"), f"stopped by {name}; ", "kept in runs/one; resume with 'bench resume one'"
    )
    assert stopped_by() == f"stopped by {name}"


def test_the_handlers_are_given_back():
    before = signal.getsignal(signal.SIGINT)
    with Interrupts():
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow(8)
def test_hit_by_a_signal_killed_and_resumed_it_ends_as_if_nothing_had_been(bench, tmp_path):
    """SIGTERM, then SIGKILL to what resumed it, each while the run is under way; the wire and the disk are real."""
    (tmp_path / "long.yaml").write_text(LONG.replace("times: 40", "times: 3"))
    run = ("run", "long.yaml", "--dry-run", "--seed", "3", "--name")
    assert bench(*run, "whole")[0] == 0
    whole = Run(tmp_path / "runs/whole").readings()
    events = tmp_path / "runs/hit/events.jsonl"

    def begun(size, *arguments):
        process = subprocess.Popen(  # noqa: S603 - our own program
            [*PROGRAM, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        wait_for(lambda: events.exists() and events.stat().st_size > size, process)
        return process

    def left(process, state):
        _, err = process.communicate(timeout=PATIENCE_S)
        history = read_history(tmp_path / "runs/hit")
        assert (history.state, history.problems) == (state, ())
        assert len(Run(tmp_path / "runs/hit").readings()) >= 5
        return process.returncode, err

    process = begun(12_000, *run, "hit")
    process.terminate()
    status, err = left(process, "interrupted")
    assert status == 2
    assert "readings are kept in runs/hit; resume with 'bench resume hit'" in err
    assert "Traceback" not in err
    process = begun(30_000, "resume", "hit")
    process.kill()
    left(process, "running")
    assert bench("resume", "hit")[0] == 0
    run = Run(tmp_path / "runs/hit")
    assert run.history.state == "finished"
    steps = [e.data["step"] for e in run.history.events if "reading" in e.data]
    assert len(steps) == len(set(steps)) == len(whole)
    for column in ("signal", "angle_rad", "time_s"):
        assert np.array_equal(getattr(run.readings(), column), getattr(whole, column))


@pytest.mark.slow(5)
def test_a_run_is_paused_and_aborted_from_another_program(bench, tmp_path):
    # so long that it is not over before another program, on a machine however slow, has been heard
    (tmp_path / "long.yaml").write_text(LONG.replace("times: 40", "times: 150"))
    process = subprocess.Popen(  # noqa: S603 - our own program
        [*PROGRAM, "run", "long.yaml", "--dry-run", "--name", "hit"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    events = Path(tmp_path / "runs/hit/events.jsonl")

    def wait_for_event(text):
        wait_for(lambda: events.exists() and text in events.read_text(), process)

    wait_for_event("step_done")
    assert bench("control", "hit", "pause")[0] == 0
    wait_for_event("run_paused")
    size = events.stat().st_size
    assert bench("control", "hit", "skip")[0] == 2
    assert events.stat().st_size == size
    assert bench("control", "hit", "abort", "wrong block")[0] == 0
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "aborted: wrong block" in err
    assert read_history(tmp_path / "runs/hit").state == "aborted"
    status, _, err = bench("control", "hit", "pause")
    assert (status, "no program is carrying out this run" in err) == (2, True)
