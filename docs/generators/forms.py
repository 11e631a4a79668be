"""What files may say, from the models that read them: a section for each mapping, a row for each key."""

from __future__ import annotations

import datetime
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from bench.base.units import quantity_of, written_quantity
from docs.generators.markdown import code, prose, table

_PLAIN: Final[Mapping[Any, str]] = {
    str: "text",
    datetime.date: "a date such as `2026-03-02`",
    int: "whole number",
    float: "number",
    bool: "yes or no",
    Any: "anything",
    dict: "keys with values",
}
_BOUNDS: Final[tuple[tuple[type[Any], str, str], ...]] = (
    (Ge, "ge", "{} or more"),
    (Gt, "gt", "more than {}"),
    (Le, "le", "{} or less"),
    (Lt, "lt", "less than {}"),
    (MinLen, "min_length", "at least {}"),
    (MaxLen, "max_length", "at most {}"),
)

Title = Callable[[type[BaseModel]], str]


def sections(root: type[BaseModel], title: Title, level: int = 2) -> str:
    """Return a section for a model and for each that it can hold, the outer ones first.

    `title` gives the heading of a model, an empty one leaves it out; links lead to these headings.
    """
    parts = []
    for model in reachable(root):
        heading = title(model)
        if heading:
            parts.append(f"{'#' * level} {heading}\n\n{_described(model)}{keys(model, title)}")
    return "\n\n".join(parts)


def _described(model: type[BaseModel]) -> str:
    text = prose(model)
    return f"{text}\n\n" if text else ""


def keys(model: type[BaseModel], title: Title) -> str:
    """Return the table of a model's keys: what each holds, and its default."""
    rows = [
        (code(field.alias or name), what(field.annotation, field.metadata, title), default(field))
        for name, field in model.model_fields.items()
    ]
    return table(("key", "holds", "default"), rows)


def reachable(root: type[BaseModel]) -> list[type[BaseModel]]:
    """Return a model and all that its fields can hold, each once, a holder before what it holds."""
    found: dict[type[BaseModel], None] = {}
    waiting = [root]
    while waiting:
        model = waiting.pop()
        if model in found:
            continue
        found[model] = None
        model.model_rebuild()  # names of models that its file defines further down become those models
        held = [inner for field in model.model_fields.values() for inner in models_in(field.annotation)]
        waiting += reversed(held)
    return list(found)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation can hold: itself, alternatives, members of lists and mappings."""
    if inspect.isclass(annotation) and not get_args(annotation) and issubclass(annotation, BaseModel):
        yield from chosen_from(annotation)
    elif get_origin(annotation) is not Literal:
        for argument in get_args(annotation):
            yield from models_in(argument)


def chosen_from(model: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the models that may replace a model: the sections of all instruments for the form of their role."""
    alternatives = getattr(model, "alternatives", tuple)
    return list(alternatives()) or [model]


def default(field: FieldInfo) -> str:
    """Return the default of a key, as written in files as far as that is one word."""
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is PydanticUndefined:
        return "**required**"
    if value is None or value in ((), {}):
        return "–"
    if isinstance(value, BaseModel):
        return "as its defaults"
    kind = quantity_of(field.annotation, field.metadata)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and kind is not None:
        return code(written_quantity(value, kind))
    if isinstance(value, tuple):
        inner = _element(field.annotation)
        of = quantity_of(*inner) if inner else None
        return ", ".join(
            code(written_quantity(v, of)) if of and isinstance(v, float) else code(v) for v in value
        )
    return code(f"{value:g}" if isinstance(value, float) else value)


def _element(annotation: Any) -> tuple[Any, list[Any]] | None:
    """Return the annotation and the metadata of the members of a list."""
    if get_origin(annotation) is not tuple:
        return None
    first = get_args(annotation)[0]
    return (get_args(first)[0], list(get_args(first)[1:])) if get_origin(first) is Annotated else (first, [])


def what(annotation: Any, metadata: list[Any], title: Title) -> str:
    """Say what a key holds: a quantity with an example, a word of some, a list, another section."""
    kind = None if get_origin(annotation) in {Union, types.UnionType} else quantity_of(annotation, metadata)
    if kind is not None:
        return ", ".join([f"{kind.called} such as {code(kind.example)}", *_bounds(metadata)])
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return what(arguments[0], [*arguments[1:], *metadata], title)
    if origin is Literal:
        return " or ".join(code(word) for word in arguments)
    if origin in {Union, types.UnionType}:
        told = [what(a, [], title) for a in arguments if a is not type(None)]
        return " or ".join(dict.fromkeys(told))
    if origin is tuple:
        inner = what(arguments[0], [], title)
        return ", ".join([f"list of: {inner}", *_bounds(metadata)])
    if origin is dict:
        key, value = arguments
        return f"by name ({what(key, [], title)}): {what(value, [], title)}"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        headings = [title(model) for model in chosen_from(annotation)]
        return " or ".join(f"[{h}](#{anchor(h)})" if h else "keys with values" for h in headings)
    if inspect.isclass(annotation) and issubclass(annotation, Enum):
        return " or ".join(code(member.value) for member in annotation)
    name = _PLAIN.get(annotation, getattr(annotation, "__name__", str(annotation)))
    return ", ".join([name, *_bounds(metadata)])


def _bounds(metadata: list[Any]) -> list[str]:
    told = []
    for entry in metadata:
        for kind, attribute, text in _BOUNDS:
            if isinstance(entry, kind):
                told.append(text.format(f"{getattr(entry, attribute):g}"))
        constraints = getattr(entry, "metadata", None)
        if constraints:
            told += _bounds(list(constraints))
    return [text for text in told if text != "at least 0"]


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as the site makes it."""
    kept = "".join(c for c in heading.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")
