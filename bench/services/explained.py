"""Which errors were made to be read by a person, and the sentence that one of many runs is listed with."""

from __future__ import annotations

from typing import Any

from bench.base.computing import missing
from bench.services.errors import Refused


def expected(error: BaseException) -> bool:
    """Whether an error was made to be read by a person."""
    from bench.calibration import CalibrationError
    from bench.config.bench_file.file import FileMistakes
    from bench.model.effects import ExpressionError
    from bench.readings.csv import ReadingsError
    from bench.run.events import RecordError
    from drivers.interfaces import BenchError

    kinds: tuple[Any, ...] = (
        FileMistakes, CalibrationError, ReadingsError, RecordError, BenchError, ExpressionError,
    )  # fmt: skip
    return isinstance(error, kinds) or bool(missing(error))


def kind_and_words(error: BaseException) -> str:
    """Return what an error that nobody foresaw is called, and what it says, in one line."""
    return ": ".join(filter(None, (type(error).__name__, " ".join(str(error).split()))))


def sentence(error: Exception) -> str:
    """Return the sentence for an error that ends the work on one run and not on the others."""
    if isinstance(error, Refused):
        return error.typed
    if expected(error):
        return missing(error) or str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}"
    return f"stopped by a mistake of the program ({kind_and_words(error)})"
