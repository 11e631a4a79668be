"""Refused requests, error messages for the user, and values of options with units."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from bench.base.computing import missing
from bench.base.files import DISK_FULL, remedy_for
from bench.base.languages import message
from bench.base.numbers import read_number

if TYPE_CHECKING:
    from pathlib import Path

    from bench.base.units import QuantityKind

_OPTION: Final = re.compile(
    r"'bench(?: (?:[^' \"]|'[^']*'|\"[^\"]*\")+)+'|--(no-)?([a-z][a-z-]*)( (?=[0-9.-]))?"
)
"""A whole command, which stays as typed (a word with blanks is in quotes), or an option."""


class Refused(Exception):
    """Raised for a request that cannot be carried out; the text states the reason and the remedy.

    `typed` is the text with options as on the command line (--g 9.81); `str` gives them as in Python (g=9.81).
    """

    def __init__(self, typed: str) -> None:
        super().__init__(typed)
        self.typed = typed

    def __str__(self) -> str:
        """Return the text with the options written as in Python."""
        return in_python(self.typed)


class NoCheckBlock(Refused):
    """Raised if a folder of runs contains no run of a check block."""


def in_python(text: str, flags: Collection[str] = ()) -> str:
    """Return a message with options (--g 9.81) as Python arguments (g=9.81); options in `flags` have no value."""

    def argument(option: re.Match[str]) -> str:
        if option[2] is None:
            return option[0]
        name = option[2].replace("-", "_")
        if option[1]:
            return f"{name}=False"
        return f"{name}=" if option[3] else f"{name}=True" if name in flags else name

    return _OPTION.sub(argument, text)


def expected(error: BaseException) -> bool:
    """Return whether an error is of a foreseen kind, whose message is written for the user."""
    from bench.calibration import CalibrationError
    from bench.config.bench_file.file import FileMistakes
    from bench.model.effects import ExpressionError
    from bench.model.effects.base import EffectMistake
    from bench.readings.csv import ReadingsError
    from bench.run.events import RecordError
    from drivers.interfaces import BenchError

    kinds: tuple[Any, ...] = (
        FileMistakes, CalibrationError, ReadingsError, RecordError, BenchError, ExpressionError, EffectMistake,
    )  # fmt: skip
    return isinstance(error, kinds) or bool(missing(error))


def kind_and_words(error: BaseException) -> str:
    """Return the class name and the text of an unforeseen error in one line."""
    return ": ".join(filter(None, (type(error).__name__, " ".join(str(error).split()))))


def sentence(error: Exception) -> str:
    """Return the sentence by which an error is reported to the user."""
    if isinstance(error, Refused):
        return error.typed
    if expected(error):
        return missing(error) or str(error)
    if isinstance(error, OSError):
        remedy = message("; free disk space, then repeat the command") if error.errno in DISK_FULL else ""
        return f"{error.filename or 'a file'}: {error.strerror or error}{remedy}"
    return message(f"stopped by an error of the program ({kind_and_words(error)})")


@contextmanager
def refusing(remedy: str, place: Path | None = None, *, reading: bool = False) -> Iterator[None]:
    """Turn an `OSError` in the context into a `Refused` that names `place` (default: its file) and `remedy`."""
    try:
        yield
    except OSError as error:
        file = place or error.filename
        if reading:
            told = message(f"{file}: cannot be read ({error.strerror}); {remedy_for(error, remedy)}")
        else:
            told = message(f"{file}: cannot be written ({error.strerror}); {remedy}")
        raise Refused(told) from error


def quantity(option: str, text: str, kind: QuantityKind, *, plain: bool = True) -> float:
    """Return the value of an option in SI; with `plain`, a number without a unit counts as SI. Raises `Refused`."""
    from bench.base.units import parse_quantity  # pydantic is slow to import

    if plain:
        try:
            return read_number(text)
        except ValueError:
            pass
    try:
        return parse_quantity(text, kind)
    except ValueError as error:
        raise Refused(f"{option} {text}: {error}") from None


def named(option: str, text: str, example: str) -> tuple[str, str]:
    """Return name and value in the text "NAME=VALUE" of an option. Raises `Refused`, which shows `example`."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise Refused(f"{option} {text}: give a name and its value, such as {example}")
    return name.strip(), value.strip()
