"""Procedures, `procedures/*.yaml`: read with their included files, checked, expanded to a flat plan."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bench.base.computing import uncollected
from bench.base.files import MEGABYTE
from bench.base.text import as_typed
from bench.base.yaml_files import (
    Document,
    FileMistake,
    FileMistakes,
    Place,
    document_of,
    load_document,
    part,
    validated,
)
from bench.config.procedure.check import check
from bench.config.procedure.expansion import Expansion
from bench.config.procedure.file import IncludedFile, ProcedureFile
from bench.config.procedure.plan import Plan

__all__ = ["Procedure", "check", "load_procedure"]

_INCLUDE: Final = "include"

MOST_BYTES: Final = 10 * MEGABYTE
"""Largest size of the procedure file, which a program may have written; included files have a lower limit."""

MOST_FILES: Final = 1_000
"""The most included files; more count as a mistake."""

MOST_DEEP: Final = 100
"""The greatest depth of files that include each other."""

_TOO_DEEP: Final = "steps and included files are nested too deeply; nest fewer"


@dataclass(frozen=True)
class Procedure:
    """A procedure with its plan; `files` lists its own file, then the included ones in reading order."""

    name: str
    title: str
    files: tuple[Path, ...]
    sha256: str
    plan: Plan

    def expand(self) -> Plan:
        """Return the flat plan, which was expanded when the procedure was loaded."""
        return self.plan


@uncollected()
def load_procedure(path: Path, content: bytes | None = None) -> Procedure:
    """Read and check a procedure. Raises `FileMistakes` with every mistake in it and its included files.

    If `content` is given, the file itself is not read, because it may not exist yet.
    """
    try:
        return _loaded(path, content)
    except RecursionError:
        raise FileMistakes(path, [FileMistake(0, "steps", _TOO_DEEP)]) from None


def _loaded(path: Path, content: bytes | None) -> Procedure:
    tree = _Tree(path, content)
    if tree.mistakes:
        raise FileMistakes(path, sorted(set(tree.mistakes), key=_in_order))
    root = tree.files[path.resolve()]
    expansion = Expansion(tree.documents, tree.files)
    steps = expansion.run(path.resolve())
    if expansion.mistakes:
        found = [tree.located(document, mistake) for document, mistake in expansion.mistakes]
        raise FileMistakes(path, sorted(set(found), key=_in_order))
    name = root.procedure or path.stem
    plan = Plan(name, steps, tree.sha256, root.operator_time.to_plan())
    return Procedure(name, root.title, tuple(d.path for d in tree.documents.values()), tree.sha256, plan)


def _in_order(mistake: FileMistake) -> tuple[str, int, str, str]:
    return mistake.file, mistake.line, mistake.place, mistake.text


class _Tree:
    """A procedure file and all included files, by resolved path, with the mistakes in all of them."""

    def __init__(self, path: Path, content: bytes | None) -> None:
        self.documents: dict[Path, Document] = {}
        self.files: dict[Path, IncludedFile] = {}
        self.mistakes: list[FileMistake] = []
        self._refused: dict[Path, str] = {}
        self._checked: set[tuple[Path, frozenset[str]]] = set()
        self._root = load_document(path, MOST_BYTES) if content is None else document_of(path, content)
        if not (isinstance(self._root.data, dict) and {"procedure", "steps"} & set(self._root.data)):
            text = "this is not a procedure: 'procedure' and 'steps' are missing"
            raise FileMistakes(path, [FileMistake(0, "", text)])
        self._read(self._root, ProcedureFile, ())
        self._check_scopes(self._root, part(self._root.data, "steps"), ("steps",), frozenset())

    @property
    def sha256(self) -> str:
        """The SHA-256 of the file's bytes; of several files, the SHA-256 of their concatenated hex digests."""
        digests = [document.sha256 for document in self.documents.values()]
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def located(self, document: Document, mistake: FileMistake) -> FileMistake:
        """Return the mistake; if it is in an included file, with the name of that file."""
        return mistake if document is self._root else replace(mistake, file=str(document.path))

    def _read(self, document: Document, model: type[IncludedFile], chain: tuple[Path, ...]) -> None:
        here = document.path.resolve()
        self.documents[here] = document
        try:
            self.files[here] = validated(document, model)
        except FileMistakes as error:
            self.mistakes += [self.located(document, mistake) for mistake in error.mistakes]
        for place, verb, body in _walk(part(document.data, "steps"), ("steps",)):
            if verb == _INCLUDE and isinstance(body, str):
                problem = self._include(document, body, (*chain, here))
                if problem:
                    at = document.mistake((*place, _INCLUDE), problem)
                    self.mistakes.append(self.located(document, at))

    def _include(self, document: Document, name: str, chain: tuple[Path, ...]) -> str:
        """Read an included file if it is new; return the reason why it cannot be included, or an empty text."""
        path = document.path.parent / name
        key = _resolved(path)
        if key in chain:
            circle = [*chain[chain.index(key) :], path]
            return f"the file includes itself, remove that: {' → '.join(p.name for p in circle)}"
        if key in self.documents:
            return ""
        if key not in self._refused:
            self._refused[key] = self._included(path, key, chain)
        return self._refused[key]

    def _included(self, path: Path, key: Path, chain: tuple[Path, ...]) -> str:
        if path.suffix.lower() not in _SUFFIXES or key.suffix.lower() not in _SUFFIXES:
            return f"{path}: name a file that ends with .yaml or .yml"
        if len(self.documents) > MOST_FILES:
            return f"more than {MOST_FILES} files are included; merge some"
        if len(chain) >= MOST_DEEP:
            return f"{path.name}: files are nested more than {MOST_DEEP} levels deep; include it further up"
        try:
            included = load_document(path)
        except FileMistakes as error:
            return self._unreadable(path, error.mistakes[0])
        if not (isinstance(included.data, dict) and "steps" in included.data):
            return f"{path}: this is not a procedure: 'steps' is missing"
        self._read(included, IncludedFile, chain)
        return ""

    def _unreadable(self, path: Path, mistake: FileMistake) -> str:
        """Return why an included file cannot be read; for a file that is not YAML, record a mistake and return "".

        The file is not quoted, since it may not be a procedure at all.
        """
        if not mistake.line:
            return f"{path}: {mistake.text}"
        told = f"this is not YAML in UTF-8; 'bench check {as_typed(path.name)}' shows the line"
        self.mistakes.append(FileMistake(mistake.line, "", told, str(path)))
        return ""

    def _check_scopes(self, document: Document, steps: Any, place: Place, within: frozenset[str]) -> None:
        """Check that every verb is allowed inside the verbs `within`; `steps` are as written, valid or not.

        An included file is checked once for each set of enclosing verbs, so that no mistake is reported twice.
        """
        for entry, verb, body in _entries(steps, place):
            if problem := _misplaced(verb, within):
                self.mistakes.append(self.located(document, document.mistake((*entry, verb), problem)))
            inner = within | {verb}
            if verb == _INCLUDE and isinstance(body, str):
                key = _resolved(document.path.parent / body)
                if key in self.documents and (key, inner) not in self._checked:
                    self._checked.add((key, inner))
                    included = self.documents[key]
                    self._check_scopes(included, part(included.data, "steps"), ("steps",), inner)
            elif steps_inside := part(body, "steps"):
                self._check_scopes(document, steps_inside, (*entry, verb, "steps"), inner)


_SUFFIXES: Final = frozenset({".yaml", ".yml"})


def _resolved(path: Path) -> Path:
    """Return a path with symbolic links resolved, or the path itself if that fails; reading it then reports why."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return path


def _misplaced(verb: str, within: frozenset[str]) -> str:
    """Return the reason why a verb is not allowed inside the verbs `within`; empty if it is allowed."""
    text = ""
    match verb:
        case _ if "input" in within:
            if verb in _NOT_IN_AN_INPUT:
                text = f"{_a(verb)} is inside an input, where no signal is connected; move it out"
        case "installation" if verb in within:
            text = "an installation is inside another; end the first one before it"
        case "temperatures" if verb in within:
            text = "a list of temperatures is inside another; merge them"
        case "turn" | "read" if "installation" not in within:
            text = f"a {verb} is outside of an installation; move it into the steps of one"
        case "read" if "turn" not in within:
            text = "a read is outside of a turn; move it into the turn's steps"
        case "turn" | "repeat" | "temperatures" | "level" if "turn" in within:
            text = f"{_a(verb)} is inside the steps of a turn; put it around the turn"
    return text


_NOT_IN_AN_INPUT: Final = frozenset(
    {"turn", "installation", "input", "temperature", "temperatures", "level", "power"}
)


def _a(verb: str) -> str:
    """Return the name of a verb's action with its article, such as "an installation"."""
    if verb == "power":
        return "a switching of the block"
    return "a list of temperatures" if verb == "temperatures" else f"a{'n' * (verb[0] in 'ai')} {verb}"


def _entries(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step in a list as written."""
    for index, entry in enumerate(steps if isinstance(steps, list) else []):
        for verb, body in entry.items() if isinstance(entry, dict) else ():
            yield (*place, index), verb, body


def _walk(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step in a list as written, nested steps included."""
    for entry, verb, body in _entries(steps, place):
        yield entry, verb, body
        if steps_inside := part(body, "steps"):
            yield from _walk(steps_inside, (*entry, verb, "steps"))
