"""Kill the panel (SIGKILL) at random moments while a person answers in it, and start it again.

    python -m benchmarks.panel_kills --kills 50 --seed 1

All are real processes: the program that carries out a dry run whose questions a person answers in the panel, the
panel, and a client that answers as fast as a person might. After each kill: the program lives and its record is
complete; the person is still signed in and in control; the panel shows the question on the disk; and no question
was answered twice. At the end the program itself is killed: the panel reports this, and resumes the run.
"""

import os
import random
import signal
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from bench.panel.access import STATE, Access, Role
from bench.panel.app import begin_panel, url_of
from bench.panel.launching import Started, last_words, start
from bench.run.events import EVENTS
from bench.run.folder import Run
from bench.run.record import is_being_written
from benchmarks.campaign import amiss, arguments

PATIENCE_S = 120.0


@dataclass
class Outcome:
    """The outcome of the campaign: sentences on faults, and counts."""

    kills: int = 0
    runs: int = 0
    answered: int = 0
    refused: int = 0
    cut: int = 0
    wrong: list[str] = field(default_factory=list)


class Person:
    """A person who signed in once, before the first kill."""

    def __init__(self, url: str, token: str) -> None:
        self.client = httpx.Client(
            base_url=url, headers={"origin": url, "accept": "application/json"}, timeout=20
        )
        self.client.post("/sign-in", data={"token": token})
        page = self.client.get("/", headers={"accept": "text/html"}).text
        self.client.headers["x-csrf"] = page.partition('name="csrf" content="')[2].partition('"')[0]

    def state(self, run: str) -> dict[str, Any]:
        """Return the panel's data on a run. Raises `httpx.HTTPError` if there is no answer."""
        reply = self.client.get(f"/runs/{run}/state").raise_for_status()
        told: dict[str, Any] = reply.json()
        return told

    def post(self, run: str, what: str, **sent: str) -> int:
        """Send a request for a run; return the HTTP status."""
        return self.client.post(f"/runs/{run}/{what}", json=sent).status_code


def answer_to(prompt: dict[str, Any]) -> str:
    """Return the answer of a careful person to a prompt."""
    if prompt["target"] is not None:
        return str(prompt["target"])
    if prompt["choices"] and prompt["default"] is None:
        return str(prompt["choices"][0])
    return (
        "20" if prompt["kind"] == "number" and prompt["default"] is None else str(prompt["default"] or "yes")
    )


class Campaign:
    """One folder of runs, one person, and one panel after the other."""

    def __init__(self, runs: Path, seed: int) -> None:
        self.runs, self.random, self.outcome = runs, random.Random(seed), Outcome()  # noqa: S311 - to be repeated
        token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
        self.panel = begin_panel(runs, [0])
        self.person = Person(url_of(runs), token)

    def amiss(self, sentence: str) -> None:
        """Note a fault."""
        self.outcome.wrong.append(sentence)

    def kill(self) -> None:
        """Kill the panel."""
        os.kill(self.panel.process.pid, signal.SIGKILL)
        self.panel.process.wait()

    def begin_run(self, procedure: str) -> tuple[str, Started]:
        """Start a run whose questions are answered in its folder, and take control of it."""
        self.outcome.runs += 1
        name = f"run-{self.outcome.runs}"
        options = ["--dry-run", f"--name={name}", f"--runs={self.runs}", "--answers=folder"]
        runner = start(["run", procedure, *options], self.runs / f"{name}.log")
        until(lambda: (self.runs / name / EVENTS).exists() and self.person.state(name)["prompt"] is not None)
        self.person.post(name, "control", do="take")
        return name, runner

    def kill_and_check(self, name: str, runner: Started) -> None:
        """Answer questions until the panel is killed at a random moment; restart and check it."""
        timer = threading.Timer(self.random.uniform(0.0, 1.5), self.kill)
        timer.start()
        while timer.is_alive():
            self.answer_one(name)
            time.sleep(self.random.uniform(0.0, 0.3))
        timer.join()
        self.outcome.kills += 1
        if runner.status not in {None, 0, 1}:
            self.amiss(f"{name}: the program ended with {runner.status}: {last_words(runner.log)}")
        self.panel = begin_panel(self.runs, [int(url_of(self.runs).rpartition(":")[2])])
        self.check(name)

    def answer_one(self, name: str) -> None:
        """Answer the open question, if the panel is running."""
        try:
            prompt = self.person.state(name)["prompt"]
            if prompt is not None:
                status = self.person.post(name, "answer", id=prompt["id"], text=answer_to(prompt))
                self.outcome.answered += status == 200
                self.outcome.refused += status == 409
                if status not in {200, 409}:
                    self.amiss(f"{name}: {prompt['text']}: answered {status}")
        except httpx.HTTPError:
            self.outcome.cut += 1

    def check(self, name: str) -> None:
        """Check that session, control, record and open question survived the kill."""
        told = self.person.state(name)
        if told["control"]["holder"] != "anna":
            self.amiss(f"{name}: in control is {told['control']['holder']} after a restart")
        history = Run(self.runs / name).history
        if history.problems:
            self.amiss(f"{name}: {history.problems}")
        if is_being_written(self.runs / name):
            try:
                until(lambda: self._same_question(name), 20.0)
            except TimeoutError:
                self.amiss(f"{name}: the panel shows another question than stands")
        self.check_answers(name)

    def _same_question(self, name: str) -> bool:
        on_disk = Run(self.runs / name).history.progress.asked.prompt
        shown = self.person.state(name)
        return not shown["alive"] or (on_disk and on_disk.prompt.id) == (
            shown["prompt"] and shown["prompt"]["id"]
        )

    def check_answers(self, name: str) -> None:
        """Check that no question was answered twice, and that there is no answer without a question."""
        asked: set[str] = set()
        answered: set[str] = set()
        for event in Run(self.runs / name).history.events:
            if event.type == "asked":
                asked.add(event.data["id"])
            elif event.type == "answered":
                if event.data["id"] in answered or event.data["id"] not in asked:
                    self.amiss(f"{name}: {event.data['id']} was answered twice, or unasked")
                answered.add(event.data["id"])

    def finish(self, name: str, runner: Started | None) -> None:
        """Answer the remaining questions, and check the finished run; for a resumed run, `runner` is None."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            self.answer_one(name)
            time.sleep(0.02)
            if runner is not None and runner.status is not None:
                break
            finished = Run(self.runs / name).history.state == "finished"
            if runner is None and finished and not is_being_written(self.runs / name):
                break
        self.check_answers(name)
        history = Run(self.runs / name).history
        if history.state != "finished" or history.problems or (runner and runner.status not in {0, 1}):
            said = last_words(runner.log) if runner else "after its program was killed"
            self.amiss(f"{name}: {history.state}, {history.problems}: {said}")

    def kill_the_runner(self) -> None:
        """Kill the program that carries out a run; the panel must report this, and resume the run."""
        name, runner = self.begin_run("quick")
        for _ in range(5):
            self.answer_one(name)
            time.sleep(0.2)
        os.kill(runner.process.pid, signal.SIGKILL)
        until(lambda: self.person.state(name)["alive"] is False)
        status = self.person.post(name, "resume")
        if status == 200:
            self.finish(name, None)
        else:
            self.amiss(f"{name}: resuming it was answered {status}")


def until(true: Any, patience_s: float = PATIENCE_S) -> None:
    """Wait until a function returns true. Raises `TimeoutError`."""
    until_s = time.monotonic() + patience_s
    while True:
        try:
            if true():
                return
        except httpx.HTTPError:
            pass
        if time.monotonic() > until_s:
            raise TimeoutError
        time.sleep(0.05)


def campaign(runs: Path, kills: int, seed: int) -> Outcome:
    """Kill the panel `kills` times; return the outcome."""
    one = Campaign(runs, seed)
    try:
        name, runner = one.begin_run("calibration")
        while one.outcome.kills < kills:
            if runner.status is not None:
                one.finish(name, runner)
                name, runner = one.begin_run("calibration")
            one.kill_and_check(name, runner)
        one.finish(name, runner)
        one.kill_the_runner()
    finally:
        one.kill()
    return one.outcome


def main() -> None:
    """Carry out the campaign and print the outcome; the exit status is 1 after any fault."""
    asked = arguments(__doc__, kills=50, seed=1)
    with tempfile.TemporaryDirectory() as folder:
        found = campaign(Path(folder), asked.kills, asked.seed)
    print(
        f"{found.kills} kills over {found.runs} runs: {found.answered} answers taken, {found.refused} refused as "
        f"stale, {found.cut} requests cut off"
    )
    status = amiss(found.wrong, "WRONG", 20)
    print(f"{len(found.wrong)} found wrong")
    raise SystemExit(status)


if __name__ == "__main__":
    main()
