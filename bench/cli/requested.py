"""Commands whose options are the fields of a request.

    @app.command()
    @requested
    def confirm(request: Confirm, json: JsonOption = None) -> int: ...

A parameter annotated with a request is replaced by the request's fields; one annotated `list[Request]` by the same
with its first argument given once or more, a request for each.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from bench.base.requests import NOT_GIVEN, RequestField, fields_of
from bench.cli import completing


def requested(command: Callable[..., int]) -> Callable[..., int]:
    """Return a command that takes the fields of its request as options, and makes the request of them."""
    hints = get_type_hints(command, include_extras=True)
    name, request, several = next(_requests(hints))
    fields = list(fields_of(request))
    parameters = list(inspect.signature(command).parameters.values())
    place = [parameter.name for parameter in parameters].index(name)
    first = next((field for field in fields if field.option.argument), fields[0])
    made = [_parameter(field, several=several and place == 0 and field is first) for field in fields]
    named = inspect.Parameter.KEYWORD_ONLY
    others = [one.replace(annotation=hints[one.name], kind=named) for one in parameters if one.name != name]

    @wraps(command)
    def call(**given: Any) -> int:
        mine = {field.name: given.pop(field.name) for field in fields}
        if not several:
            return command(**{name: request(**mine)}, **given)
        every = mine.pop(first.name)
        return command(**{name: [request(**{first.name: one, **mine}) for one in every]}, **given)

    # those that must be given stand first, as Python wants it
    signature = sorted([*made, *others], key=lambda one: one.default is not NOT_GIVEN)
    call.__signature__ = inspect.Signature(signature, return_annotation=int)  # type: ignore[attr-defined]
    call.__annotations__ = {one.name: one.annotation for one in signature} | {"return": int}
    del call.__wrapped__
    return call


def _requests(hints: dict[str, Any]) -> Any:
    for name, hint in hints.items():
        inner = get_args(hint)[0] if get_origin(hint) is list else hint
        if isinstance(inner, type) and is_dataclass(inner):
            yield name, inner, inner is not hint


def _parameter(field: RequestField, *, several: bool) -> inspect.Parameter:
    option = field.option
    kind: Any = option.typed or field.type
    common: dict[str, Any] = {"help": option.help, "metavar": option.metavar, "envvar": option.environment}
    if option.completes is not None:
        common["autocompletion"] = getattr(completing, option.completes)
    if option.least is not None:
        common["min"] = option.least
    if option.most is not None:
        common["max"] = option.most
    info: Any = typer.Argument if option.argument else partial(typer.Option, *(option.flags or _flags(field)))
    return inspect.Parameter(
        field.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=field.default,
        annotation=Annotated[list[kind] if several else kind, info(**common)],
    )


def _flags(field: RequestField) -> tuple[str, ...]:
    name = field.name.replace("_", "-")
    on = field.type is bool and field.default is True
    return (f"--{name}/--no-{name}",) if on else (f"--{name}",)
