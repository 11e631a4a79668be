"""Requests: frozen dataclasses whose fields are the options of a command and the parameters of a call.

    @dataclass(frozen=True)
    class Confirm:
        source: Annotated[str, Option("New readings.", argument=True)]
        model: Annotated[Path, Option("Model file of 'diagnose'.", metavar="FOUND")]
        g: float | None = option(None, "Local gravity, m/s².", metavar="M/S2")

The command line (`bench.cli.options`), the Python API and the panel's forms are derived from the request. This
module imports nothing heavy, so that a command's help appears quickly.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")

OPTION: Final = "option"
"""The key of an `Option` in the metadata of a request's field."""
NOT_GIVEN: Final = inspect.Parameter.empty
ESTIMATORS_TOLD: Final = "The estimators."
ESTIMATORS_IN_A_BUDGET: Final = "The estimators, in a budget."
"""Placeholder help texts: the command line replaces them by the names of the estimators, which take a second to
find."""


@dataclass(frozen=True)
class Option:
    """The user interface of a request's field: a line of help, and its form on the command line.

    `flags` default to "--name", or "--name/--no-name" for a switch whose default is on; a positional `argument` has
    no flags. `metavar` is the name of the value in the help; for a path it defaults to FILE. `completes` names the
    shell completion ("bench_files", …; `bench.cli.completing`). `least` and `most` limit a number. `typed` is the
    type of the value on the command line, if it differs from the type of the field. The short help omits `rare`
    options. `also` is an older option that the command line still accepts in place of the argument.
    """

    help: str
    flags: tuple[str, ...] = ()
    metavar: str | None = None
    argument: bool = False
    completes: str | None = None
    environment: str | None = None
    least: float | None = None
    most: float | None = None
    typed: Any = None
    rare: bool = False
    also: str = ""


def option(default: T, help: str, **settings: Any) -> T:
    """Return a request's field with this default and an `Option` made of `help` and `settings`."""
    field: T = dataclasses.field(default=default, metadata={OPTION: Option(help, **settings)})
    return field


@dataclass(frozen=True)
class RequestField:
    """A field of a request; `default` is `NOT_GIVEN` if the field is required."""

    name: str
    type: Any
    default: Any
    option: Option


def fields_of(request: type) -> Iterator[RequestField]:
    """Yield the fields of a request class that have an `Option`, in the order of the help."""
    hints = get_type_hints(request, include_extras=True)
    for field in dataclasses.fields(request):
        kind, told = hints[field.name], field.metadata.get(OPTION)
        if get_origin(kind) is Annotated:
            kind, *others = get_args(kind)
            told = told or next((one for one in others if isinstance(one, Option)), None)
        if told is not None:
            default = NOT_GIVEN if field.default is dataclasses.MISSING else field.default
            yield RequestField(field.name, kind, default, told)
