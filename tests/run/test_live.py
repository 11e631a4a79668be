"""Signals shown while a person adjusts: what is read and shown, and that a run is the same with and without."""

import io
import json
import math
import os
import pty
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from bench.base.arrays import ARCSEC
from bench.base.languages import speaking
from bench.run import live as live_module
from bench.run.expectation import ExpectedSignals
from bench.run.folder import Run
from bench.run.listening import Asker, WishListener
from bench.run.live import LIVE, LiveSignals, LiveValue
from bench.run.person import ControlFile
from bench.run.terminal import TerminalPerson
from bench.services.execution import carry_out, new_run
from bench.services.requests.measuring import RunRequest
from drivers.interfaces import BadReading, InstrumentLost
from drivers.person import Prompt, PromptKind
from tests.support.pages import ROOT
from tests.support.procedure_texts import HEAD

LOOKS = 2
CIVIL = {"time", "prev"}


class Answering(Asker):
    """A person who looks at the signals, or not, and then answers as a scripted one."""

    def __init__(self, *given, looks):
        super().__init__(*given)
        self.looks, self.seen = looks, []

    def _in_folder(self):
        for _ in range(self.looks):
            self.live.look()
            file = self._answers_folder / LIVE
            if file.exists():
                self.seen.append(json.loads(file.read_text("utf-8")))
        prompt = self._prompt
        if prompt.kind is PromptKind.ANGLE:
            arcsec = round(math.degrees(prompt.action["target_rad"]) * 3600.0) % 1296000 + 5
            return f"{arcsec // 3600} {arcsec // 60 % 60} {arcsec % 60}"
        return {"confirm": "yes", "number": "20"}.get(prompt.kind.value, (*prompt.choices, "")[0])


def run_of(folder, bench, looks):
    procedure = folder.parent / "p.yaml"
    procedure.write_text(
        f"{HEAD}  - installation: {{label: 1, steps: [turn: {{angles: [0 deg, 45 deg, 90 deg, 135 deg]}}]}}\n"
    )
    request = RunRequest(
        str(procedure), bench=str(ROOT / "config" / f"{bench}.yaml"), dry_run=True, seed=4, name="run", runs=folder,
        answers="folder",
    )  # fmt: skip
    new = new_run(request)
    with WishListener(ControlFile(new.folder)) as wishes:
        record = new.record()
        asker = Answering(
            new.folder, record, lambda kind, data: record.append(kind, 0.0, **data), looks=looks
        )
        asker._answers_folder = new.folder
        carry_out(Run(new.folder), record, Console(file=io.StringIO()), wishes=wishes, asker=asker)
    return Run(new.folder), asker


def events(run):
    lines = (run.folder / "events.jsonl").read_text("utf-8").splitlines()
    return [{k: v for k, v in json.loads(line).items() if k not in CIVIL} for line in lines]


# a meter on TCP, one on a serial port (a pseudo-terminal), one behind a GPIB adapter on TCP
@pytest.mark.slow
@pytest.mark.parametrize("bench", ["paper-stand", "bench-rs232", "bench-prologix"])
def test_the_record_of_a_run_is_the_same_with_and_without_live_signals(tmp_path, monkeypatch, bench):
    monkeypatch.setattr(live_module, "LOOK_S", 0.0)
    without, _ = run_of(tmp_path / "without", bench, looks=0)
    looked, asker = run_of(tmp_path / "with", bench, looks=LOOKS)
    assert events(looked) == events(without)
    assert len(asker.seen) >= LOOKS * 4
    assert all(one["signals_v"] is not None for one in asker.seen)
    assert not (looked.folder / LIVE).exists()


# --- the deviation from the commanded angle -------------------------------------------------------------


def expected(u_v=1e-6):
    return ExpectedSignals(np.array([1.0, -2.0, 0.1]), np.array([2.0, 1.0, 0.0]), u_v**2 * np.eye(3))


def test_a_deviation_is_found_with_its_u_by_the_closed_form():
    angle_rad = 14 * ARCSEC
    found, u = expected().deviation_rad(np.array([1.0, -2.0, 0.1]) + angle_rad * np.array([2.0, 1.0, 0.0]))
    assert found == pytest.approx(angle_rad, rel=1e-9)
    assert u == pytest.approx(1e-6 / math.sqrt(5.0), rel=1e-9)


def test_where_no_signal_depends_on_the_angle_nothing_is_known():
    flat = ExpectedSignals(np.zeros(3), np.zeros(3), np.eye(3))
    assert flat.deviation_rad(np.ones(3)) == (0.0, math.inf)


@pytest.mark.parametrize(
    ("off", "words"),
    [
        (-14.0, "14″ to go (± 2″)"),
        (14.0, "14″ too far (± 2″)"),
        (1.5, "there, within 2″"),
        (-600.0, "10.0′ to go (± 2″)"),
        (-150000.0, "more than 1° to go"),
        (None, ""),
    ],
)
def test_the_way_to_go_is_said_as_an_angle(off, words):
    assert LiveValue("1", "", (0.0, 0.0, 0.0), off, 2.0).to_go == words


def test_the_line_speaks_the_language_of_the_prompts():
    value = LiveValue("1", "", (-1.5, 0.25, 2.0), -150000.0, 2.0, settled=False)
    assert value.in_a_line() == ("live: x -1.50000  y +0.25000  z +2.00000 V; more than 1° to go; moving")
    with speaking("uk"):
        assert value.in_a_line() == (
            "наживо: x -1.50000  y +0.25000  z +2.00000 V; лишилося більше ніж 1°; змінюється"
        )


# --- looks ----------------------------------------------------------------------------------------------


class Meter:
    name = "voltmeter.x"


class SlowlySettling:
    """A bench whose signals come to rest; `fails` is raised instead."""

    def __init__(self):
        self.instruments, self.fails, self.looks = SimpleNamespace(voltmeters=[Meter()]), None, 0

    def glance(self):
        if self.fails:
            raise self.fails
        self.looks += 1
        return tuple(np.array([1.0, -2.0, 0.1]) + 0.1 * math.exp(-self.looks))


class Clock:
    def __init__(self):
        self.s = 0.0

    def now_s(self):
        self.s += 0.3
        return self.s


class Plan:
    steps = ()


@pytest.fixture
def looking(tmp_path):
    lines = []
    signals = LiveSignals(tmp_path, Plan(), None, 2.0, lines.append, Clock())
    bench = SlowlySettling()
    signals.attach(bench)
    return signals, bench, lines


def prompt(**action):
    return Prompt("1#1", PromptKind.CONFIRM, "Clamp it", action=action or {"do": "answer"})


def test_signals_have_settled_when_they_have_rested_for_three_seconds(looking, tmp_path):
    signals, _, lines = looking
    signals.begin(prompt())
    for _ in range(40):
        signals.look()
    # they move less than 30 µg · 2 V/g = 60 µV from the 8th look on, and 10 more looks last 3 s
    settled = [number for number, line in enumerate(lines, start=1) if line.endswith("settled")]
    assert settled == list(range(settled[0], 41))
    moving = [number for number, line in enumerate(lines, start=1) if line.endswith("moving")]
    assert moving == list(range(12, settled[0]))  # unknown while 11 samples cover less than 3 s
    assert 16 <= settled[0] <= 21
    assert json.loads((tmp_path / LIVE).read_text("utf-8"))["settled"]
    signals.end()
    assert not (tmp_path / LIVE).exists()


class Noisy:
    """Meters whose quick samples scatter by 100 µV on a head that turns at a steady rate."""

    instruments = SimpleNamespace(voltmeters=())

    def __init__(self, rate_v, seed):
        self.rate_v, self.random, self.looked = rate_v, np.random.default_rng(seed), 0

    def glance(self):
        self.looked += 1
        return tuple(self.rate_v * self.looked + self.random.normal(0.0, 1e-4, 3))


def test_noise_of_a_head_at_rest_is_no_motion_and_hides_none(tmp_path):
    lines = []
    signals = LiveSignals(tmp_path, Plan(), None, 2.0, lines.append, Clock())
    for rate_v in (0.0, 1e-4):  # the second: 12″ a second
        signals.attach(Noisy(rate_v, seed=5))
        signals.begin(prompt())
        for _ in range(200):
            signals.look()
    rest = sum(line.endswith("settled") for line in lines[12:200])
    # 1 % of the windows are beyond the limit by noise; of 17 windows apart, 3 such have p < 0.001
    assert rest >= 188 - 2 * 11
    assert not any(line.endswith("settled") for line in lines[200:])


def test_an_overload_is_said_and_looked_past(looking):
    signals, bench, lines = looking
    bench.fails = BadReading("voltmeter.x", "overload", "check the input")
    signals.begin(prompt())
    signals.look()
    bench.fails = None
    signals.look()
    assert "no valid signal" in lines[0]
    assert lines[1].startswith("live: x +1.")


def test_a_lost_meter_is_said_once_and_stops_no_question(looking):
    signals, bench, lines = looking
    bench.fails = InstrumentLost("voltmeter.x", "does not answer", "check the cable")
    signals.begin(prompt())
    for _ in range(5):
        signals.look()
    assert lines == ["live: voltmeter.x cannot be read now; the next reading tries again"]
    bench.fails = None
    signals.begin(prompt())
    signals.look()
    assert lines[-1].startswith("live: x +")


def test_a_scanner_is_left_alone_and_says_why(looking):
    signals, bench, lines = looking
    bench.instruments.voltmeters[0].not_live = "a scanner's relays wear with every query"
    signals.begin(prompt())
    signals.look()
    signals.look()
    assert bench.looks == 0
    assert lines == ["live: voltmeter.x: a scanner's relays wear with every query"]


def test_at_a_terminal_the_line_stands_above_what_is_typed():
    main, worker = pty.openpty()
    try:
        with os.fdopen(worker, "r+b", buffering=0) as raw:
            answers = io.TextIOWrapper(raw, encoding="utf-8")
            shown = io.StringIO()
            person = TerminalPerson(answers, Console(file=shown, force_terminal=True, width=60))

            def look():
                person.show_live("live: " + 80 * "x")
                os.write(main, b"yes\n")
                person.show_live("too late: the cursor has left the line")

            person.meanwhile = look
            person.slice_s = 0.01
            assert person.ask(prompt()).text == "yes"
            assert "\x1b7\x1b[1A\r\x1b[2K  live: " + 51 * "x" + "\x1b8" in shown.getvalue()
            assert "too late" not in shown.getvalue()
            shown.truncate(0)
    finally:
        os.close(main)


def test_nothing_is_shown_where_answers_come_from_a_file():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO("yes\n"), Console(file=shown))
    person.ask(prompt())
    person.show_live("live")
    assert "live" not in shown.getvalue()
