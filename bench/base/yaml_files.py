"""YAML files written by people: parsed without tags, validated, mistakes reported with line and remedy."""

from __future__ import annotations

import difflib
import hashlib
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails
from yaml.composer import ComposerError
from yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    StreamEndEvent,
)

from bench.base.files import MEGABYTE, read_regular
from bench.base.languages import message
from bench.base.text import QUOTED, shortened

# --- YAML text --------------------------------------------------------------------------------------

Place = tuple[str | int, ...]
"""A place in a file: keys and positions in lists (from 0), such as ("steps", 0, "turn")."""

MOST_TOLD: Final = 200
"""The most mistakes reported for one file; further mistakes are reported once these are corrected."""

_EXPECTED: Final = {
    "int_parsing": message("a whole number"),
    "int_parsing_size": message("a whole number"),
    "int_type": message("a whole number"),
    "int_from_float": message("a whole number"),
    "float_parsing": message("a number"),
    "float_type": message("a number"),
    "finite_number": message("a finite number"),
    "bool_parsing": message("yes or no"),
    "bool_type": message("yes or no"),
    "string_type": message("a text"),
    "string_too_short": message("a text that is not empty"),
    "list_type": message("a list"),
    "tuple_type": message("a list"),
    "dict_type": message("keys with values"),
    "model_type": message("keys with values"),
    "model_attributes_type": message("keys with values"),
    "greater_than": message("more than {0}"),
    "greater_than_equal": message("{0} or more"),
    "less_than": message("less than {0}"),
    "less_than_equal": message("{0} or less"),
    "too_short": message("a list of at least {0}"),
    "too_long": message("a list of at most {0}"),
}
_LIMITS: Final = ("gt", "ge", "lt", "le", "min_length", "max_length")


def explained(
    error: ValidationError, model: type[BaseModel], lines: Mapping[Place, int]
) -> Iterator[tuple[Place, str]]:
    """Yield the place and a sentence for each error that the validation of `model` found.

    `lines` maps each place to its line in the file. A misspelt key is reported only as misspelt, not also as
    missing.
    """
    details = error.errors()[:MOST_TOLD]
    misspelt = {
        (*detail["loc"][:-1], _nearest(str(detail["loc"][-1]), _keys(model, detail["loc"][:-1])))
        for detail in details
        if detail["type"] == "extra_forbidden"
    }
    for detail in details:
        place = _written(detail["loc"], lines)
        match detail["type"]:
            case "missing":
                if detail["loc"] not in misspelt:
                    yield place, message(f"'{detail['loc'][-1]}' is missing")
            case "extra_forbidden":
                yield (
                    place,
                    unknown_word(str(place[-1]), sorted(_keys(model, detail["loc"][:-1])), message("key")),
                )
            case "literal_error" | "enum":
                yield place, _wrong_word(detail)
            case "too_short" if len(detail["input"]) >= (detail.get("ctx") or {})["min_length"]:
                pass  # the list is long enough: only its members are wrong, and are reported themselves
            case _:
                yield place, _wrong_value(detail)


def unknown_word(word: str, known: list[str], what: str) -> str:
    """Return the error sentence for a `word` that is misplaced or not in `known`; `what` is its kind ("key").

    For an unknown word the sentence suggests the nearest known word.
    """
    if word in known:
        return message(f"'{word}' does not fit the other keys here; remove it or them")
    near = _nearest(word, known)
    hint = message(f"did you mean '{near}'? ") if near else ""
    return message(f"unknown {what} '{shortened(word)}'; {hint}known: {', '.join(known)}")


def _nearest(word: str, known: Iterable[str]) -> str | None:
    if len(word) > QUOTED:
        return None
    near = difflib.get_close_matches(word, sorted(known), n=1, cutoff=0.5)
    return near[0] if near else None


def _written(location: tuple[int | str, ...], lines: Mapping[Place, int]) -> Place:
    """Return the location of a pydantic error as a place in the file.

    The names of alternative models, which pydantic adds to the location, are left out.
    """
    place: Place = ()
    for step in location:
        if (*place, step) in lines:
            place = (*place, step)
    return place


def _got(value: object) -> str:
    match value:
        case dict():
            return message("keys with values")
        case list():
            return message(f"a list of {len(value)}")
        case None:
            return message("nothing")
        case _:
            return f"'{shortened(str(value))}'"


def _wrong_word(detail: ErrorDetails) -> str:
    context: dict[str, Any] = detail.get("ctx") or {}
    expected = str(context.get("expected", "")).replace("'", "")
    known = [word.strip() for word in expected.replace(" or ", ",").split(",")]
    near = _nearest(str(detail["input"]), known)
    hint = message(f"; did you mean '{near}'?") if near else ""
    return message(f"expected {expected}, got {_got(detail['input'])}{hint}")


def _wrong_value(detail: ErrorDetails) -> str:
    context: dict[str, Any] = detail.get("ctx") or {}
    if detail["type"] == "value_error":
        return str(context["error"])
    if detail["type"] in _EXPECTED:
        limits = [context[name] for name in _LIMITS if name in context]
        expected = _EXPECTED[detail["type"]].format(*limits)
        return message(f"expected {expected}, got {_got(detail['input'])}")
    return f"{detail['msg'][:1].lower()}{detail['msg'][1:]}, got {_got(detail['input'])}"


def _keys(annotation: Any, location: tuple[int | str, ...]) -> set[str]:
    """Return the keys allowed at a location of a model, as written in files (aliases)."""
    models = list(_models(annotation))
    for position, step in enumerate(location):
        named = [m.model_fields for m in models]
        fields = [f for m in named for name, f in m.items() if step in {name, f.alias}]
        if fields:
            rest = location[position + 1 :]
            return set().union(*(_keys(f.annotation, rest) for f in fields))
        chosen = [m for m in models if any(step in get_args(f.annotation) for f in m.model_fields.values())]
        models = (
            chosen or models
        )  # this part of the location chooses a model of a union, such as that of a driver
    return {f.alias or name for m in models for name, f in m.model_fields.items()}


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models in an annotation: itself, its alternatives, members of lists and mappings."""
    if isinstance(annotation, type) and not get_args(annotation) and issubclass(annotation, BaseModel):
        annotation.model_rebuild()  # resolves forward references to models defined later in the module
        yield from getattr(annotation, "alternatives", tuple)() or (annotation,)
    elif get_origin(annotation) is Annotated:
        yield from _models(get_args(annotation)[0])
    elif get_origin(annotation) in {Union, types.UnionType, list, tuple, dict}:
        for argument in get_args(annotation):
            yield from _models(argument)


MOST_DEEP: Final = 100
"""The deepest nesting of lists and mappings accepted; a real procedure has about twenty levels."""

_PLAIN_TAGS: Final = frozenset(
    f"tag:yaml.org,2002:{name}"
    for name in ("str", "int", "float", "bool", "null", "timestamp", "seq", "map", "merge", "value")
)
_NULL: Final = "tag:yaml.org,2002:null"
_NULLS: Final = frozenset({"", "~", "null", "Null", "NULL"})
"""Unquoted words that mean None."""

_Parser: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The YAML parser: the C implementation if available."""


class TooDeep(yaml.MarkedYAMLError):
    """Raised for lists and mappings nested too deep."""


@dataclass
class Written:
    """A parsed YAML text: its data, the line of every place, and its slips.

    `data` consists of mappings, lists and texts; an empty value is None. `slips` are constructs that YAML allows
    but bench files do not, each with its line, its place and a sentence.
    """

    data: Any = None
    lines: dict[Place, int] = field(default_factory=dict)
    slips: list[tuple[int, Place, str]] = field(default_factory=list)


def read_yaml(text: str) -> Written:
    """Parse a text. Raises `yaml.YAMLError` for invalid YAML."""
    reader = _Reader(text)
    reader.found.data = reader.document()
    return reader.found


class _Reader:
    """A parser that passes once over the YAML events of a text; it notes lines and slips in `found`."""

    def __init__(self, text: str) -> None:
        self._next: Callable[[], Any] = _Parser(text).get_event
        self._anchors: dict[str, Any] = {}
        self.found = Written()

    def document(self) -> Any:
        """Return the value of the text's only document, None if the text is empty."""
        self._next()  # start of the stream
        begun = self._next()
        if isinstance(begun, StreamEndEvent):
            return None
        first = self._next()
        self.found.lines[()] = _line(first)
        data = self._value(first, (), 0)
        self._next()  # end of the document
        if not isinstance(after := self._next(), StreamEndEvent):
            raise ComposerError(
                "expected a single document in the stream",
                begun.start_mark,
                "but found another document",
                after.start_mark,
            )
        return data

    def _value(self, event: Any, place: Place, deep: int) -> Any:
        """Return the value (scalar, list or mapping) that begins with `event`; `deep` is its nesting level."""
        if deep >= MOST_DEEP:
            raise _too_deep(event)
        if event.anchor is not None:
            self._anchor(event)
            if isinstance(event, AliasEvent):
                line = self._anchors[event.anchor].line + 1
                self._slip(
                    line, place, "anchors and aliases (& and *) are not allowed here; write the value out"
                )
                return None
        tag = event.tag
        if tag is not None and tag not in _PLAIN_TAGS and tag != "!":
            self._slip(_line(event), place, f"the tag {tag!r} is not allowed; remove it")
        if isinstance(event, ScalarEvent):
            text = event.value
            is_nothing = tag == _NULL or (text in _NULLS and tag in _NEUTRAL_TAGS and event.implicit[0])
            return None if is_nothing else text
        if isinstance(event, MappingStartEvent):
            return self._mapping(place, deep + 1)
        return self._list(place, deep + 1)

    def _list(self, place: Place, deep: int) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := self._next(), SequenceEndEvent):
            inside = (*place, len(items))
            self.found.lines[inside] = _line(event)
            items.append(self._value(event, inside, deep))
        return items

    def _mapping(self, place: Place, deep: int) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        while not isinstance(key := self._next(), MappingEndEvent):
            if not isinstance(key, ScalarEvent):
                self._slip(_line(key), place, "a key must be a plain word")
                self._skip(key, deep)
                self._skip(self._next(), deep)
                continue
            if key.anchor is not None:
                self._anchor(key)
            name, line = sys.intern(key.value), _line(key)
            inside = (*place, name)
            if name in mapping:
                first = self.found.lines[inside]
                self._slip(line, place, f"'{name}' appears here again, first in line {first}; leave one out")
                self._skip(self._next(), deep)
                continue
            self.found.lines[inside] = line
            mapping[name] = self._value(self._next(), inside, deep)
        return mapping

    def _skip(self, event: Any, deep: int) -> None:
        """Skip the value that begins with `event`, but record its anchors."""
        open_ones = 0
        while True:
            if deep + open_ones >= MOST_DEEP:
                raise _too_deep(event)
            if getattr(event, "anchor", None) is not None:
                self._anchor(event)
            open_ones += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
            if not open_ones:
                return
            event = self._next()

    def _anchor(self, event: Any) -> None:
        """Record an anchor. Raises `ComposerError` for a duplicate, or for an alias without an anchor."""
        first, here = self._anchors.get(event.anchor), event.start_mark
        if isinstance(event, AliasEvent):
            if first is None:
                raise ComposerError(None, None, f"found undefined alias {event.anchor!r}", here)
            return
        if first is not None:
            about = f"found duplicate anchor {event.anchor!r}; first occurrence"
            raise ComposerError(about, first, "second occurrence", here)
        self._anchors[event.anchor] = here

    def _slip(self, line: int, place: Place, text: str) -> None:
        self.found.slips.append((line, place, text))


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def _too_deep(event: Any) -> TooDeep:
    problem = f"lists and keys are nested more than {MOST_DEEP} levels deep; simplify the file"
    return TooDeep(problem=problem, problem_mark=event.start_mark)


_NEUTRAL_TAGS: Final = (None, "!")
"""Tags without effect, which are accepted."""


# --- files with a model -----------------------------------------------------------------------------
# Scalars stay text as written (`serial: 0012` stays "0012"); models such as those in `bench.config.bench_file.file`
# convert them, `3e-4 g` to a quantity.

_SHORT: Final = 100_000
"""An invalid text of at most this many characters is parsed again by PyYAML, for a better error message."""


@dataclass(frozen=True, order=True)
class FileMistake:
    """A mistake in a file: its line (from 1; 0 if unknown), place ("stand.axis_tilt.limit") and description.

    `file` is the included file with the mistake, empty for the main file.
    """

    line: int
    place: str
    text: str
    file: str = ""


class FileMistakes(Exception):
    """A file that cannot be used. The message has one line per mistake: "file:line: place: description"."""

    def __init__(self, path: Path | str, mistakes: Iterable[FileMistake]) -> None:
        self.path = Path(path)
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(self._sentence(mistake) for mistake in self.mistakes))

    def _sentence(self, mistake: FileMistake) -> str:
        where = f"{mistake.file or self.path}" + (f":{mistake.line}" if mistake.line else "")
        return ": ".join(part for part in (where, mistake.place, mistake.text) if part)


class FileModel(BaseModel):
    """Base class of models of files and their parts: frozen, without unknown keys, NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, str_min_length=1, defer_build=True
    )

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield the inconsistencies between parts of the file, each as (place, sentence); none by default.

        `data` is the parsed file before validation. Parts that are invalid by themselves are skipped.
        """
        return ()

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the models that a file may use instead of this one, such as one for each driver. Default: none."""
        return ()


@dataclass
class Document:
    """A parsed file: its data, its `text`, and the lines of its places.

    `data` consists of mappings, lists and texts; an empty value is None.
    """

    path: Path
    data: Any
    sha256: str
    text: str
    lines: dict[Place, int]
    mistakes: list[FileMistake]

    def line_of(self, place: Place) -> int:
        """Return the line of a place, or of the nearest enclosing place in the file; 0 if there is none."""
        for end in range(len(place), -1, -1):
            if place[:end] in self.lines:
                return self.lines[place[:end]]
        return 0

    def mistake(self, place: Place, text: str) -> FileMistake:
        """Return a `FileMistake` for a place in this file, with its line."""
        return FileMistake(self.line_of(place), dotted(place), text)


def dotted(place: Place) -> str:
    """Return a place for display: `instruments.voltmeters[1].resource`, list positions counted from 1."""
    path = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in place)
    return path.removeprefix(".")


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of the file's bytes, in hexadecimal."""
    return hashlib.sha256(read_regular(path)).hexdigest()


# --- reading ----------------------------------------------------------------------------------------


def load_document(path: Path, most_bytes: int = MEGABYTE) -> Document:
    """Parse a file; duplicate keys, aliases and tags are noted in `mistakes`.

    Raises `FileMistakes` if the file is missing, irregular, larger than `most_bytes`, not UTF-8 text, empty, or
    invalid YAML.
    """
    return document_of(path, _content(path, most_bytes))


def document_of(path: Path, content: bytes) -> Document:
    """Parse `content`, which was already read from the file `path`. Raises `FileMistakes`, like `load_document`."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise _unusable(
            path, message("the file is not UTF-8 text; save it as UTF-8 and try again"), line
        ) from None
    try:
        written = read_yaml(text)
    except yaml.YAMLError as error:
        raise _not_yaml(path, text, error) from None
    if written.data is None:
        raise _unusable(path, message("the file is empty; write it, or name another file"))
    mistakes = [FileMistake(line, dotted(place), told) for line, place, told in written.slips]
    return Document(path, written.data, hashlib.sha256(content).hexdigest(), text, written.lines, mistakes)


def _content(path: Path, most_bytes: int) -> bytes:
    try:
        return read_regular(path, most_bytes)
    except FileNotFoundError:
        text = message("there is no such file; check the name")
    except IsADirectoryError:
        text = message("this is a folder; name a file in it")
    except PermissionError as error:
        text = message(f"the file cannot be read ({error.strerror}); check its permissions")
    except OSError as error:
        size = message(f"{most_bytes / MEGABYTE:g} MB")
        text = message(f"the file cannot be read ({error.strerror}); name a regular file of at most {size}")
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
        reason = str(error).splitlines()[0] if str(error) else message("it cannot be read")
        return _unusable(path, message(f"this is not YAML: {reason}"))
    mark = error.problem_mark or error.context_mark
    context = f" {error.context}" if error.context else ""
    problem = message(f"this is not YAML: {error.problem or 'it cannot be read'}{context}")
    return _unusable(path, _hinted(problem), mark.line + 1 if mark else 0)


def _hinted(problem: str) -> str:
    if "'\\t'" in problem:
        return message(f"{problem}; indent with spaces, not with tabs")
    if "mapping values are not allowed" in problem:
        return message(f"{problem}; put a text with a colon in quotes, and check the indentation")
    if "expected <block end>" in problem:
        return message(f"{problem}; check the indentation of this line")
    return problem


# --- validating -------------------------------------------------------------------------------------

Model = TypeVar("Model", bound=FileModel)


def load_validated(path: Path, model: type[Model]) -> Model:
    """Parse a file and return it as an instance of `model`. Raises `FileMistakes` like `validated`."""
    return validated(load_document(path), model)


def validated(document: Document, model: type[Model], context: Any = None) -> Model:
    """Return a document's data as an instance of `model`. Raises `FileMistakes` with up to `MOST_TOLD` lines.

    The validators of `model` receive the `context` (`pydantic.ValidationInfo`).
    """
    mistakes = list(document.mistakes)
    result = None
    try:
        result = model.model_validate(document.data, context=context)
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
    last = FileMistake(mistakes[-1].line, "", "more mistakes follow: correct these first, then check again")
    return [*mistakes[: MOST_TOLD - 1], last]


def part(data: Any, *place: str | int) -> Any:
    """Return the part of `data` at a place, None if it does not exist (for `FileModel.cross_checks`)."""
    for step in place:
        entries = dict(enumerate(data)) if isinstance(data, list) else data
        if not isinstance(entries, dict) or step not in entries:
            return None
        data = entries[step]
    return data
