"""What pydantic found wrong, told as a person would: where, what was expected, the nearest known word."""

from __future__ import annotations

import difflib
import types
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Final, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from bench.base.visible import QUOTED, shortened

Place = tuple[str | int, ...]
"""Where in a file: keys and positions in lists (from 0), such as ("steps", 0, "turn")."""

MOST_TOLD: Final = 200
"""Mistakes of one file that are told; mending those shows the rest."""

_EXPECTED: Final = {
    "int_parsing": "a whole number",
    "int_parsing_size": "a whole number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_parsing": "yes or no",
    "bool_type": "yes or no",
    "string_type": "a text",
    "string_too_short": "a text that is not empty",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "keys with values",
    "model_type": "keys with values",
    "model_attributes_type": "keys with values",
    "greater_than": "more than {gt}",
    "greater_than_equal": "{ge} or more",
    "less_than": "less than {lt}",
    "less_than_equal": "{le} or less",
    "too_short": "a list of at least {min_length}",
    "too_long": "a list of at most {max_length}",
}


def explained(
    error: ValidationError, model: type[BaseModel], lines: Mapping[Place, int]
) -> Iterator[tuple[Place, str]]:
    """Yield the place and the sentence of each error; `lines` says which places were written.

    A key that is missing because it was misspelt is told once, as the misspelt one.
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
                    yield place, f"'{detail['loc'][-1]}' is missing"
            case "extra_forbidden":
                yield place, unknown_word(str(place[-1]), sorted(_keys(model, detail["loc"][:-1])), "key")
            case "literal_error" | "enum":
                yield place, _wrong_word(detail)
            case "too_short" if len(detail["input"]) >= (detail.get("ctx") or {})["min_length"]:
                pass  # the list was long enough: its members are wrong, and told by themselves
            case _:
                yield place, _wrong_value(detail)


def unknown_word(word: str, known: list[str], what: str) -> str:
    """Return the sentence for a word that is not known, with the nearest one that is."""
    if word in known:
        return f"'{word}' does not go with the other keys here; leave it or those out"
    near = _nearest(word, known)
    hint = f"did you mean '{near}'? " if near else ""
    return f"unknown {what} '{shortened(word)}'; {hint}known: {', '.join(known)}"


def _nearest(word: str, known: Iterable[str]) -> str | None:
    if len(word) > QUOTED:
        return None
    near = difflib.get_close_matches(word, sorted(known), n=1, cutoff=0.5)
    return near[0] if near else None


def _written(location: tuple[int | str, ...], lines: Mapping[Place, int]) -> Place:
    """Keep the parts of a location that stand in the file: pydantic adds the names of alternatives."""
    place: Place = ()
    for step in location:
        if (*place, step) in lines:
            place = (*place, step)
    return place


def _got(value: object) -> str:
    match value:
        case dict():
            return "keys with values"
        case list():
            return f"a list of {len(value)}"
        case None:
            return "nothing"
        case _:
            return f"'{shortened(str(value))}'"


def _wrong_word(detail: ErrorDetails) -> str:
    context: dict[str, Any] = detail.get("ctx") or {}
    expected = str(context.get("expected", "")).replace("'", "")
    known = [word.strip() for word in expected.replace(" or ", ",").split(",")]
    near = _nearest(str(detail["input"]), known)
    hint = f"; did you mean '{near}'?" if near else ""
    return f"expected {expected}, got {_got(detail['input'])}{hint}"


def _wrong_value(detail: ErrorDetails) -> str:
    context: dict[str, Any] = detail.get("ctx") or {}
    if detail["type"] == "value_error":
        return str(context["error"])
    if detail["type"] in _EXPECTED:
        expected = _EXPECTED[detail["type"]].format(**context)
        return f"expected {expected}, got {_got(detail['input'])}"
    return f"{detail['msg'][:1].lower()}{detail['msg'][1:]}, got {_got(detail['input'])}"


def _keys(annotation: Any, location: tuple[int | str, ...]) -> set[str]:
    """Return the keys that may stand at a location of a model, aliases as they are written."""
    models = list(_models(annotation))
    for position, step in enumerate(location):
        named = [m.model_fields for m in models]
        fields = [f for m in named for name, f in m.items() if step in {name, f.alias}]
        if fields:
            rest = location[position + 1 :]
            return set().union(*(_keys(f.annotation, rest) for f in fields))
        chosen = [m for m in models if any(step in get_args(f.annotation) for f in m.model_fields.values())]
        models = chosen or models  # the step is the word that chose among alternatives, such as a driver
    return {f.alias or name for m in models for name, f in m.model_fields.items()}


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation can hold: itself, alternatives, members of lists and mappings."""
    if isinstance(annotation, type) and not get_args(annotation) and issubclass(annotation, BaseModel):
        annotation.model_rebuild()  # names of models that its file defines further down become those models
        yield from getattr(annotation, "alternatives", tuple)() or (annotation,)
    elif get_origin(annotation) is Annotated:
        yield from _models(get_args(annotation)[0])
    elif get_origin(annotation) in {Union, types.UnionType, list, tuple, dict}:
        for argument in get_args(annotation):
            yield from _models(argument)
