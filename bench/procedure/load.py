"""Procedures, `procedures/*.yaml`: read with what they include, checked, expanded to a flat plan."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bench.base.form_mistakes import Place
from bench.base.forms import Document, FileMistake, FileMistakes, load_document, part, validated
from bench.procedure.check import check
from bench.procedure.expansion import Expansion
from bench.procedure.file import IncludedFile, ProcedureFile
from bench.procedure.plan import Plan

__all__ = ["Procedure", "check", "load_procedure"]

_INCLUDE: Final = "include"


@dataclass(frozen=True)
class Procedure:
    """A procedure with the files that it includes; `files` has them in the order of reading, itself first."""

    name: str
    title: str
    files: tuple[Path, ...]
    sha256: str
    plan: Plan

    def expand(self) -> Plan:
        """Return the flat plan; it was expanded when the procedure was checked."""
        return self.plan


def load_procedure(path: Path) -> Procedure:
    """Read and check a procedure. Raises `FileMistakes` with every mistake in it and in what it includes."""
    tree = _Tree(path)
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
    """A procedure file and everything it includes, by resolved path, with the mistakes in all of them."""

    def __init__(self, path: Path) -> None:
        self.documents: dict[Path, Document] = {}
        self.files: dict[Path, IncludedFile] = {}
        self.mistakes: list[FileMistake] = []
        self._root = load_document(path)
        self._read(self._root, ProcedureFile, ())
        self._check_scopes(
            self._root, part(self._root.data, "steps"), ("steps",), _Scope(chain=(path.resolve(),))
        )

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes of all files together; of one file alone it is the file's own."""
        digests = [document.sha256 for document in self.documents.values()]
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def located(self, document: Document, mistake: FileMistake) -> FileMistake:
        """Return the mistake with the name of its file, where that is an included one."""
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
                self._include(document, place, body, (*chain, here))

    def _include(self, document: Document, place: Place, name: str, chain: tuple[Path, ...]) -> None:
        path = document.path.parent / name
        problem = ""
        if path.resolve() in chain:
            circle = [*chain[chain.index(path.resolve()) :], path]
            problem = f"the file includes itself: {' → '.join(p.name for p in circle)}"
        elif path.resolve() not in self.documents:
            try:
                included = load_document(path)
            except FileMistakes as error:
                if path.is_file():
                    self.mistakes += [replace(mistake, file=str(path)) for mistake in error.mistakes]
                else:
                    problem = str(error)
            else:
                self._read(included, IncludedFile, chain)
        if problem:
            self.mistakes.append(self.located(document, document.mistake((*place, _INCLUDE), problem)))

    def _check_scopes(self, document: Document, steps: Any, place: Place, scope: _Scope) -> None:
        """Check that every verb stands where it may; works on what is written, right or wrong."""
        for entry, verb, body in _entries(steps, place):
            problem = scope.problem(verb)
            if problem:
                self.mistakes.append(self.located(document, document.mistake((*entry, verb), problem)))
            inner = scope.inside(verb)
            if verb == _INCLUDE and isinstance(body, str):
                path = (document.path.parent / body).resolve()
                if path in self.documents and path not in scope.chain:
                    included = self.documents[path]
                    entered = replace(inner, chain=(*scope.chain, path))
                    self._check_scopes(included, part(included.data, "steps"), ("steps",), entered)
            else:
                self._check_scopes(document, part(body, "steps"), (*entry, verb, "steps"), inner)


@dataclass(frozen=True)
class _Scope:
    """What a step stands in: the verbs around it, and the files that lead to it."""

    within: frozenset[str] = frozenset()
    chain: tuple[Path, ...] = ()

    def inside(self, verb: str) -> _Scope:
        """Return the scope of the steps of a verb."""
        return replace(self, within=self.within | {verb})

    def problem(self, verb: str) -> str:
        """Return why a verb cannot stand here, empty where it can."""
        text = ""
        match verb:
            case _ if "input" in self.within:
                if verb in _NOT_IN_AN_INPUT:
                    text = f"{_a(verb)} stands inside an input, where no signal is connected; end it before"
            case "installation" if verb in self.within:
                text = "an installation stands inside another; end the first one before it"
            case "temperatures" if verb in self.within:
                text = "a list of temperatures stands inside another; put all into one"
            case "turn" | "read" if "installation" not in self.within:
                text = f"a {verb} stands outside of an installation: nobody knows how the block is mounted"
            case "read" if "turn" not in self.within:
                text = "a read stands outside of a turn: put it into the turn's steps"
            case "turn" | "repeat" | "temperatures" if "turn" in self.within:
                text = f"{_a(verb)} stands inside the steps of a turn; put it around the turn"
        return text


_NOT_IN_AN_INPUT: Final = frozenset({"turn", "installation", "input", "temperature", "temperatures"})


def _a(verb: str) -> str:
    """Return what a verb stands for, with its article."""
    return "a list of temperatures" if verb == "temperatures" else f"a{'n' * (verb[0] in 'ai')} {verb}"


def _entries(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step of a list as written."""
    for index, entry in enumerate(steps if isinstance(steps, list) else []):
        for verb, body in entry.items() if isinstance(entry, dict) else ():
            yield (*place, index), verb, body


def _walk(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step, those inside others too."""
    for entry, verb, body in _entries(steps, place):
        yield entry, verb, body
        yield from _walk(part(body, "steps"), (*entry, verb, "steps"))
