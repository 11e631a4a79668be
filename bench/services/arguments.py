"""Checks of the arguments of public functions; an argument of the wrong kind raises `Refused`."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, ParamSpec, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from bench.base.text import shortened, visible
from bench.config.bench_file.file import BenchFile
from bench.readings.table import Readings
from bench.services.bench_selection import BenchTaken
from bench.services.errors import Refused, expected, in_python, sentence
from bench.services.requests import shared
from bench.services.requests.evaluation import Calibrated

P = ParamSpec("P")
R = TypeVar("R")
Asked = TypeVar("Asked")

LONGEST_NAME: Final = 4096
"""Greatest length of a path, in bytes."""


def _is_name(value: Any) -> bool:
    if not isinstance(value, str | os.PathLike):
        return False
    text = os.fspath(value)
    if not isinstance(text, str) or not text or "\0" in text:
        return False
    try:
        return len(text.encode()) <= LONGEST_NAME
    except UnicodeEncodeError:  # half of a pair of UTF-16
        return False


def _is_number(value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _is_count(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and 0 <= int(value) < 2**63


def _is_table(value: Any) -> bool:
    return isinstance(value, Readings) or (hasattr(value, "itertuples") and hasattr(value, "columns"))


def _is_source(value: Any) -> bool:
    return _is_name(value) or _is_table(value)


def _is_list_of(is_one: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list | tuple) and len(value) > 0 and all(map(is_one, value))


def _is_name_or_names(value: Any) -> bool:
    return _is_name(value) or _is_list_of(_is_name)(value)


def _is_pair(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value))


Kind = tuple[Callable[[Any], bool], str]
"""A kind of argument: the predicate that it must satisfy, and its description in words."""

NAME: Final[Kind] = (_is_name, "the name of a file")
FLAG: Final[Kind] = (lambda value: isinstance(value, bool), "True or False")
_A_SOURCE: Final = "a readings file, a run by name or path, or a table (Readings or pandas DataFrame)"
SOURCE: Final[Kind] = (_is_source, _A_SOURCE)
BENCH: Final[Kind] = (
    lambda value: isinstance(value, BenchFile | BenchTaken) or _is_name(value),
    "a bench file by path or name, or a loaded one",
)
KINDS: Final[Mapping[Any, Kind]] = {
    shared.Data: SOURCE,
    Sequence[shared.Data]: (_is_list_of(_is_source), f"a list of {_A_SOURCE}"),
    shared.Data | Sequence[shared.Data]: (
        lambda value: _is_source(value) or _is_list_of(_is_source)(value),
        f"{_A_SOURCE}, or a list of them",
    ),
    shared.Bench: BENCH,
    shared.Effects: (_is_name_or_names, "the names of files"),
    str | Path | Calibrated: (
        lambda value: hasattr(value, "calibration") or _is_name(value),
        "the result of a calibration, or its file",
    ),
    str | Path | Sequence[str | Path]: (
        _is_name_or_names, "runs by name or path, or the folder in which they are",
    ),
    str | Path: NAME,
    str: (_is_name, "a word"),
    Sequence[str]: (_is_list_of(_is_name), "a list of words"),
    bool: FLAG,
    float: (_is_number, "a number"),
    int: (_is_count, "a whole number, 0 or more"),
    tuple[float, float]: (_is_pair, "a pair of numbers, mean and standard deviation"),
    date | str: (lambda value: isinstance(value, date), "a date (datetime.date)"),
}  # fmt: skip
"""The accepted kind of an argument by the type of its request's field."""


def kinds_of(request: type) -> dict[str, Kind]:
    """Return the accepted kind of each parameter of the constructor of `request`, by parameter name."""
    told, hints = {}, get_type_hints(request)
    for name in inspect.signature(request).parameters:
        hint = hints[name]
        parts = [one for one in get_args(hint) if one is not NoneType]
        optional = get_origin(hint) in {Union, UnionType} and len(parts) < len(get_args(hint))
        told[name] = KINDS[Union[tuple(parts)] if optional else hint]  # noqa: UP007 - of a tuple
    return told


def checked(**kinds: Kind) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that checks a function's arguments; `kinds` are their accepted kinds, by name.

    The decorated function raises `Refused` for an argument of another kind and in place of an `OSError`. It
    accepts None where None is the default. Messages of foreseen errors name Python arguments, not options.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        flags = [name for name, kind in kinds.items() if kind is FLAG]

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name, value in signature.bind(*args, **kwargs).arguments.items():
                is_one, words = kinds[name]
                default = signature.parameters[name].default
                if not is_one(value) and not (value is None and default is None):
                    shown = visible(shortened(repr(value)))
                    raise Refused(f"{name}={shown}: expected {words}")
            try:
                return function(*args, **kwargs)
            except OSError as error:
                raise Refused(sentence(error)) from error
            except Exception as error:
                if expected(error):
                    error.args = tuple(
                        in_python(one, flags) if isinstance(one, str) else one for one in error.args
                    )
                raise

        return call

    return decorated


def python_call(request: Callable[P, Asked], act: Callable[[Asked], R], name: str = "") -> Callable[P, R]:
    """Return a public function that makes a `request` of its arguments, and returns `act(request)`.

    Its parameters are the fields of the request class, its docstring is that of `act`. Its name is `name`, by
    default the name of `act` without leading underscores.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return act(request(*args, **kwargs))

    call.__name__ = call.__qualname__ = name or act.__name__.lstrip("_")
    call.__doc__ = act.__doc__
    fields = inspect.signature(request).parameters.values()
    signature = inspect.Signature([one.replace(annotation=inspect.Parameter.empty) for one in fields])
    call.__signature__ = signature  # type: ignore[attr-defined]
    return checked(**kinds_of(cast(type, request)))(call)
