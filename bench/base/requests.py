"""Requests: frozen dataclasses whose fields are the options of a command and the parameters of a call.

    @dataclass(frozen=True)
    class Confirm:
        source: Annotated[str, Option("New readings.", argument=True)]
        model: Annotated[Path, Option("Model file of 'diagnose'.", metavar="FOUND")]
        g: Annotated[float | None, Option("Local gravity, m/s².", metavar="M/S2")] = None

Made of it are the command line (`bench.cli.options`), the Python face and the panel's forms. Nothing heavy is
imported here: a command's help needs no more than its request.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

NOT_GIVEN: Final = inspect.Parameter.empty
ESTIMATORS_TOLD: Final = "The estimators."
ESTIMATORS_IN_A_BUDGET: Final = "The estimators, in a budget."
"""Helps in whose place the command line puts the names of the estimators: to look for them takes a second."""


@dataclass(frozen=True)
class Option:
    """The user interface of a field of a request: a line of help, and how it is typed.

    `flags` are "--name" by default, of a flag that is on "--name/--no-name"; an `argument` has none. `completes`
    names what completes it ("bench_files", …; `bench.cli.completing`), `least` and `most` limit a number.
    `typed` is what the command line reads, where the field takes more (a table, a bench file at hand).
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


@dataclass(frozen=True)
class RequestField:
    """A field of a request; `default` is `NOT_GIVEN` where it must be given."""

    name: str
    type: Any
    default: Any
    option: Option


def fields_of(request: type) -> Iterator[RequestField]:
    """Yield the fields of a request that a user gives, in the order in which the help lists them."""
    hints = get_type_hints(request, include_extras=True)
    for field in dataclasses.fields(request):
        hint = hints[field.name]
        if get_origin(hint) is not Annotated:
            continue
        kind, *told = get_args(hint)
        option = next((one for one in told if isinstance(one, Option)), None)
        if option is not None:
            default = NOT_GIVEN if field.default is dataclasses.MISSING else field.default
            yield RequestField(field.name, kind, default, option)
