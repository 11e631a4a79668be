"""Kill dry runs at random moments, answer their questions well and badly, and resume each until it ends.

Each dry run asks a person, and is carried out by a separate program on a terminal. The answer to each
question is typed, left in the run's folder, or both at once. Stale, unsuitable or malformed answers precede
it. At random moments the program is killed (SIGKILL) and the run resumed, with a terminal or without. Each
typed angle deviates from its target by a few arcseconds of its own, so that an answer used for the wrong
question is detected.

Promised: every run ends with exactly the readings of an undisturbed run of the same seed, none twice, and
with a complete chain of hashes. No question is answered twice, only recorded answers are used, and none is
lost. A question whose answer a kill prevented is asked again.
"""

import math
import os
import random
import re
import subprocess
import time
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.run.events import Event
from bench.run.folder import Run
from bench.run.person import ANSWERS, LeftAnswer, OpenPrompt, WishAuthor, leave_answer, understood_answer
from bench.run.record import parse_line, read_history
from benchmarks.campaign import PROGRAM
from drivers.angles import format_dms, parse_angle
from drivers.person import Prompt, PromptKind

PROCEDURE: Final = "quick"
BEGIN: Final = ("run", PROCEDURE, "--dry-run", "--seed", "7", "--name")
PANEL: Final = WishAuthor("Ann", "operator", "panel")
ACT_AGAIN_S: Final = 1.5
"""Time after which the operator types an answer again: text typed while a question is printed may be lost."""
ENOUGH_S: Final = 600.0
LONGEST_S: Final = 2.2
"""Approximate duration of a dry run of `quick` on a machine of two cores, its start included, s."""


def answer_to(prompt: Prompt) -> str:
    """Return the answer to a question, the same each time it is asked."""
    match prompt.kind:
        case PromptKind.ANGLE:
            off_arcsec = zlib.crc32(prompt.id.partition("#")[0].encode()) % 41 - 20
            action: Any = prompt.action
            angle = float(action["target_rad"]) + parse_angle(f"0 0 {abs(off_arcsec)}") * (
                1 if off_arcsec > 0 else -1
            )
            return format_dms(angle)
        case PromptKind.NUMBER:
            shown = re.search(r"shows (\S+)\.\)", prompt.text)
            return shown[1] if shown else "15"
        case PromptKind.CHOOSE:
            return prompt.choices[0]
        case PromptKind.CONFIRM:
            return "yes"


class Hands:
    """A simulated operator who follows a run's events and answers its questions by keyboard and in files."""

    def __init__(self, folder: Path, rng: random.Random, keyboard: int | None, *, calm: bool = False) -> None:
        self.folder, self.rng, self.keyboard, self.calm = folder, rng, keyboard, calm
        self.asked = OpenPrompt()
        self.done: Counter[str] = Counter()
        self.questions = 0
        self.finished = False
        self._place = 0
        self._seen, self._acted_s = "", 0.0
        self._ids: list[str] = []

    def look(self) -> None:
        """Read the new events, and answer an open question."""
        self._take_in()
        asked = self.asked.prompt
        if asked is None:
            return
        if asked.prompt.id != self._seen:
            self._seen, self.questions = asked.prompt.id, self.questions + 1
            self._ids.append(asked.prompt.id)
        elif time.monotonic() - self._acted_s < ACT_AGAIN_S:
            return
        self._acted_s = time.monotonic()
        self._act(asked.prompt)

    def _take_in(self) -> None:
        path = self.folder / "events.jsonl"
        if not path.exists():
            return
        with path.open("rb") as file:
            file.seek(self._place)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._place += len(line)
                event = parse_line(line)[0]
                self.asked.take(event)
                self.finished |= event.type == "run_finished"

    def _act(self, prompt: Prompt) -> None:
        text = answer_to(prompt)
        if not self.calm:
            self._disturb(prompt)
        places = ["folder", "folder twice", "keyboard", "both"] if self.keyboard is not None else ["folder"]
        place = "folder" if self.calm else self.rng.choice(places)
        self.done[place] += 1
        if place in ("keyboard", "both") and self.keyboard is not None:
            time.sleep(self.rng.choice((0.0, 0.2, 0.8)))
            os.write(self.keyboard, text.encode() + b"\n")
        for _ in range({"keyboard": 0, "folder twice": 2}.get(place, 1)):
            self._leave(prompt.id, text)

    def _disturb(self, prompt: Prompt) -> None:
        """Leave answers that must be ignored, before the valid one."""
        what = self.rng.choice(("nothing", "nothing", "stale", "ill-fitting", "garbage", "half"))
        self.done[what] += 1
        if what == "stale":
            self._leave(self.rng.choice([*self._ids[:-1], "0001/none#1@1"]), "yes")
        elif what == "ill-fitting":
            self._leave(prompt.id, "nonsense")
        elif what != "nothing":
            with (self.folder / ANSWERS).open("ab", buffering=0) as file:
                file.write(b"\xff{yes\n" if what == "garbage" else b'{"id": "')
                file.write(b'x"}\n' if what == "half" else b"")

    def _leave(self, prompt_id: str, text: str) -> None:
        leave_answer(self.folder, LeftAnswer(prompt_id, text, PANEL))


def one(number: int, folder: Path, *, seed: int, kills: int) -> tuple[Run, Counter[str]]:
    """Carry out a run to its end; return the run and the number of disturbances of each kind."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311 - a campaign, no secret
    name = f"run{number}"
    run = folder / "runs" / name
    done: Counter[str] = Counter()
    deadline_s = time.monotonic() + ENOUGH_S
    while True:
        at_terminal = rng.random() < 0.7
        master, screen = os.openpty()
        os.set_blocking(master, False)
        what = ["resume", name] if (run / "run.json").exists() else [*BEGIN, name]
        process = subprocess.Popen(  # noqa: S603 - our own program
            [*PROGRAM, *what, "--answers", "terminal" if at_terminal else "folder"],
            cwd=folder, stdin=screen, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        hands = Hands(run, rng, master if at_terminal else None)
        last = kills <= 0
        questions, late_s = rng.randrange(0, 14), rng.choice((0.0, rng.uniform(0.0, 0.3)))
        # sometimes at any time, even before the first question
        killed_s = time.monotonic() + rng.choice((math.inf, rng.uniform(0.05, LONGEST_S)))
        try:
            # the evaluation of a finished run takes longest, and asks nothing
            while process.poll() is None and not hands.finished and time.monotonic() < deadline_s:
                hands.look()
                if not last and (hands.questions > questions or time.monotonic() > killed_s):
                    time.sleep(late_s)
                    break
                time.sleep(0.005)
                _drain(master)
        finally:
            process.kill()
            process.wait()
            os.close(master)
            os.close(screen)
        done += hands.done
        if (run / "events.jsonl").exists() and read_history(run).state == "finished":
            return Run(run), done
        if last:
            done["unfinished"] += 1
            return Run(run), done
        kills -= 1
        done["killed"] += 1


def _drain(master: int) -> None:
    """Discard what the terminal echoes."""
    try:
        os.read(master, 4096)
    except OSError:
        return


def amiss(run: Run) -> list[str]:
    """Return sentences on the faults in a run's answers, according to its record."""
    wrong: list[str] = []
    events = list(run.history.events)
    ids = [event.data["id"] for event in events if event.type == "asked"]
    if len(set(ids)) != len(ids):
        wrong.append("two questions have one id")
    answered = Counter(event.data["id"] for event in events if event.type == "answered")
    wrong += [f"{prompt_id} was answered {times} times" for prompt_id, times in answered.items() if times > 1]
    lines = [e.data["line"] for e in events if e.type in ("answered", "answer_refused") and "line" in e.data]
    if lines != sorted(set(lines)):
        wrong.append(f"a line of the answers was heard twice, or out of turn: {lines}")
    return wrong + _astray(events)


def _astray(events: list[Event]) -> list[str]:
    """Return sentences on answers that were used for another question, and on valid answers that were not used."""
    wrong = []
    asked = OpenPrompt()
    angle_deg: float | None = None
    for event in events:
        stood = asked.prompt
        asked.take(event)
        if event.type == "answered":
            if stood is None or stood.prompt.id != event.data["id"]:
                wrong.append(f"event {event.number}: an answer to a question that did not stand")
            elif event.data["answer"] != answer_to(stood.prompt):
                wrong.append(
                    f"event {event.number}: the answer {event.data['answer']!r} was never given to it"
                )
            elif stood.prompt.kind is PromptKind.ANGLE:
                angle_deg = parse_angle(event.data["answer"]) * 57.29577951308232
                if not understood_answer(stood.prompt, event.data["answer"]):
                    wrong.append(f"event {event.number}: an answer that does not fit was taken")
        elif event.type == "step_started":
            angle_deg = None
        elif event.type == "step_done" and "angle_deg" in event.data:
            off_deg = (event.data["angle_deg"] - (angle_deg if angle_deg is not None else 999.0)) % 360.0
            if min(off_deg, 360.0 - off_deg) > 1e-6:
                wrong.append(f"event {event.number}: the head stands elsewhere than was answered")
    return wrong


def differences(run: Run, expected: Run) -> list[str]:
    """Return sentences on the differences between a run and an undisturbed one, `expected`."""
    wrong = list(run.history.problems)
    steps = [e.data["step"] for e in run.history.events if e.type == "step_done" and "reading" in e.data]
    wrong += [f"step {step} was read twice" for step, times in Counter(steps).items() if times > 1]
    ours, theirs = run.readings(), expected.readings()
    if len(ours) != len(theirs):
        return [*wrong, f"{len(ours)} readings, planned were {len(theirs)}"]
    for column in ("signal", "angle_rad", "time_s", "installation", "point"):
        if not np.array_equal(getattr(ours, column), getattr(theirs, column)):
            wrong.append(f"{column} differs from an undisturbed run")
    return wrong
