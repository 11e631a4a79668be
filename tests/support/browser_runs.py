"""Runs carried out by a separate program, whose questions a person answers in a browser or at a terminal."""

import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.run.events import EVENTS

PROGRAM = "from bench.cli.program import main; main()"
PATIENCE_S = 180.0


class Begun:
    """A run carried out by a separate program, whose questions are answered in its folder or by typing."""

    def __init__(
        self,
        runs: Path,
        name: str,
        procedure: str,
        answers: str | None,
        seed: int = 3,
        more: Sequence[str] = ("--dry-run",),
    ) -> None:
        self.folder = runs / name
        self.name = name
        command = ["run", procedure, *more, "--seed", str(seed), "--name", name, "--runs", str(runs)]
        self.process = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, "-c", PROGRAM, *command, *([] if answers is None else ["--answers", answers])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "COLUMNS": "200"},
        )

    def wait_for_events(self) -> None:
        """Wait until the record has begun."""
        until(lambda: (self.folder / EVENTS).exists() and (self.folder / EVENTS).stat().st_size > 0)

    def type(self, line: str) -> None:
        """Type a line at the terminal."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def ended(self) -> tuple[int, str]:
        """Wait for the end of the program; return its exit status and its output."""
        said, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / EVENTS).read_text("utf-8").splitlines()]

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.events() if event["type"] == kind]

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


@contextmanager
def simulating(bench: str, folder: Path, *options: str) -> Iterator[dict[str, Any]]:
    """Serve the simulated instruments of a bench; yield the content of the ready file once they listen."""
    ready = folder / "ready.json"
    command = [
        sys.executable,
        "-c",
        PROGRAM,
        "simulate",
        "--bench",
        bench,
        "--ready-file",
        str(ready),
        *options,
    ]
    program = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
    try:
        until(ready.exists)
        yield json.loads(ready.read_text("utf-8"))
    finally:
        program.terminate()
        program.wait(30)


def until(holds: Any, patience_s: float = PATIENCE_S) -> None:
    """Wait until `holds` returns true. Raises `AssertionError` after `patience_s`."""
    end_s = time.monotonic() + patience_s
    while not holds():
        if time.monotonic() > end_s:
            raise AssertionError("it did not come about")
        time.sleep(0.02)


def typed_for(asked: dict[str, Any], turn: int) -> str:
    """Return the answer to a question: an angle, the temperature that it states, or "yes".

    The angle is 0 to 19 arcsec above its target, in three notations in turn.
    """
    action = asked["action"]
    match action["do"]:
        case "turn":
            arcsec = round(math.degrees(action["target_rad"]) * 3600.0) % 1296000 + (turn * 7) % 20
            degrees, rest = divmod(arcsec, 3600)
            minutes, seconds = divmod(rest, 60)
            ways = (
                f"{degrees} {minutes} {seconds}",
                f"{degrees}°{minutes:02d}′{seconds:02d}″",
                f"{degrees}:{minutes}:{seconds}",
            )
            return ways[turn % 3]
        case "read_temperature":
            found = re.search(r"it shows ([-+]?\d+(?:\.\d+)?)", asked["text"])
            assert found is not None
            return found[1]
    return "yes"


def prompt_of(page: Any, before: str) -> str:
    """Return the id of the question that follows the question `before` on the page; "" once the run ended."""
    found = page.wait_for_function(
        "before => { const live = document.getElementById('live').dataset;"
        " return live.ended === 'true' ? [''] : live.prompt && live.prompt !== before && [live.prompt] }",
        arg=before,
    )
    return str(found.json_value()[0])  # not read again: without hands a question goes by itself


def answer_on(page: Any, text: str) -> None:
    """Answer the question on the page: by text and Enter or, without an input field, by a button."""
    if page.is_visible("#typed"):
        page.fill("#typed", text)
        page.press("#typed", "Enter")
    else:
        page.click(f"#buttons button >> text={'Yes' if text == 'yes' else text}")


def tab_to(page: Any, words: str) -> None:
    """Press Tab until the button, link or field of these words, or of this id, has the focus."""
    for _ in range(80):
        page.keyboard.press("Tab")
        said = page.evaluate("(at => [at.id, at.ariaLabel || at.textContent.trim()])(document.activeElement)")
        if words == said[0] or said[1].startswith(words):
            return
    raise AssertionError(f"no key leads to {words}")


def answer_by_keys(page: Any, text: str) -> None:
    """Answer the question on the page with the keyboard alone; a field has the focus already."""
    if page.is_visible("#typed"):
        page.wait_for_function(
            "() => { const at = document.activeElement; return at.id === 'typed' && !at.readOnly; }"
        )
        page.keyboard.type(text)
    else:
        tab_to(page, "Yes" if text == "yes" else text)
    page.keyboard.press("Enter")
