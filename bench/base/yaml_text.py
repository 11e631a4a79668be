"""YAML text to mappings, lists and texts, straight from the parser's events: no nodes are made, no tags resolved.

Lines are noted only where they are asked for: those of a hundred thousand steps take more than the steps.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import yaml
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

from bench.base.form_mistakes import Place

MOST_DEEP: Final = 100
"""Lists and mappings in each other; a procedure of ours has about twenty."""

_PLAIN_TAGS: Final = frozenset(
    f"tag:yaml.org,2002:{name}"
    for name in ("str", "int", "float", "bool", "null", "timestamp", "seq", "map", "merge", "value")
)
_NULL: Final = "tag:yaml.org,2002:null"
_NULLS: Final = frozenset({"", "~", "null", "Null", "NULL"})
"""What stands for nothing where it is written without quotes."""

_Parser: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""In C where it is there."""


class TooDeep(yaml.MarkedYAMLError):
    """Lists and mappings stand too deep in each other."""


@dataclass
class Written:
    """What a text says: `data` of mappings, lists and texts (None for nothing), the line of every place.

    `slips` are what YAML allows and we do not, each with its line, its place and a sentence.
    """

    data: Any = None
    lines: dict[Place, int] = field(default_factory=dict)
    slips: list[tuple[int, Place, str]] = field(default_factory=list)


def read_yaml(text: str) -> Written:
    """Read a text; `lines` stays empty where there are no slips. Raises `yaml.YAMLError` for what is no YAML."""
    try:
        return Written(_Reader(text, None).document())
    except _Slipped:
        return read_yaml_with_lines(text)


def read_yaml_with_lines(text: str) -> Written:
    """Read a text with the line of every place. Raises `yaml.YAMLError` for what is no YAML."""
    found = Written()
    found.data = _Reader(text, found).document()
    return found


class _Slipped(Exception):
    """There are slips, which are told with lines."""


class _Reader:
    """Goes through the events of a text once; without `noting`, raises `_Slipped` at the first slip."""

    def __init__(self, text: str, noting: Written | None) -> None:
        self._next: Callable[[], Any] = _Parser(text).get_event
        self._noting = noting
        self._anchors: dict[str, Any] = {}

    def document(self) -> Any:
        """Return what the text's one document says; None where it is empty."""
        self._next()  # the stream's beginning
        begun = self._next()
        if isinstance(begun, StreamEndEvent):
            return None
        first = self._next()
        if self._noting is not None:
            self._noting.lines[()] = _line(first)
        data = self._value(first, (), 0)
        self._next()  # the document's end
        if not isinstance(after := self._next(), StreamEndEvent):
            raise ComposerError(
                "expected a single document in the stream",
                begun.start_mark,
                "but found another document",
                after.start_mark,
            )
        return data

    def _value(self, event: Any, place: Place, deep: int) -> Any:
        """Return what begins with an event."""
        if deep >= MOST_DEEP:
            raise _too_deep(event)
        if event.anchor is not None:
            self._anchor(event)
            if isinstance(event, AliasEvent):
                line = self._anchors[event.anchor].line + 1
                self._slip(
                    line, place, "anchors and aliases (& and *) are not understood here; write the value out"
                )
                return None
        tag = event.tag
        if tag is not None and tag not in _PLAIN_TAGS and tag != "!":
            self._slip(_line(event), place, f"the tag {tag!r} is not understood; leave it out")
        if isinstance(event, ScalarEvent):
            text = event.value
            is_nothing = tag == _NULL or (text in _NULLS and tag in _UNTOLD and event.implicit[0])
            return None if is_nothing else text
        if isinstance(event, MappingStartEvent):
            return self._mapping(place, deep + 1)
        return self._list(place, deep + 1)

    def _list(self, place: Place, deep: int) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := self._next(), SequenceEndEvent):
            inside = place
            if self._noting is not None:
                inside = (*place, len(items))
                self._noting.lines[inside] = _line(event)
            items.append(self._value(event, inside, deep))
        return items

    def _mapping(self, place: Place, deep: int) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        while not isinstance(key := self._next(), MappingEndEvent):
            if not isinstance(key, ScalarEvent):
                self._slip(_line(key), place, "a key must be a plain word")
                self._pass_over(key, deep)
                self._pass_over(self._next(), deep)
                continue
            if key.anchor is not None:
                self._anchor(key)
            name, inside = sys.intern(key.value), place
            if name in mapping:
                self._slip_again(_line(key), place, name)
                self._pass_over(self._next(), deep)
                continue
            if self._noting is not None:
                inside = (*place, name)
                self._noting.lines[inside] = _line(key)
            mapping[name] = self._value(self._next(), inside, deep)
        return mapping

    def _pass_over(self, event: Any, deep: int) -> None:
        """Leave out what begins with an event, but for its anchors."""
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
        """Keep where an anchor stands; refuse a second one of its name, and an alias for none."""
        first, here = self._anchors.get(event.anchor), event.start_mark
        if isinstance(event, AliasEvent):
            if first is None:
                raise ComposerError(None, None, f"found undefined alias {event.anchor!r}", here)
            return
        if first is not None:
            about = f"found duplicate anchor {event.anchor!r}; first occurrence"
            raise ComposerError(about, first, "second occurrence", here)
        self._anchors[event.anchor] = here

    def _slip_again(self, line: int, place: Place, name: str) -> None:
        first = self._noting.lines[(*place, name)] if self._noting is not None else 0
        self._slip(line, place, f"'{name}' stands here a second time, first in line {first}; leave one out")

    def _slip(self, line: int, place: Place, text: str) -> None:
        if self._noting is None:
            raise _Slipped
        self._noting.slips.append((line, place, text))


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def _too_deep(event: Any) -> TooDeep:
    problem = f"lists and keys stand more than {MOST_DEEP} deep in each other"
    return TooDeep(problem=problem, problem_mark=event.start_mark)


_UNTOLD: Final = (None, "!")
"""Tags that say nothing."""
