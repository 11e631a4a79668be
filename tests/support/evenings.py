"""No sequence of commands, failures and kills ever loses a record of a run.

A state machine (hypothesis) starts from an empty folder and uses `run`, `resume`, `abort`, `calibrate`, `report`,
`export`, `seal` and the panel's buttons. The bench has three voltmeters served on loopback and a head that a person
turns. A meter may be off, fail during a run, and return. A command may be interrupted by Ctrl-C or SIGTERM,
stopped, paused or aborted from the panel, or killed: its record then ends at any byte after its previous end, and
results are missing.

After every step: each record only grew and `show --verify` succeeds; no record has a reading twice; every command
that the program recommends is possible; and if all meters are on, `resume` completes a run with all its results.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import queue
import re
import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final
from unittest import mock

import yaml
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from bench.config.bench_file.file import load_bench
from bench.config.procedure.steps import Read
from bench.model import ForwardModel
from bench.panel import launching
from bench.panel.access import Role
from bench.panel.launching import Started
from bench.run import listening
from bench.run.assembly.instruments import simulated_instruments, world_of
from bench.run.events import ENDED, EVENTS, MANIFEST, Event, RunState
from bench.run.folder import RESULTS, Run
from bench.run.person import OpenPrompt
from bench.run.record import Record
from bench.services.execution import taken_up
from benchmarks.campaign import ROOT, Said, command
from sim.bench import SimulatedBench
from sim.world.clock import ScaledClock
from tests.support.answering import answer_to
from tests.support.panel_client import Browser

METERS: Final = ("voltmeter.x", "voltmeter.y", "voltmeter.z")
PROCEDURE: Final = """\
procedure: short
title: Three points in two installations
reading: {samples: 2, nplc: 1, settle: 0 s}
steps:
  - installation: {label: 1, steps: [turn: {angles: [0 deg, 90 deg, 180 deg]}]}
  - installation: {label: 2, steps: [turn: {angles: [0 deg, 90 deg, 180 deg]}]}
"""
SPEED: Final = 1000.0
"""Factor by which the meters' clock runs faster, so that readings take no time."""
STOPPED: Final = 2
OK: Final = 200
LOOK_S: Final = 0.01
MOST_LOOKS: Final = 1000
_NAMED: Final = re.compile(r"'bench resume (\S+)'")


class Process:
    """A substitute for the process that the panel starts: the command is carried out in the main thread."""

    status: int | None = None

    def poll(self) -> int | None:
        """Return the exit status, None while the command runs."""
        return self.status


class Desk:
    """A bench, a folder of runs, a terminal and a panel, in this process.

    `kept` are the complete lines of each record at the last check.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.runs = folder, folder / "runs"
        data = yaml.safe_load((ROOT / "config/bench-lan.yaml").read_text(encoding="utf-8"))
        data["instruments"]["head"]["enter_accepts_target"] = True
        self.bench = folder / "bench.yaml"
        self.bench.write_text(yaml.safe_dump(data), encoding="utf-8")
        (folder / "short.yaml").write_text(PROCEDURE, encoding="utf-8")
        file = load_bench(self.bench)
        world = world_of(file, ForwardModel(file.installation_models()), 1, ScaledClock(SPEED))
        self.served = SimulatedBench(world, simulated_instruments(file, world))
        self._data = data
        self._asked = OpenPrompt()
        self._answer, self._events, self._away = "", 0, False
        self._trouble, self._at = "", 0
        self.kept: dict[str, bytes] = {}
        self._checked: dict[str, bytes] = {}
        self.off: set[str] = set()
        self.after: str = ""

    @contextlib.contextmanager
    def open(self) -> Iterator[Desk]:
        """Serve the instruments, and replace the program's terminal and its access to records by this object."""
        with ExitStack() as stack:
            stack.enter_context(self.served)
            for section, name in zip(self._data["instruments"]["voltmeters"], METERS, strict=True):
                section["resource"] = self.served.resources[name]
            self.bench.write_text(yaml.safe_dump(self._data), encoding="utf-8")
            stack.enter_context(contextlib.chdir(self.folder))
            cache = {"XDG_CACHE_HOME": str(self.folder / "cache")}
            stack.enter_context(mock.patch.dict(os.environ, cache))
            append = Record.append

            def followed(record: Record, kind: str, bench_s: float, /, **data: Any) -> Event:
                with record._shield():
                    event = append(record, kind, bench_s, **data)
                    self._follow(record.folder.name, event)
                return event

            stack.enter_context(mock.patch.object(Record, "append", followed))
            stack.enter_context(mock.patch.object(listening, "LISTEN_S", 0.002))
            self.browser = Browser(self.runs, "anna", Role.OPERATOR)
            stack.enter_context(self.browser.client)  # one event loop, in which the panel follows runs
            yield self

    # --- actions -----------------------------------------------------------------------------------------

    def command(self, *arguments: object, trouble: str = "", at: int = 0) -> Said:
        """Type a command, which is disturbed by `trouble` at its `at`-th event."""
        before = self._lines()
        self._trouble, self._at, self._events, self._asked = trouble, at, 0, OpenPrompt()
        self._away = f"--answers={launching.ANSWERS}" in arguments
        said = command(*arguments, stdin=Typist(self))
        self._trouble = ""
        if trouble in {"kill", "results"}:
            self._killed(before, at, results=trouble == "results")
        self.after = f"{' '.join(map(str, arguments))} [{trouble} {at}]: {said.status} {said.text[-400:]}"
        return said

    def press(self, name: str, button: str, *, trouble: str = "", at: int = 0) -> Said:
        """Press a button of the panel; the program that it starts is carried out here, as a process would be."""
        started: queue.Queue[tuple[Sequence[str], Process] | None] = queue.Queue()
        replies: list[tuple[int, dict[str, Any]]] = []

        def start(arguments: Sequence[str], log: Path, role: str = "") -> Started:
            process = Process()
            started.put((arguments, process))
            return Started(process, log)  # type: ignore[arg-type]

        def pressed() -> None:
            try:
                replies.append(self.browser.ask(f"/runs/{name}/{button}"))
            finally:
                started.put(None)

        said = Said(0, "")
        with mock.patch.object(launching, "start", start):
            thread = threading.Thread(target=pressed)
            thread.start()
            if (begun := started.get()) is not None:
                said = self.command(*begun[0], trouble=trouble, at=at)
                begun[1].status = said.status
            thread.join()
        status, reply = replies[0]
        self.after = f"{button} {name}: {status} {reply}; {self.after if begun else ''}"
        return said if status == OK else Said(status, json.dumps(reply))

    def switch(self, meter: str) -> None:
        """Switch a meter off, or on again."""
        server = self.served.servers[meter]
        if meter in self.off:
            server.accept_again()
        else:
            server.stop()
        self.off ^= {meter}

    # --- disturbances ------------------------------------------------------------------------------------

    def _follow(self, name: str, event: Event) -> None:
        """Follow the events of a run: answer its questions, and apply the disturbance of the command."""
        self._events += 1
        self._asked.take(event)
        if self._events == self._at:
            self._strike(name)
        if event.type == "asked" and self._asked.prompt is not None:
            prompt = self._asked.prompt.prompt
            self._answer = prompt.default or answer_to(prompt)
            self._do(prompt.action)
            if self._away:
                self._answer_at_panel(name, prompt.id)

    def _answer_at_panel(self, name: str, prompt_id: str) -> None:
        """Answer at the panel, which may show the question a moment later."""
        for _ in range(MOST_LOOKS):
            status, reply = self.browser.ask(f"/runs/{name}/answer", id=prompt_id, text=self._answer)
            if status == OK:
                return
            time.sleep(LOOK_S)
        raise TimeoutError(f"{name}: {prompt_id} cannot be answered at the panel: {reply}")

    def _do(self, action: Any) -> None:
        """Carry out a task of the operator at the simulated bench."""
        if action["do"] == "mount":
            self.served.world.mount(action["installation"], action["series"])
        elif "target_rad" in action:
            self.served.world.turn(action["target_rad"], action["direction"])

    def _strike(self, name: str) -> None:
        match self._trouble:
            case "ctrl-c":
                signal.raise_signal(signal.SIGINT)
            case "sigterm":
                signal.raise_signal(signal.SIGTERM)
            case "meter off" if METERS[1] not in self.off:
                self.switch(METERS[1])
            case "stop" | "pause" | "abort" as wish:
                self.browser.ask(f"/runs/{name}/control", do="take")
                self.browser.ask(f"/runs/{name}/wish", wish=wish, reason="campaign")

    def typed(self) -> str:
        """Return the next line typed at the terminal."""
        return f"{self._answer}\n"

    def _killed(self, before: dict[str, bytes], at: int, *, results: bool) -> None:
        """Leave the run in progress as SIGKILL would: its record ends at any byte, and some results are missing."""
        for name, content in self._lines().items():
            grown = len(content) - len(before.get(name, b""))
            finished = b'"run_finished"' in content
            if results and not (finished and (self.runs / name / RESULTS).exists()):
                continue
            if not results and not grown:
                continue
            if not results:
                # a power cut may remove more, but no older content
                os.truncate(self.runs / name / EVENTS, len(content) - grown + at * 7919 % grown)
            for made in ("verify.json", "report.html", "calibrate.json")[: 1 + at % 3]:
                (self.runs / name / made).unlink(missing_ok=True)
            (self.runs / name / RESULTS).write_text('{"made": null}')
            self.kept[name] = _whole(self._lines()[name])

    def _lines(self) -> dict[str, bytes]:
        found = self.runs.glob(f"*/{MANIFEST}")
        return {manifest.parent.name: manifest.with_name(EVENTS).read_bytes() for manifest in found}

    # --- checks ------------------------------------------------------------------------------------------

    def check(self) -> list[str]:
        """Return sentences on all faults at present."""
        wrong = []
        for name, content in self._lines().items():
            if not content.startswith(self.kept.get(name, b"")):
                wrong.append(f"{name}: what was on record is there no more")
            if content != self._checked.get(name):
                wrong += self._check_run(name)
            self._checked[name] = self._lines()[name]
            self.kept[name] = _whole(self._checked[name])
        for name in set(self.kept) - set(self._lines()):
            wrong.append(f"{name}: the run is gone")
        for name in _NAMED.findall(self.after):
            wrong += self._recommended(name)
        return [f"{text} (after {self.after})" for text in wrong]

    def _check_run(self, name: str) -> list[str]:
        run = Run(self.runs / name)
        wrong = [*run.history.problems]
        taken = [e for e in run.history.events if e.type == "step_done" and "reading" in e.data]
        steps = Counter(event.step for event in taken)
        wrong += [f"step {step} was read {times} times" for step, times in steps.items() if times > 1]
        planned = {index for index, step in enumerate(run.plan.steps) if isinstance(step, Read)}
        if run.history.state is RunState.FINISHED and set(steps) != planned:
            wrong.append(f"finished with {len(steps)} of {len(planned)} readings")
        after = self.after
        shown = self.command("show", name, "--verify", "--json", "-")
        self.after = after
        if shown.status != 0:
            wrong.append(f"show --verify: {shown.status} {shown.text[-200:]}")
        else:
            (told,) = [json.loads(shown.text)]
            if told["state"].startswith("damaged"):
                wrong.append(told["state"])
            wrong += self._recommended(name) if "resume" in told["to_go_on"] else []
        return [f"{name}: {text}" for text in wrong]

    def _recommended(self, name: str) -> list[str]:
        """Return faults if a run cannot be resumed although the program recommends it."""
        try:
            record, _ = taken_up(Run(self.runs / name), results_too=True)
        except Exception as error:
            return [f"{name}: resume is recommended, and refused: {error}"]
        record.close()
        return []

    def names(self) -> list[str]:
        """Return the names of the existing runs."""
        return sorted(self._lines())


def _whole(content: bytes) -> bytes:
    """Return the complete lines of a record, whose last line may be cut off."""
    return content[: content.rfind(b"\n") + 1]


class Typist(io.StringIO):
    """A simulated keyboard: each line that it types answers the open question."""

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self._desk = desk

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        return self._desk.typed()


AT_MOST: Final = 4
"""Largest number of runs in a folder; further steps use one of these runs."""

TROUBLES: Final = (
    "", "", "", "ctrl-c", "sigterm", "meter off", "kill", "kill", "stop", "pause", "abort", "results",
)  # fmt: skip
"""Disturbances of a command at one of its events; "results" kills it while the results are made."""


# --- the state machine ------------------------------------------------------------------------------

RUNS: Final = st.integers(0, AT_MOST - 1)
TROUBLE: Final = st.sampled_from(TROUBLES)
AT: Final = st.integers(1, 70)


class Evenings(RuleBasedStateMachine):
    """A state machine: actions at a bench in any order."""

    def __init__(self) -> None:
        super().__init__()
        self._stack, self._begun = ExitStack(), 0
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        self.desk = self._stack.enter_context(Desk(folder).open())

    def teardown(self) -> None:
        self._stack.close()

    def _judge(self, *further: str) -> None:
        """Raise `AssertionError` with all faults after a step."""
        wrong = [*further, *self.desk.check()]
        if wrong:
            raise AssertionError("\n".join(wrong))

    def _name(self, which: int) -> str:
        return (names := self.desk.names())[which % len(names)]

    def _state(self, name: str) -> RunState:
        return Run(self.desk.runs / name).history.state

    @initialize(trouble=TROUBLE, at=AT)
    def begin(self, trouble: str, at: int) -> None:
        self.run(trouble, at)

    @rule(trouble=TROUBLE, at=AT)
    def run(self, trouble: str, at: int) -> None:
        if len(self.desk.names()) >= AT_MOST:  # the oldest run is moved away
            shutil.rmtree(self.desk.runs / (oldest := self.desk.names()[0]))
            del self.desk.kept[oldest]
        self._begun += 1
        name = f"n{self._begun:06d}"
        words = ("run", "short.yaml", "--bench", "bench.yaml", "--name", name)
        said = self.desk.command(*words, trouble=trouble, at=at)
        self._judge(*_amiss(said))

    @rule(which=RUNS, trouble=TROUBLE, at=AT)
    def resume(self, which: int, trouble: str, at: int) -> None:
        said = self.desk.command("resume", self._name(which), trouble=trouble, at=at)
        self._judge(*_amiss(said))

    @rule(trouble=TROUBLE, at=AT)
    def resume_latest(self, trouble: str, at: int) -> None:
        said = self.desk.command("resume", trouble=trouble, at=at)
        self._judge(*_amiss(said))

    @rule(which=RUNS, trouble=TROUBLE, at=AT)
    def press_resume(self, which: int, trouble: str, at: int) -> None:
        said = self.desk.press(self._name(which), "resume", trouble=trouble, at=at)
        self._judge(*_amiss(said))

    @rule(which=RUNS)
    def bring_to_its_end(self, which: int) -> None:
        """With all meters on, follow the recommendations: the run must end with all its results."""
        for meter in [*self.desk.off]:
            self.desk.switch(meter)
        name = self._name(which)
        state = self._state(name)
        if state is RunState.ABORTED:
            return
        before = state is RunState.FINISHED and not Run(self.desk.runs / name).results_missing
        said = self.desk.command("resume", name)
        wrong = _amiss(said)
        if self._state(name) is not RunState.FINISHED or Run(self.desk.runs / name).results_missing:
            wrong.append(f"{name}: was {state}, and resume did not bring it to its end: {said.text[-300:]}")
        if (said.status == STOPPED) != before:
            wrong.append(f"{name}: was {state}, and resume ended with {said.status}: {said.text[-300:]}")
        self._judge(*wrong)

    @rule(which=RUNS, panel=st.booleans())
    def abort(self, *, which: int, panel: bool) -> None:
        name = self._name(which)
        state = self._state(name)
        said = self.desk.press(name, "give-up") if panel else self.desk.command("abort", name)
        wrong = _amiss(said)
        if (said.status == 0) != (state not in ENDED):
            wrong.append(f"{name}: was {state}, and abort ended with {said.status}: {said.text[-300:]}")
        self._judge(*wrong)

    @rule(which=RUNS, command=st.sampled_from(["calibrate", "report", "export", "seal"]))
    def evaluate(self, which: int, command: str) -> None:
        name = self._name(which)
        target = ["--csv", "readings.csv"] if command == "export" else []
        self._judge(*_amiss(self.desk.command(command, name, *target)))

    @rule(meter=st.sampled_from(METERS))
    def switch(self, meter: str) -> None:
        self.desk.switch(next(iter(self.desk.off), meter))
        self._judge()


def _amiss(said: Said) -> list[str]:
    text = said.text
    if "Traceback" in text or "mistake of the program" in text or "cannot be trusted" in text:
        return [f"not one of our messages: {text[-600:]}"]
    return []
