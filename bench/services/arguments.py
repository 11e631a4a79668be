"""Checks of the arguments of the public functions: an argument of the wrong kind is refused in a sentence."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping
from datetime import date
from functools import wraps
from numbers import Integral, Real
from typing import Any, Final, ParamSpec, TypeVar

from bench.base.text import shortened, visible
from bench.config.bench_file.file import BenchFile
from bench.readings.table import Readings
from bench.services.bench_selection import BenchTaken
from bench.services.errors import Refused, sentence

P = ParamSpec("P")
R = TypeVar("R")
Asked = TypeVar("Asked")

LONGEST_NAME: Final = 4096
"""Bytes of the longest path of a file."""


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


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool)


def _is_pair(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value))


Kind = tuple[Callable[[Any], bool], str]

_NAME: Final[Kind] = (_is_name, "the name of a file")
_WORD: Final[Kind] = (_is_name, "a word")
_FLAG: Final[Kind] = (_is_flag, "True or False")
_NUMBER: Final[Kind] = (_is_number, "a number")
_COUNT: Final[Kind] = (_is_count, "a whole number, 0 or more")
_A_SOURCE: Final = "a readings file, a run by name or path, or a table (Readings or pandas DataFrame)"
_SOURCE: Final[Kind] = (_is_source, _A_SOURCE)
_SOURCES: Final[Kind] = (_is_list_of(_is_source), f"a list, and in it {_A_SOURCE}")

KINDS: Final[Mapping[str, Kind]] = {
    "source": _SOURCE,
    "sources": _SOURCES,
    "readings": _SOURCE,
    "bench": (
        lambda value: isinstance(value, BenchFile | BenchTaken) or _is_name(value),
        "a bench file by path or name, or one that was loaded",
    ),
    "procedure": _NAME,
    "model": _NAME,
    "prior": _NAME,
    "effects": (lambda value: _is_name(value) or _is_list_of(_is_name)(value), "the names of files"),
    "coefficients": (
        lambda value: hasattr(value, "calibration") or _is_name(value),
        "the result of a calibration, or its file",
    ),
    "runs": _NAME,
    "name": _WORD,
    "folder": _NAME,
    "baseline": _COUNT,
    "arl": _NUMBER,
    "smoothing": _NUMBER,
    "limits": _WORD,
    "real": _FLAG,
    "estimator": _WORD,
    "rule": _WORD,
    "g": _NUMBER,
    "limit": _NUMBER,
    "guard_band": _NUMBER,
    "population": (_is_pair, "a pair of numbers, mean and standard deviation"),
    "seed": _COUNT,
    "trials": _COUNT,
    "expires": (lambda value: isinstance(value, date), "a date (datetime.date)"),
    "nominal_angles": _FLAG,
    "join_free": _FLAG,
    "join_verification": _FLAG,
    "skip_bad_rows": _FLAG,
    "same_voltmeters": _FLAG,
    "by_installation": _FLAG,
    "one_block": _FLAG,
    "accept_first": _FLAG,
    "report": _FLAG,
    "write": _FLAG,
    "out": _NAME,
}
"""The accepted kind of each parameter of a public function, in code and in words; None if it is the default."""


def checked(**others: Kind) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that refuses arguments of another kind than `KINDS` or `others` (this function's) state.

    The decorated function also raises `Refused` where the file system reports an error.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name, value in signature.bind(*args, **kwargs).arguments.items():
                is_one, words = {**KINDS, **others}[name]
                default = signature.parameters[name].default
                if not is_one(value) and not (value is None and default is None):
                    shown = visible(shortened(repr(value)))
                    raise Refused(f"{name}={shown}: expected {words}")
            try:
                return function(*args, **kwargs)
            except OSError as error:
                raise Refused(sentence(error)) from error

        return call

    return decorated


def python_call(
    request: Callable[P, Asked], act: Callable[[Asked], R], name: str = "", **others: Kind
) -> Callable[P, R]:
    """Return the public Python function that carries out a request: its parameters are the request's fields.

    The function is called `name`, or else as `act` without the underscore, and has the docstring of `act`.
    `others` are kinds of arguments that replace the kinds in `KINDS`.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return act(request(*args, **kwargs))

    call.__name__ = call.__qualname__ = name or act.__name__.lstrip("_")
    call.__doc__ = act.__doc__
    fields = inspect.signature(request).parameters.values()
    signature = inspect.Signature([one.replace(annotation=inspect.Parameter.empty) for one in fields])
    call.__signature__ = signature  # type: ignore[attr-defined]
    return checked(**others)(call)


DIAGNOSED: Final[Kind] = (
    lambda value: _is_source(value) or _SOURCES[0](value),
    f"{_A_SOURCE}, or a list of them",
)
CHARTED: Final[Kind] = (
    lambda value: _is_name(value) or _is_list_of(_is_name)(value),
    "runs by name or path, or the folder in which they are",
)
