"""Kill the panel (SIGKILL) at random moments while a person answers in it, and start it again.

    python -m benchmarks.panel_kills --kills 50 --seed 1

All are real processes: the program that carries out a dry run whose questions a person answers in the panel, the
panel, and a client that answers as fast as a person might. After each kill: the program lives and its record is
complete; the person is still signed in and in control; the panel shows the question on the disk; and no question
was answered twice. What a page shows after such a kill, and after one of the program itself, is tested in
`pytest -m browser tests/browser/test_lost.py`.
"""

import os
import random
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from bench.panel.access import STATE, Access, Role
from bench.panel.app import begin_panel, url_of
from bench.run.folder import Run
from bench.run.record import is_being_written
from benchmarks.campaign import amiss, arguments
from tests.support.browser_runs import PATIENCE_S, Begun, until


def answer_to(prompt: dict[str, Any]) -> str:
    """Return the answer of a careful person to a prompt."""
    usual = "20" if prompt["kind"] == "number" else "yes"
    return str(prompt["target"] or prompt["default"] or next(iter(prompt["choices"]), usual))


class Campaign:
    """One folder of runs, one person who signed in before the first kill, and one panel after the other.

    `counts` are the numbers of kills, runs and answers; `wrong` are sentences on faults.
    """

    def __init__(self, runs: Path, seed: int) -> None:
        self.runs, self.random = runs, random.Random(seed)  # noqa: S311 - to be repeated
        self.counts: Counter[str] = Counter()
        self.wrong: list[str] = []
        token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
        self.panel = begin_panel(runs, [0])
        url = url_of(runs)
        self.client = httpx.Client(
            base_url=url, headers={"origin": url, "accept": "application/json"}, timeout=20
        )
        self.client.post("/sign-in", data={"token": token})
        page = self.client.get("/", headers={"accept": "text/html"}).text
        self.client.headers["x-csrf"] = page.partition('name="csrf" content="')[2].partition('"')[0]

    def state(self, run: Begun) -> dict[str, Any]:
        """Return the panel's data on a run. Raises `httpx.HTTPError` if there is no answer."""
        told: dict[str, Any] = self.client.get(f"/runs/{run.name}/state").raise_for_status().json()
        return told

    def post(self, run: Begun, what: str, **sent: str) -> int:
        """Send a request for a run; return the HTTP status."""
        return self.client.post(f"/runs/{run.name}/{what}", json=sent).status_code

    def kill(self) -> None:
        """Kill the panel."""
        os.kill(self.panel.process.pid, signal.SIGKILL)
        self.panel.process.wait()

    def begin_run(self) -> Begun:
        """Start a calibration whose questions are answered in its folder, and take control of it."""
        self.counts["runs"] += 1
        run = Begun(self.runs, f"run-{self.counts['runs']}", "calibration", "folder")
        try:
            run.wait_for_events()
            until(lambda: _answered(lambda: self.state(run)["prompt"] is not None))
            self.post(run, "control", do="take")
        except BaseException:
            run.close()
            raise
        return run

    def kill_and_check(self, run: Begun) -> None:
        """Answer questions until the panel is killed at a random moment; restart and check it."""
        timer = threading.Timer(self.random.uniform(0.0, 1.5), self.kill)
        timer.start()
        while timer.is_alive():
            self.answer_one(run)
            time.sleep(self.random.uniform(0.0, 0.3))
        timer.join()
        self.counts["kills"] += 1
        if run.process.poll() not in {None, 0, 1}:
            self.wrong.append(f"{run.name}: the program ended: {run.ended()}")
        self.panel = begin_panel(self.runs, [int(url_of(self.runs).rpartition(":")[2])])
        self.check(run)

    def answer_one(self, run: Begun) -> None:
        """Answer the open question, if the panel is running."""
        try:
            prompt = self.state(run)["prompt"]
            if prompt is not None:
                status = self.post(run, "answer", id=prompt["id"], text=answer_to(prompt))
                self.counts[f"answered {status}"] += 1
                if status not in {200, 409}:
                    self.wrong.append(f"{run.name}: {prompt['text']}: answered {status}")
        except httpx.HTTPError:
            self.counts["cut"] += 1

    def check(self, run: Begun) -> None:
        """Check that session, control, record and open question survived the kill."""
        holder = self.state(run)["control"]["holder"]
        if holder != "anna":
            self.wrong.append(f"{run.name}: in control is {holder} after a restart")
        if problems := Run(run.folder).history.problems:
            self.wrong.append(f"{run.name}: {problems}")
        if is_being_written(run.folder):
            try:
                until(lambda: _answered(lambda: self._same_question(run)), 20.0)
            except AssertionError:
                self.wrong.append(f"{run.name}: the panel shows another question than stands")
        self.check_answers(run)

    def _same_question(self, run: Begun) -> bool:
        on_disk = Run(run.folder).history.progress.asked.prompt
        shown = self.state(run)
        return not shown["alive"] or (on_disk and on_disk.prompt.id) == (
            shown["prompt"] and shown["prompt"]["id"]
        )

    def check_answers(self, run: Begun) -> None:
        """Check that no question was answered twice, and that there is no answer without a question."""
        open_ones: set[str] = set()
        answered: set[str] = set()
        for event in Run(run.folder).history.events:
            if event.type == "asked":
                open_ones.add(event.data["id"])
            elif event.type == "answered":
                if event.data["id"] not in open_ones - answered:
                    self.wrong.append(f"{run.name}: {event.data['id']} was answered twice, or unasked")
                answered.add(event.data["id"])

    def finish(self, run: Begun) -> None:
        """Answer the remaining questions, and check the finished run."""
        until_s = time.monotonic() + PATIENCE_S
        while run.process.poll() is None and time.monotonic() < until_s:
            self.answer_one(run)
            time.sleep(0.02)
        said = "it did not end" if run.process.poll() is None else run.ended()[1]
        run.close()
        self.check_answers(run)
        history = Run(run.folder).history
        if history.state != "finished" or history.problems or run.process.returncode not in {0, 1}:
            self.wrong.append(f"{run.name}: {history.state}, {history.problems}: {said}")


def campaign(runs: Path, kills: int, seed: int) -> Campaign:
    """Kill the panel `kills` times; return the campaign with its counts and faults."""
    one = Campaign(runs, seed)
    run = None
    try:
        run = one.begin_run()
        while one.counts["kills"] < kills:
            if run.process.poll() is not None:
                one.finish(run)
                run = one.begin_run()
            one.kill_and_check(run)
        one.finish(run)
    finally:
        one.kill()
        if run is not None:
            run.close()
    return one


def _answered(holds: Callable[[], bool]) -> bool:
    """Return whether something holds; a request that the panel does not answer counts as no."""
    try:
        return holds()
    except httpx.HTTPError:
        return False


def main() -> None:
    """Carry out the campaign and print the outcome; the exit status is 1 after any fault."""
    asked = arguments(__doc__, kills=50, seed=1)
    with tempfile.TemporaryDirectory() as folder:
        found = campaign(Path(folder), asked.kills, asked.seed)
    counts = found.counts
    print(
        f"{counts['kills']} kills over {counts['runs']} runs: {counts['answered 200']} answers taken, "
        f"{counts['answered 409']} refused as stale, {counts['cut']} requests cut off"
    )
    status = amiss(found.wrong, "WRONG", 20)
    print(f"{len(found.wrong)} found wrong")
    raise SystemExit(status)


if __name__ == "__main__":
    main()
