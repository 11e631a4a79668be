"""Control of a run: at most one person has it. A journal in the run's folder records each change.

The journal is the only store of the state of control; the state therefore survives a kill of the server.
Control changes only by the action of a person; it never expires.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

from bench.base.text import in_json
from bench.panel.access import Person, Refusal, Role
from drivers.clock import utc_now

JOURNAL: Final = "holding.jsonl"
MOST_ASKING: Final = 20
LARGEST: Final = 4 * 2**20
"""Size (bytes) above which a journal accepts no more "ask" and "deny", which do not change the holder."""


class Deed(StrEnum):
    """The kind of action that a line of the journal records."""

    TAKEN = "taken"
    ASKED = "asked"
    GRANTED = "granted"
    DENIED = "denied"
    RELEASED = "released"
    FORCED = "forced"


WORDS: Final = {
    "take": Deed.TAKEN,
    "ask": Deed.ASKED,
    "grant": Deed.GRANTED,
    "deny": Deed.DENIED,
    "release": Deed.RELEASED,
    "force": Deed.FORCED,
}
"""The commands of the control form, with the actions that they cause."""


@dataclass(frozen=True)
class Holding:
    """The state of control of a run: its `holder` (empty for nobody), `since` when, and `how` it was obtained.

    `asking` lists the persons who request control, in order; `denied` those whose last request was denied.
    """

    holder: str = ""
    since: str = ""
    how: str = ""
    asking: tuple[str, ...] = ()
    denied: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the state of control as a JSON object for pages and scripts."""
        return {
            "holder": self.holder or None,
            "since": self.since or None,
            "how": self.how or None,
            "asking": list(self.asking),
            "denied": list(self.denied),
        }

    def after(self, deed: Deed, who: str, to: str, at: str) -> Holding:
        """Return the state of control after a deed: what the person `who` did, to whom (`to`), and when (`at`)."""
        match deed:
            case Deed.TAKEN | Deed.FORCED:
                return self._held_by(who, at, deed)
            case Deed.GRANTED:
                return self._held_by(to, at, deed)
            case Deed.ASKED:
                return replace(
                    self, asking=(*_without(self.asking, who), who), denied=_without(self.denied, who)
                )
            case Deed.DENIED:
                denied = (*_without(self.denied, to), to)[-MOST_ASKING:]
                return replace(self, asking=_without(self.asking, to), denied=denied)
            case Deed.RELEASED:
                return replace(self, holder="", since=at, how=deed)

    def _held_by(self, who: str, at: str, deed: Deed) -> Holding:
        return Holding(who, at, deed, _without(self.asking, who), _without(self.denied, who))


def _without(names: tuple[str, ...], name: str) -> tuple[str, ...]:
    return tuple(one for one in names if one != name)


def read_holding(folder: Path) -> Holding:
    """Return the state of control of the run in a folder, from its journal; invalid lines are skipped."""
    try:
        descriptor = os.open(folder / JOURNAL, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        with os.fdopen(descriptor, "rb") as file:
            return _holding_in(file.read())
    except OSError:
        return Holding()


def _holding_in(text: bytes) -> Holding:
    found = Holding()
    for line in text.splitlines(keepends=True):
        if not line.endswith(b"\n"):
            break
        try:
            told = json.loads(line)
            deed, who, at = Deed(told["did"]), str(told["who"]), str(told["at"])
            found = found.after(deed, who, str(told.get("to", "")), at)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
    return found


def change(
    folder: Path, word: str, person: Person, to: str = "", now: Callable[[], datetime] = utc_now
) -> Holding:
    """Carry out a person's command (a key of `WORDS`) on the control of a run; return the new state.

    `to` is the person to whom control is granted or denied, by default the first who asked. Raises `Refusal` if the
    command is not allowed, `OSError` if the journal cannot be written.
    """
    if word not in WORDS:
        raise Refusal(400, f"there is no such command; send one of {', '.join(WORDS)}")
    path = folder / JOURNAL
    with FileLock(folder / f".{JOURNAL}.lock", mode=0o600):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        with os.fdopen(descriptor, "r+b", buffering=0) as file:
            text = file.read()
            before = _holding_in(text)
            to = _checked(before, word, person, to)
            if len(text) > LARGEST and word in {"ask", "deny"}:
                raise Refusal(
                    429,
                    "this run has too many requests for control; ask the person in control to give it up",
                )
            line = {"did": WORDS[word].value, "who": person.name, "role": person.role.value}
            line |= {"to": to} if to else {}
            line["at"] = now().isoformat()
            # cut off an incomplete line, left by a program that was killed
            start = text.rfind(b"\n") + 1
            file.truncate(start)
            file.seek(start)
            file.write(in_json(json.dumps(line, ensure_ascii=False)).encode() + b"\n")
            os.fsync(descriptor)
    return before.after(WORDS[word], person.name, to, line["at"])


def _checked(holding: Holding, word: str, person: Person, to: str) -> str:
    """Return the person to whom a command grants or denies control, or "". Raises `Refusal` if not allowed."""
    person.require(Role.SUPERVISOR if word == "force" else Role.OPERATOR)
    holds = holding.holder == person.name
    match word:
        case "take" | "ask" | "force" if holds:
            raise Refusal(409, f"{person.name} is already in control; no need to ask")
        case "take" if holding.holder:
            raise Refusal(409, f"{holding.holder} is in control; ask for control")
        case "ask" if not holding.holder:
            raise Refusal(409, "nobody is in control; take control first")
        case "ask" if len(holding.asking) >= MOST_ASKING:
            raise Refusal(429, "too many persons ask for control already; wait until one of them is answered")
        case "ask" if person.name in holding.asking:
            raise Refusal(409, f"{person.name} has already asked for control; wait for the answer")
        case "grant" | "deny" | "release" if not holding.holder:
            raise Refusal(403, "nobody is in control; take control first")
        case "grant" | "deny" | "release" if not holds:
            raise Refusal(
                403,
                f"only the person in control ({holding.holder}) may grant, deny or give up control; ask "
                f"{holding.holder} for control",
            )
        case "grant" | "deny":
            to = to or next(iter(holding.asking), "")
            if to not in holding.asking:
                raise Refusal(
                    409,
                    f"{to or 'nobody'} did not ask for control; choose from those who did"
                    if to
                    else "nobody asked for control; keep control or give it up",
                )
            return to
    return ""


def require_holder(folder: Path, person: Person) -> None:
    """Raise `Refusal` unless the person controls the run in a folder and is at least an operator."""
    person.require(Role.OPERATOR)
    holder = read_holding(folder).holder
    if holder != person.name:
        raise Refusal(
            403,
            f"{holder or 'nobody'} is in control; {'ask for' if holder else 'take'} control first",
        )
