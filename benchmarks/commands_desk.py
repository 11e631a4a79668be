"""A bench, its folder of runs, a terminal and a panel in one process: the parts of `commands_campaign.py`."""

from __future__ import annotations

import contextlib
import io
import json
import os
import queue
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

import yaml

from bench.cli.app import main as bench_command
from bench.config.bench_file.file import load_bench
from bench.config.procedure.plan import Read
from bench.model import ForwardModel
from bench.panel import launching
from bench.panel.access import Role
from bench.panel.launching import Started
from bench.run import listening
from bench.run.assembly.instruments import simulated_instruments, world_of
from bench.run.events import EVENTS, MANIFEST, Event, RunState
from bench.run.folder import RESULTS, Run
from bench.run.person import OpenPrompt
from bench.run.record import Record
from bench.services.execution import taken_up
from benchmarks.answering_campaign import answer_to
from sim.bench import SimulatedBench
from sim.world.clock import ScaledClock
from tests.support.panel_client import Browser

ROOT: Final = Path(__file__).resolve().parents[1]
METERS: Final = ("voltmeter.x", "voltmeter.y", "voltmeter.z")
PROCEDURE: Final = """\
procedure: short
title: Three points in two installations
reading: {samples: 2, nplc: 1, settle: 0 s}
steps:
  - installation: {label: 1, steps: [turn: {angles: [0 deg, 90 deg, 180 deg]}]}
  - installation: {label: 2, steps: [turn: {angles: [0 deg, 90 deg, 180 deg]}]}
"""
EMPTY_FIGURE: Final = '<svg viewBox="0 0 1 1"></svg>'
"""In place of the figures of pages, which cost more than all else."""
SPEED: Final = 1000.0
"""The meters' clock runs so many times faster: no reading is waited for."""
STOPPED: Final = 2
OK: Final = 200
LOOK_S: Final = 0.01
MOST_LOOKS: Final = 1000
_NAMED: Final = re.compile(r"'bench resume (\S+)'")


@dataclass
class Said:
    """How a command ended, and all that it said."""

    status: int
    text: str


class Process:
    """Stands for the process that the panel starts: the command is carried out in the main thread."""

    status: int | None = None

    def poll(self) -> int | None:
        """Return the exit status, None as long as it runs."""
        return self.status


class Desk:
    """A bench, a folder of runs, a terminal and a panel, in this process.

    `kept` are the whole lines of each record as they were last seen.
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
        """Serve the instruments, and stand between the program, its terminal and its records."""
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
            stack.enter_context(mock.patch("bench.results.plots._written", return_value=EMPTY_FIGURE))
            self.browser = Browser(self.runs, "anna", Role.OPERATOR)
            stack.enter_context(self.browser.client)  # one loop, in which the panel follows runs
            yield self

    # --- what is done ---------------------------------------------------------------------------------

    def command(self, *arguments: object, trouble: str = "", at: int = 0) -> Said:
        """Type a command; `trouble` comes over it at its `at`-th event."""
        before = self._lines()
        self._trouble, self._at, self._events, self._asked = trouble, at, 0, OpenPrompt()
        self._away = launching.ANSWERS in arguments
        out = io.StringIO()
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(out),
            mock.patch.object(sys, "stdin", Typist(self)),
        ):
            try:
                bench_command([str(one) for one in arguments])
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else STOPPED
        self._trouble = ""
        if trouble in {"kill", "results"}:
            self._killed(before, at, results=trouble == "results")
        self.after = f"{' '.join(map(str, arguments))} [{trouble} {at}]: {status} {out.getvalue()[-400:]}"
        return Said(status, out.getvalue())

    def press(self, name: str, button: str, *, trouble: str = "", at: int = 0) -> Said:
        """Press a button of the panel; the program that it starts is carried out here, as a process would be."""
        started: queue.Queue[tuple[Sequence[str], Process] | None] = queue.Queue()
        replies: list[tuple[int, dict[str, Any]]] = []

        def start(arguments: Sequence[str], log: Path) -> Started:
            process = Process()
            started.put((arguments, process))
            return Started(process, log)  # type: ignore[arg-type]

        def pressed() -> None:
            replies.append(self.browser.ask(f"/runs/{name}/{button}"))
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

    # --- what comes over it ---------------------------------------------------------------------------

    def _follow(self, name: str, event: Event) -> None:
        """Follow the events of a run: answer what is asked, and let the trouble of the command come over it."""
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
        """Do at the simulated bench what a person is asked to do."""
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
        """Return the line that somebody types at the terminal."""
        return f"{self._answer}\n"

    def _killed(self, before: dict[str, bytes], at: int, *, results: bool) -> None:
        """Leave of the run that went on what SIGKILL leaves: its record up to any byte, not all results."""
        for name, content in self._lines().items():
            grown = len(content) - len(before.get(name, b""))
            finished = b'"run_finished"' in content
            if results and not (finished and (self.runs / name / RESULTS).exists()):
                continue
            if not results and not grown:
                continue
            if not results:
                # a power cut may take more, but never what was there before
                os.truncate(self.runs / name / EVENTS, len(content) - grown + at * 7919 % grown)
            for made in ("verify.json", "report.html", "calibrate.json")[: 1 + at % 3]:
                (self.runs / name / made).unlink(missing_ok=True)
            (self.runs / name / RESULTS).write_text('{"made": null}')
            self.kept[name] = _whole(self._lines()[name])

    def _lines(self) -> dict[str, bytes]:
        return {
            folder.parent.name: folder.with_name(EVENTS).read_bytes()
            for folder in self.runs.glob(f"*/{MANIFEST}")
        }

    # --- what must hold -------------------------------------------------------------------------------

    def check(self) -> list[str]:
        """Return what is amiss now."""
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
        steps = Counter(
            event.step
            for event in run.history.events
            if event.type == "step_done" and "reading" in event.data
        )
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
        """Whether a run can be resumed, as the program recommends it."""
        try:
            record, _ = taken_up(Run(self.runs / name), results_too=True)
        except Exception as error:
            return [f"{name}: resume is recommended, and refused: {error}"]
        record.close()
        return []

    def names(self) -> list[str]:
        """Return the runs there are."""
        return sorted(self._lines())


def _whole(content: bytes) -> bytes:
    """Return the whole lines of a record, of which the last may be torn."""
    return content[: content.rfind(b"\n") + 1]


class Typist(io.StringIO):
    """The keyboard: each line answers the question that stands."""

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self._desk = desk

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        return self._desk.typed()
