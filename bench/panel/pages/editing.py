"""The common part of the pages on which a person edits a file: show a form, take over what is sent, write it."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.languages import message
from bench.panel.access import STATE, Person, Refusal, Role
from bench.panel.bench_fields import Placed
from bench.panel.own_files import FileText, new_path, read_file, write_file
from bench.panel.round_trip import signed
from bench.panel.shared import Panel, acting, operator, panel_of
from drivers.clock import utc_now

LONGEST = 400
"""The longest text of a field, in characters."""


@dataclass
class EditedFile(ABC):
    """A file being edited in the panel: the file as it was read (`base`), its new `text`, and the page's messages.

    `name` is the name of the file. `start` is the name of the file that a new file copies; else it is empty.
    """

    KIND: ClassVar[str]
    MOST_FIELDS: ClassVar[int]
    CHANGED: ClassVar[str]
    """The refusal to write a file that somebody else has changed."""

    name: str
    start: str
    base: FileText
    text: str = ""
    placed: Placed = field(default_factory=Placed)
    still: frozenset[str] = frozenset()
    """The names of the fields that the laboratory must state itself and that still have the example's value."""
    note: str = ""
    refusal: str = ""
    difference: str = ""

    @classmethod
    @abstractmethod
    def _begun(cls, name: str, start: str, new_name: str) -> Self:
        """Return the file `name`, else a copy `new_name` of the file `start`. Raises `Refusal` if it is missing."""

    @abstractmethod
    def _open(self, asked: Mapping[str, str]) -> None:
        """Prepare the page for the parameters of its address."""

    @abstractmethod
    def _take(self, panel: Panel, given: Mapping[str, str]) -> None:
        """Take over the typed values, and carry out the action of the pressed button, unless it is to write."""

    @abstractmethod
    def _may_be_written(self, path: Path) -> bool:
        """Return whether the text has no mistakes; if it has any, set the page's refusal."""

    @property
    @abstractmethod
    def _address(self) -> str:
        """The address of the form of the written file."""

    @abstractmethod
    def _shown(self, request: Request) -> Response: ...

    @classmethod
    def form(cls, request: Request) -> Response:
        """Show the form of a file (`file`), or of a new one that begins as a copy of another (`start`)."""
        operator(request)
        asked = request.query_params
        state = cls._begun(asked.get("file", ""), asked.get("start", ""), asked.get("name", "").strip())
        state._open(asked)
        if state.name:
            state._judge_name()
        return state._shown(request)

    @classmethod
    async def sent(cls, request: Request) -> Response:
        """Carry out the action of the pressed button."""
        person, given = await acting(request, Role.OPERATOR, most=cls.MOST_FIELDS)
        return await run_in_threadpool(cls._sent, request, person, given)

    @classmethod
    def _sent(cls, request: Request, person: Person, given: Mapping[str, str]) -> Response:
        panel = panel_of(request)
        state = cls._begun(given.get("file", ""), given.get("start", ""), given.get("new_name", "").strip())
        state._take(panel, given)
        state._judge_name()
        wanted = given.get("do") == "write" and not state.refusal and "new_name" not in state.placed.at
        if wanted and state._write(panel, person, given.get("sha256", "")):
            return RedirectResponse(state._address, status_code=303)
        return state._shown(request)

    def _judge_name(self) -> None:
        """Add the mistake in the name of a new file to its field."""
        if self.start:
            try:
                new_path(self.KIND, self.name)
            except Refusal as refusal:
                self.placed.at.setdefault("new_name", []).append(refusal.text)

    def _write(self, panel: Panel, person: Person, expected_sha256: str) -> bool:
        """Write the text if it has no mistakes and nobody else changed the file; return whether it was written."""
        path = new_path(self.KIND, self.name) if self.start else self.base.path
        if not self._may_be_written(path):
            return False
        self.text = signed(self.text, person.name, utc_now())
        folder = panel.settings.runs / STATE
        if expected_sha256 == self.base.sha256 and write_file(path, self.text, expected_sha256, folder):
            return True
        self.difference, self.refusal = difference(read_file(path).text, self.text, path.name), self.CHANGED
        return False


def difference(before: str, after: str, name: str) -> str:
    """Return the lines in which two texts of a file differ: "-" marks those of `before`, "+" of `after`."""
    lines = difflib.unified_diff(
        before.splitlines(),
        after.splitlines(),
        message(f"{name} as it is"),
        message(f"{name} as written here"),
        lineterm="",
        n=1,
    )
    return "\n".join(lines)
