"""YAML files that people write: read with the line of every key, validated with all mistakes at once.

Scalars keep the text that was written (`serial: 0012` stays "0012", `3e-4 g` a quantity); the models of
`bench.config.bench_file.file` and others say what each must be.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from bench.base.files import MEGABYTE, read_regular
from bench.base.yaml_text import MOST_TOLD, Place, TooDeep, explained, read_yaml, read_yaml_with_lines

_SHORT: Final = 100_000
"""Characters of a text that is read a second time for a better sentence about what is wrong with it."""


@dataclass(frozen=True, order=True)
class FileMistake:
    """One mistake: line (1…, 0 where there is none), place ("stand.axis_tilt.limit"), what is wrong.

    `file` is the included file that it stands in, empty for the file that was asked for.
    """

    line: int
    place: str
    text: str
    file: str = ""


class FileMistakes(Exception):
    """A file that cannot be used. Its text has a line for each mistake: "file:line: place: what is wrong"."""

    def __init__(self, path: Path | str, mistakes: Iterable[FileMistake]) -> None:
        self.path = Path(path)
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(self._sentence(mistake) for mistake in self.mistakes))

    def _sentence(self, mistake: FileMistake) -> str:
        where = f"{mistake.file or self.path}" + (f":{mistake.line}" if mistake.line else "")
        return ": ".join(part for part in (where, mistake.place, mistake.text) if part)


class FileModel(BaseModel):
    """Base of everything that a file may say: frozen, an unknown key is a mistake, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, str_min_length=1)

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield mistakes that are between parts of the file, each with its place; none for most.

        `data` is the file as written, with whatever else is wrong in it: what cannot be read is passed over.
        """
        return ()

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the models one of which stands where this one is named, by a word in it; none for most."""
        return ()


@dataclass
class Document:
    """A file's content: mappings, lists and texts (None for nothing), and the `text` that says so."""

    path: Path
    data: Any
    sha256: str
    text: str
    mistakes: list[FileMistake] = field(default_factory=list)

    @cached_property
    def lines(self) -> dict[Place, int]:
        """The line of every place; the text is read again for it, since most files have no mistake to tell."""
        return read_yaml_with_lines(self.text).lines

    def line_of(self, place: Place) -> int:
        """Return the line of a place, or of the nearest place around it that was written."""
        for end in range(len(place), -1, -1):
            if place[:end] in self.lines:
                return self.lines[place[:end]]
        return 0

    def mistake(self, place: Place, text: str) -> FileMistake:
        """Return a mistake at a place of this file."""
        return FileMistake(self.line_of(place), dotted(place), text)


def dotted(place: Place) -> str:
    """Return a place as a person reads it: `instruments.voltmeters[1].resource`, lists counted from 1."""
    path = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in place)
    return path.removeprefix(".")


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of the file's bytes, in hexadecimal."""
    return hashlib.sha256(read_regular(path)).hexdigest()


# --- reading ----------------------------------------------------------------------------------------


def load_document(path: Path, most_bytes: int = MEGABYTE) -> Document:
    """Read a file with its lines; duplicate keys, aliases and tags are noted in `mistakes`.

    Raises `FileMistakes` where the file is missing, is no regular file, has more than `most_bytes`, is not UTF-8
    text, is empty or is not YAML.
    """
    content = _content(path, most_bytes)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise _unusable(path, "the file is not UTF-8 text; save it as UTF-8 and try again", line) from None
    try:
        written = read_yaml(text)
    except yaml.YAMLError as error:
        raise _not_yaml(path, text, error) from None
    if written.data is None:
        raise _unusable(path, "the file is empty; 'bench init' writes files to start from")
    mistakes = [FileMistake(line, dotted(place), told) for line, place, told in written.slips]
    return Document(path, written.data, hashlib.sha256(content).hexdigest(), text, mistakes)


def _content(path: Path, most_bytes: int) -> bytes:
    try:
        return read_regular(path, most_bytes)
    except FileNotFoundError:
        text = "there is no such file; check the name"
    except IsADirectoryError:
        text = "this is a folder; name a file in it"
    except OSError as error:
        text = f"the file cannot be read ({error.strerror})"
    raise _unusable(path, text)


def _unusable(path: Path, text: str, line: int = 0) -> FileMistakes:
    return FileMistakes(path, [FileMistake(line, "", text)])


def _not_yaml(path: Path, text: str, error: yaml.YAMLError) -> FileMistakes:
    if len(text) <= _SHORT and not isinstance(error, TooDeep):
        try:
            yaml.compose(text, Loader=yaml.SafeLoader)
        except yaml.YAMLError as better_told:
            error = better_told
        except RecursionError:
            pass
    if not isinstance(error, yaml.MarkedYAMLError):
        reason = str(error).splitlines()[0] if str(error) else "it cannot be read"
        return _unusable(path, f"this is not YAML: {reason}")
    mark = error.problem_mark or error.context_mark
    context = f" {error.context}" if error.context else ""
    problem = f"this is not YAML: {error.problem or 'it cannot be read'}{context}"
    return _unusable(path, _hinted(problem), mark.line + 1 if mark else 0)


def _hinted(problem: str) -> str:
    """Add what usually is behind the parser's complaint."""
    if "'\\t'" in problem:
        return f"{problem}; indent with spaces, not with tabs"
    if "mapping values are not allowed" in problem:
        return f"{problem}; put a text with a colon in quotes, and check the indentation"
    if "expected <block end>" in problem:
        return f"{problem}; check the indentation of this line"
    return problem


# --- validating -------------------------------------------------------------------------------------

Model = TypeVar("Model", bound=FileModel)


def load_validated(path: Path, model: type[Model]) -> Model:
    """Read a file and return it as `model`. Raises `FileMistakes` with every mistake in it."""
    return validated(load_document(path), model)


def validated(document: Document, model: type[Model]) -> Model:
    """Return a document's content as `model`. Raises `FileMistakes` with every mistake in it."""
    mistakes = list(document.mistakes)
    result = None
    try:
        result = model.model_validate(document.data)
    except ValidationError as error:
        mistakes += [document.mistake(place, text) for place, text in explained(error, model, document.lines)]
    crossed = islice(model.cross_checks(document.data), MOST_TOLD)
    mistakes += [document.mistake(place, text) for place, text in crossed]
    if result is None or mistakes:
        raise FileMistakes(document.path, _told(sorted(set(mistakes))))
    return result


def _told(mistakes: list[FileMistake]) -> list[FileMistake]:
    if len(mistakes) < MOST_TOLD:
        return mistakes
    last = FileMistake(mistakes[-1].line, "", "there are more mistakes; they are told when these are mended")
    return [*mistakes[: MOST_TOLD - 1], last]


def part(data: Any, *place: str | int) -> Any:
    """Return what stands at a place below `data`, or None where there is nothing (for cross checks)."""
    for step in place:
        entries = dict(enumerate(data)) if isinstance(data, list) else data
        if not isinstance(entries, dict) or step not in entries:
            return None
        data = entries[step]
    return data
