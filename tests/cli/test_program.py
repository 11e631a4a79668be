"""The program as it is started: Ctrl-C at any moment is a line, and hides no other."""

import os
import signal
import sys

import pytest

from bench.cli import app, program
from bench.run.interrupts import Interrupts
from bench.services.errors import Refused


@pytest.fixture
def handler(monkeypatch):
    """Give the handler back: the program never hears Ctrl-C again once it has ended."""
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(program.os, "_exit", sys.exit)
    monkeypatch.setattr(Interrupts, "any_heard", False)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted():
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_is_a_line_and_later_ones_are_not_heard(handler, monkeypatch, capsys):
    monkeypatch.setattr(app, "main", interrupted)
    with pytest.raises(SystemExit) as end:
        program.main()
    interrupted()
    assert end.value.code == 2
    assert capsys.readouterr().err == "bench: stopped by Ctrl-C\n"


def test_no_signal_takes_the_place_of_a_refusal_on_its_way(handler, monkeypatch, capsys):
    def refused(*arguments):
        raise Refused("interrupted; 3 readings are kept")

    def leave(interrupts, kind, error, trace):
        leave_now(interrupts, kind, error, trace)
        if kind is Refused:
            interrupted()

    leave_now = Interrupts.__exit__
    monkeypatch.setattr(Interrupts, "__exit__", leave)
    monkeypatch.setattr("bench.services.instruments.look_at", refused)
    monkeypatch.setattr(sys, "argv", ["bench", "instruments", "--bench", "paper-stand"])
    with Interrupts(), pytest.raises(SystemExit) as end:  # which gives all handlers back
        program.main()
    assert end.value.code == 2
    assert capsys.readouterr().err == "bench: interrupted; 3 readings are kept\n"


def test_ctrl_c_as_the_program_leaves_changes_neither_status_nor_what_was_said(handler, monkeypatch, capsys):
    def done():
        raise SystemExit(1)

    def set_late(number, what):
        if what is signal.SIG_IGN and late:
            late.pop()
            interrupted()  # just before it is heard no more
        return set_now(number, what)

    set_now, late = signal.signal, [True]
    monkeypatch.setattr(app, "main", done)
    monkeypatch.setattr(program.signal, "signal", set_late)
    with pytest.raises(SystemExit) as end:
        program.main()
    assert end.value.code == 1
    assert capsys.readouterr().err == ""
