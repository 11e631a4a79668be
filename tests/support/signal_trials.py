"""Runs that receive signals: the bench is left safe, the record complete, the cause stated, and nothing hangs.

Every trial is a run by the command line in a separate process, on a bench with a motorised head and a
chamber, served on loopback in real time. SIGINT, SIGTERM and SIGHUP come once, twice or in bursts. They come
at a random moment in the life of the process, when a phase appears in the record, or by closing the terminal.
Phases include the end: a further signal while instruments are made safe, after a signal, an error or the last
step. In some trials an instrument hangs, so that the run ends by an error, or a chamber cannot be reached.

Checked are how long the process takes to end, its status, the text on standard error, and the
record's chain and state. The head must be at rest and the chamber in standby, or the record must say that the
chamber continues to condition.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from bench.config.bench_file.file import load_bench
from bench.model import ForwardModel
from bench.run.assembly.instruments import simulated_instruments, world_of
from bench.run.events import RecordError
from bench.run.interrupts import SIGNALS
from bench.run.record import read_history
from benchmarks.campaign import PROGRAM, ROOT
from sim.bench import SimulatedBench
from sim.wires.faults import Fault, FaultKind
from sim.world.clock import ScaledClock

PROCEDURE: Final = """\
procedure: short
title: Two points while the chamber conditions
reading: {samples: 2, nplc: 1, settle: 0 s}
steps:
  - temperature: {at: 60 degC, soak: 1 s}
  - installation:
      label: 1
      steps:
        - turn: {angles: [90 deg, 0 deg]}
"""
TIMEOUT: Final = "1 s"
LIMIT_S: Final = 30.0
"""Largest time to end, s: the timeouts of instruments that do not respond, on a busy machine."""

PHASES: Final = ("start", "run_started", "temperature", "turn", "read", "run_failed", "run_finished", "any")
"""Phases in which the first signal comes.

They are: the start of the process; the first event or step of this kind in the record; any time during the run or
after it.
"""
PATTERNS: Final[dict[str, tuple[float, ...]]] = {
    "single": (0.0,),
    "double": (0.0, 0.05),
    "late second": (0.0, 0.4),
    "burst": (0.0, 0.0, 0.01, 0.02, 0.05, 0.1, 0.2),
}
TROUBLES: Final = ("none", "none", "none", "meter hangs", "chamber hangs", "terminal closed")


@dataclass(frozen=True)
class Trial:
    """One run: the moment and the kinds of its signals, and any other disturbance."""

    number: int
    phase: str
    pattern: str
    signals: tuple[int, ...]
    delay_s: float
    trouble: str


@dataclass
class Outcome:
    """The outcome of a trial: its violations, and the state of the run."""

    trial: Trial
    violations: list[str] = field(default_factory=list)
    state: str = "not begun"
    too_early: bool = False
    """Whether the signal came before the program's first line, so that Python itself handles Ctrl-C."""


def draw(count: int, seed: int) -> list[Trial]:
    """Draw `count` trials, using the phases and the patterns in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    patterns = list(PATTERNS)
    trials = []
    for number in range(count):
        pattern = patterns[number // len(PHASES) % len(patterns)]
        phase = PHASES[number % len(PHASES)]
        trouble = "meter hangs" if phase == "run_failed" else generator.choice(TROUBLES)
        signals = tuple(generator.choice(SIGNALS) for _ in PATTERNS[pattern])
        delay_s = generator.uniform(0.0, 4.0 if phase == "any" else 0.8 if phase == "start" else 0.2)
        trials.append(Trial(number, phase, pattern, signals, delay_s, trouble))
    return trials


# --- the bench --------------------------------------------------------------------------------------


class Served:
    """A bench served on loopback in real time, its file and procedure in `folder`, and its state."""

    def __init__(self, folder: Path) -> None:
        data = yaml.safe_load((ROOT / "config/bench-motorised.yaml").read_text(encoding="utf-8"))
        having = data["instruments"]
        sections = [*having["voltmeters"], having["head"], having["chamber"]]
        data["instruments"]["head"] |= {"speed": "120 deg/s", "settle": "0.2 s"}
        for section in sections:
            section["timeout"] = TIMEOUT
        self.folder = folder
        self.file = folder / "bench.yaml"
        (folder / "short.yaml").write_text(PROCEDURE, encoding="utf-8")
        self.file.write_text(yaml.safe_dump(data), encoding="utf-8")
        bench = load_bench(self.file)
        self.world = world_of(bench, ForwardModel(bench.installation_models()), 1, ScaledClock())
        self.simulated = SimulatedBench(self.world, simulated_instruments(bench, self.world))
        self._sections = sections
        self._data = data

    @contextmanager
    def standing(self) -> Iterator[Served]:
        """Serve the bench within the context."""
        with self.simulated as simulated:
            names = ["voltmeter.x", "voltmeter.y", "voltmeter.z", "head", "chamber"]
            for section, name in zip(self._sections, names, strict=True):
                section["resource"] = simulated.resources[name]
            self.file.write_text(yaml.safe_dump(self._data), encoding="utf-8")
            yield self

    def conditions(self) -> bool:
        """Whether the chamber is conditioning."""
        return b"STANDBY" not in (self.simulated.dialects["chamber"].handle(b"MODE?", lambda: False) or b"")

    def reset(self) -> None:
        """Remove all faults, and set the chamber to standby."""
        for faulty in self.simulated.faulty.values():
            faulty.clear()
            faulty.device_clear()
        self.simulated.dialects["chamber"].handle(b"MODE,STANDBY", lambda: False)

    def hang(self, name: str) -> None:
        """Let an instrument stop answering."""
        self.simulated.arm(Fault(FaultKind.HANG, at=1, instrument=name))


# --- a trial ----------------------------------------------------------------------------------------


class Process:
    """The program under test, possibly with a `terminal` of its own, which can be closed."""

    def __init__(self, served: Served, name: str, *, terminal: bool) -> None:
        arguments = ["run", "short.yaml", "--bench", "bench.yaml", "--name", name]
        self._master = -1
        self.err = (served.folder / f"{name}.err").open("w+", encoding="utf-8")
        environment = {**os.environ, "XDG_CACHE_HOME": str(served.folder / "cache"), "PYTHONPATH": str(ROOT)}
        options: dict[str, Any] = {"cwd": served.folder, "env": environment, "start_new_session": True}
        if terminal:
            self._master, slave = os.openpty()
            # setsid gives the process no terminal: opened as its first one, it becomes the controlling one
            opened = f"import os; os.open({os.ttyname(slave)!r}, os.O_RDWR); {PROGRAM[2]}"
            command = [PROGRAM[0], "-c", opened, *arguments]
            self.popen = subprocess.Popen(  # noqa: S603 - our own program
                command, stdin=slave, stdout=slave, stderr=self.err, **options
            )
            os.close(slave)
            threading.Thread(target=self._answer, daemon=True).start()
            return
        streams: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
        command = [*PROGRAM, *arguments]
        self.popen = subprocess.Popen(command, stderr=self.err, **streams, **options)  # noqa: S603 - our own
        if self.popen.stdin is not None:
            with suppress(OSError):
                self.popen.stdin.write("yes\n" * 20)
                self.popen.stdin.flush()

    def _answer(self) -> None:
        """Type "yes" at the terminal repeatedly, and read its output."""
        with suppress(OSError, ValueError):
            while self.popen.poll() is None:
                os.write(self._master, b"yes\n")
                time.sleep(0.1)
                os.set_blocking(self._master, False)
                with suppress(BlockingIOError):
                    os.read(self._master, 1 << 16)

    def close_terminal(self) -> None:
        """Close the terminal's window: the system sends SIGHUP, and nothing more can be written."""
        master, self._master = self._master, -1
        with suppress(OSError):
            os.close(master)

    def said(self) -> str:
        """Return the text on standard error."""
        self.err.flush()
        self.err.seek(0)
        return self.err.read()


def shows(events: Path, phase: str) -> bool:
    """Return whether the record contains a phase: an event, or the beginning of a step."""
    with suppress(OSError):
        text = events.read_text(encoding="utf-8", errors="replace")
        return f'"{phase}"' in text or f"/{phase}" in text
    return False


def carry_out(trial: Trial, served: Served) -> Outcome:
    """Carry out a trial: run, send the signals, and judge."""
    outcome, name = Outcome(trial), f"trial-{trial.number}"
    events = served.folder / "runs" / name / "events.jsonl"
    process = Process(served, name, terminal=trial.trouble == "terminal closed")
    wait_for_phase(trial, process.popen, events, served)
    if trial.trouble == "meter hangs" and trial.phase != "run_failed":
        served.hang("voltmeter.y")
    elif trial.trouble == "chamber hangs":
        served.hang("chamber")
    time.sleep(trial.delay_s)
    if trial.trouble == "terminal closed":
        process.close_terminal()
    send(trial, process.popen)
    try:
        process.popen.wait(LIMIT_S)
    except subprocess.TimeoutExpired:
        outcome.violations.append(f"hang: {LIMIT_S:g} s after the first signal it still ran")
        process.popen.kill()
        process.popen.wait()
    judge(outcome, process, served, served.folder / "runs" / name)
    served.reset()
    return outcome


def wait_for_phase(trial: Trial, process: subprocess.Popen[str], events: Path, served: Served) -> None:
    """Wait until the record shows the phase, or the process ends; if the run must fail, let a meter hang."""
    if trial.phase == "start":
        return
    failing = trial.phase == "run_failed"
    awaited = "run_started" if trial.phase == "any" else trial.phase
    while process.poll() is None and not shows(events, awaited):
        if failing and shows(events, "run_started"):
            failing = False
            served.hang("voltmeter.y")
        time.sleep(0.01)


def send(trial: Trial, process: subprocess.Popen[str]) -> None:
    """Send the signals of a trial in its pattern."""
    begun_s = time.monotonic()
    for number, at_s in zip(trial.signals, PATTERNS[trial.pattern], strict=True):
        time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
        if process.poll() is None:
            process.send_signal(number)


def judge(outcome: Outcome, process: Process, served: Served, run: Path) -> None:
    """Note the faults of a process that has ended."""
    said, status = process.said(), process.popen.returncode
    wrong = outcome.violations
    outcome.too_early = "Traceback" in said and "in main" not in said
    if ("Traceback" in said and not outcome.too_early) or "unexpected" in said:
        wrong.append(f"not one of our messages: {said.strip()[-600:]}")
    if served.world.head_rate_rad_s != 0.0:
        wrong.append("the head still turns")
    try:
        history = read_history(run)
    except RecordError:
        history = None
    kinds = [event.type for event in history.events] if history is not None else []
    if history is not None:
        outcome.state = str(history.state) if kinds else "not begun"
        wrong += history.problems
        if history.torn:
            wrong.append("the last line of the record is torn")
    told = json.dumps([event.data for event in [*history.events][-2:]]) if history is not None else ""
    if served.conditions() and not (
        "is still conditioning at 60" in told and "switch it off by hand" in told
    ):
        wrong.append(f"the chamber conditions, and nobody is told: {said.strip()[-300:]}")
    if outcome.state in ("running", "paused"):
        wrong.append(f"the record says that the run is {outcome.state}: {said.strip()[-300:]}")
    by_signal = {-number for number in SIGNALS}
    allowed = {"finished": {0, 2, *by_signal}, "not begun": {2, *by_signal}}.get(outcome.state, {2})
    if outcome.state in ("interrupted", "failed"):
        # a signal while the last message is printed, or later, ends the process as it ends any other
        late = len(outcome.trial.signals) > 1 or "go on with 'bench resume" in said
        allowed = allowed | (by_signal if late else set())
    if status not in allowed and not outcome.too_early:
        wrong.append(f"it ended with {status}, the run is {outcome.state}: {said.strip()[-300:]}")


def worker(trials: Sequence[Trial]) -> list[Outcome]:
    """Carry out trials on one bench, one after the other."""
    with tempfile.TemporaryDirectory() as folder, Served(Path(folder)).standing() as served:
        return [carry_out(trial, served) for trial in trials]
