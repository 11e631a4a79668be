"""How wishes reach a run: typed at a prompt, or left in the run's folder by another program."""

from __future__ import annotations

import getpass
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from bench.base.files import open_regular
from bench.base.visible import in_json
from bench.run.states import Wish

CONTROL: Final = "control.jsonl"
SIGN: Final = ":"
"""A line at the terminal that begins with it is a wish: ":redo", ":skip the cable came loose"."""


@dataclass(frozen=True)
class Who:
    """Who wished or answered something, in which role ("operator", "supervisor"), and where.

    `where` is "terminal", "panel", or "command" for `bench control`. Old records do not say: then all are empty.
    """

    by: str = ""
    role: str = ""
    where: str = ""

    def to_json(self) -> dict[str, str]:
        """Return it as it stands in an event or a line left in a run's folder; nothing where it is not known."""
        told = {"by": self.by, "role": self.role, "where": self.where}
        return told if any(told.values()) else {}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> Who:
        """Return who an event, or a line left in a run's folder, says it was."""
        return cls(*(str(line.get(name, "")) for name in ("by", "role", "where")))


NOBODY_KNOWN: Final = Who()


def at_the_shell(where: str) -> Who:
    """Return who this program runs for: whoever has a shell in the runs' folder counts as a supervisor."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError, ImportError):  # no such user, or no such list of them
        name = ""
    return Who(name, "supervisor", where)


@dataclass(frozen=True)
class RunControl:
    """A wish, the reason given for it, whether the person at the prompt has it (or another program), and who."""

    wish: Wish
    reason: str = ""
    by_person: bool = False
    who: Who = NOBODY_KNOWN

    def to_json(self) -> dict[str, str]:
        """Return it as it is left in a run's folder."""
        return {"wish": self.wish.value, "reason": self.reason, **self.who.to_json()}

    def told(self) -> dict[str, str]:
        """Return the reason and who, as an event tells them."""
        return {"reason": self.reason, **self.who.to_json()}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> RunControl:
        """Return another program's wish. Raises `KeyError`, `TypeError`, `ValueError` for what is none."""
        return cls(Wish(line["wish"]), str(line.get("reason", "")), who=Who.from_json(line))


class OperatorWish(Exception):
    """The person answered a prompt with a wish; the step that asked is not done."""

    def __init__(self, control: RunControl) -> None:
        super().__init__(control.wish.value)
        self.control = control


class Stopped(KeyboardInterrupt):
    """Somebody wished the run to stop: what Ctrl-C is, with who it was."""

    def __init__(self, control: RunControl) -> None:
        super().__init__()
        self.control = control


def raised(control: RunControl) -> OperatorWish | Stopped:
    """Return the exception by which a wish leaves what is under way."""
    return Stopped(control) if control.wish is Wish.STOP else OperatorWish(control)


class Controls(Protocol):
    """Where wishes come from."""

    def poll(self) -> RunControl | None:
        """Return the next wish, None where there is none."""
        ...


class NoControls:
    """Nobody has a wish."""

    def poll(self) -> RunControl | None:
        """Return None."""
        return None


class ControlFile:
    """Wishes left in the folder of a run, one JSON line each; those that were there before count as heard."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / CONTROL
        self._heard = self._path.stat().st_size if self._path.exists() else 0

    def poll(self) -> RunControl | None:
        """Return the next wish; a half-written line waits, one that is no wish is passed over."""
        while (line := self._line()).endswith(b"\n"):
            self._heard += len(line)
            with suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
                return RunControl.from_json(json.loads(line))
        return None

    def _line(self) -> bytes:
        try:
            with open_regular(self._path) as file:
                file.seek(self._heard)
                return file.readline()
        except OSError:
            return b""


def leave_wish(folder: Path, control: RunControl) -> None:
    """Leave a wish in the folder of a run. Raises `OSError` where it cannot be written."""
    line = in_json(json.dumps(control.to_json(), ensure_ascii=False))
    with open_regular(folder / CONTROL, "ab") as file:
        file.write(line.encode() + b"\n")


def parse_wish(text: str) -> RunControl:
    """Read a wish as typed, such as ":skip the cable came loose", with or without the sign.

    Raises `ValueError` with the list of wishes for anything else, and for a skip without a reason.
    """
    word, _, reason = text.strip().removeprefix(SIGN).partition(" ")
    try:
        wish = Wish(word.lower())
    except ValueError:
        known = ", ".join(f"{SIGN}{w.value}" for w in Wish)
        raise ValueError(f"{SIGN}{word} is no wish; there are {known}") from None
    if wish is Wish.SKIP and not reason.strip():
        raise ValueError(f"say why: {SIGN}skip REASON")
    return RunControl(wish, reason.strip(), by_person=True)
