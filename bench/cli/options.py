"""The command line's application object, and the options that commands share."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

import typer

from bench.base.languages import LANGUAGES, known_language, speak
from bench.base.requests import NOT_GIVEN, RequestField, fields_of
from bench.cli import completing
from bench.cli.commands import COMMANDS, KNOWN, MORE, BenchCommand, CommandGroup, Commands
from bench.config.devices import FOLDERS, devices_given
from bench.services.errors import Refused
from bench.services.requests import shared


def _own_parts(command: str, takes: set[str]) -> Iterator[inspect.Parameter]:
    """Yield options for the user's own devices and effects, and for the language.

    `--devices` is for a command that takes a bench file, `--effects` for one that takes a bench file or a model,
    `--language` for the commands of `SPEAKING`.
    """
    if command == "resume" or "bench" in takes:
        words = "Folder with your own instrument drivers; its code is run (default: BENCH_DEVICES)."
        yield _own_option("devices", "DIR", words, _use_devices, list[str] | None)
    if takes & {"bench", "model"}:
        words = "File with your own effects, as formulas (default: BENCH_EFFECTS)."
        yield _own_option("effects", "FILE", words, _use_effects, list[str] | None)
    if command in SPEAKING:
        words = f"Language of page and prompts: {', '.join(LANGUAGES)} (default: BENCH_LANGUAGE, English)."
        yield _own_option("language", "CODE", words, _use_language, str | None)


SPEAKING: Final = ("run", "resume", "report", "diagnose")
"""Commands that ask a person or write a page, in one of several languages."""


def _use_language(ctx: typer.Context, name: str | None) -> None:
    if not ctx.resilient_parsing and name is not None:
        if not known_language(name):
            raise typer.BadParameter(f"choose one of {', '.join(LANGUAGES)}")
        speak(name)


def _own_option(name: str, metavar: str, words: str, use: Callable[..., None], of: Any) -> inspect.Parameter:
    """Return an option `--name` with values of the type `of`; the callback `use` receives them."""
    info: Any = typer.Option(
        f"--{name}", metavar=metavar, help=words, expose_value=False, callback=use, rich_help_panel=MORE
    )
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[of, info]
    )


def _use_effects(ctx: typer.Context, files: list[str] | None) -> None:
    """Register the effects in files and in the environment (BENCH_EFFECTS) for the duration of the command."""
    if not ctx.resilient_parsing and (files or os.environ.get("BENCH_EFFECTS")):
        from bench.config.formulas import ENVIRONMENT, effects_in, files_of_environment
        from bench.model import CATALOGUE

        every = [*(files or ()), *files_of_environment()]
        ctx.with_resource(CATALOGUE.also(effects_in(every)))
        ctx.with_resource(_environment(ENVIRONMENT, every))  # worker processes read them from there


def _use_devices(ctx: typer.Context, folders: list[str] | None) -> None:
    """Search these folders before those in the environment (BENCH_DEVICES) for the duration of the command."""
    for folder in folders or ():
        if not Path(folder).is_dir():
            raise typer.BadParameter(f"{folder}: no such folder; create it or name another")
    if folders:
        typed = devices_given.set(tuple(folders))
        ctx.call_on_close(lambda: devices_given.reset(typed))
        ctx.with_resource(_environment(FOLDERS, [*folders, *filter(None, [os.environ.get(FOLDERS)])]))


@contextmanager
def _environment(name: str, paths: Sequence[str]) -> Iterator[None]:
    """Set an environment variable to a list of paths within a context."""
    before = os.environ.get(name)
    os.environ[name] = os.pathsep.join(paths)
    try:
        yield
    finally:
        os.environ.pop(name, None)
        if before is not None:
            os.environ[name] = before


app = typer.Typer(
    name="bench",
    cls=Commands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["--help", "-h"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Calibrates triaxial accelerometer blocks on a dividing head.",
    epilog="Exit status: 0 done and accepted, 1 done and not accepted, 2 could not be done.",
)


def group(name: str, example: str, cls: type[CommandGroup] = CommandGroup) -> typer.Typer:
    """Return an empty group of commands with this name; its help is from `COMMANDS`."""
    return typer.Typer(
        name=name,
        cls=cls,
        no_args_is_help=True,
        rich_markup_mode=None,
        epilog=f"Example: {example}",
        help=COMMANDS[name],
    )


def _writable(target: str | None) -> str | None:
    """Return `target`, the value of `--json`. Raises `Refused`, before any work, if its folder is missing."""
    if target not in {None, "-"} and not Path(str(target)).absolute().parent.is_dir():
        raise Refused(f"--json {target}: no such folder; create it or name another")
    return target


JsonOption = Annotated[
    str | None,
    typer.Option(
        "--json", metavar="FILE", help="Write the result as JSON; - for standard output.", callback=_writable
    ),
]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the result files.")]
StrictFitOption = Annotated[
    bool,
    typer.Option("--strict", help="Reject a fit whose lack of fit has p < 0.01 (default: p < 1e-4)."),
]


def requested(command: Callable[..., int]) -> Callable[..., int]:
    """Return a command whose options are the fields of its request; the request is made from the options.

    If `command` takes a list of requests, each value of its first argument, such as a run, becomes one
    request.
    """
    hints = get_type_hints(command, include_extras=True)
    name, request, several = next(_requests(hints))
    fields = list(fields_of(request))
    parameters = list(inspect.signature(command).parameters.values())
    place = [parameter.name for parameter in parameters].index(name)
    first = next((field for field in fields if field.option.argument), fields[0])
    made = [_parameter(field, several=several and place == 0 and field is first) for field in fields]
    older = {field.name: _older(field) for field in fields if field.option.also}
    named = inspect.Parameter.KEYWORD_ONLY
    others = [one.replace(annotation=hints[one.name], kind=named) for one in parameters if one.name != name]

    @wraps(command)
    def call(**given: Any) -> int:
        for one in own:  # their callbacks used them
            given.pop(one.name)
        mine = {field.name: given.pop(field.name) for field in fields}
        for field in fields:
            if field.name in older:
                mine[field.name] = _in_either_way(field, mine[field.name], given.pop(older[field.name].name))
        if not several:
            return command(**{name: request(**mine)}, **given)
        every = mine.pop(first.name)
        return command(**{name: [request(**{first.name: one, **mine}) for one in every]}, **given)

    # parameters without a default come first, as Python requires
    signature = sorted([*made, *older.values(), *others], key=lambda one: one.default is not NOT_GIVEN)
    own = list(_own_parts(command.__name__, {one.name for one in signature}))
    signature += own
    call.__signature__ = inspect.Signature(signature, return_annotation=int)  # type: ignore[attr-defined]
    call.__annotations__ = {one.name: one.annotation for one in signature} | {"return": int}
    del call.__wrapped__
    return call


def _requests(hints: dict[str, Any]) -> Any:
    for name, hint in hints.items():
        inner = get_args(hint)[0] if get_origin(hint) is list else hint
        if isinstance(inner, type) and is_dataclass(inner):
            yield name, inner, inner is not hint


TYPED: Final[dict[Any, Any]] = {
    str | Path: Path,
    str | Path | None: Path | None,
    Sequence[str]: list[str],
    Sequence[str] | None: list[str] | None,
    shared.Data: str,
    Sequence[shared.Data]: list[str],
    shared.Bench: str | None,
}
"""The type on the command line of a field whose Python type also accepts objects, such as a table."""


def _parameter(field: RequestField, *, several: bool) -> inspect.Parameter:
    option = field.option
    kind: Any = option.typed or TYPED.get(field.type, field.type)
    value = option.metavar or ("FILE" if kind in {Path, Path | None} and not option.argument else None)
    common: dict[str, Any] = {"help": option.help, "metavar": value, "envvar": option.environment}
    if option.completes is not None:
        common["autocompletion"] = getattr(completing, option.completes)
    if option.least is not None:
        common["min"] = option.least
    if option.most is not None:
        common["max"] = option.most
    if option.rare:
        common["rich_help_panel"] = MORE
    info: Any = typer.Argument if option.argument else partial(typer.Option, *(option.flags or _flags(field)))
    return inspect.Parameter(
        field.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=field.default,
        annotation=Annotated[list[kind] if several else kind, info(**common)],
    )


def _older(field: RequestField) -> inspect.Parameter:
    """Return the option that is an older spelling of an argument."""
    option = field.option
    words = f"The same as the argument {option.metavar or field.name.upper()}."
    info: Any = typer.Option(option.also, help=words, metavar="FILE", rich_help_panel=MORE)
    if option.completes is not None:
        info.autocompletion = getattr(completing, option.completes)
    name = f"{field.name}_as_option"
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=None, annotation=Annotated[str | None, info])


def _in_either_way(field: RequestField, argument: Any, option: Any) -> Any:
    """Return a field's value from `argument` or the older `option`. Raises `Refused` if both are given."""
    if option is None:
        return argument
    if argument not in {field.default, option}:
        raise Refused(
            f"{field.option.also} {option}: the {field.name} is {argument} already; give one of them"
        )
    return option


def _flags(field: RequestField) -> tuple[str, ...]:
    name = field.name.replace("_", "-")
    on = field.type is bool and field.default is True
    return (f"--{name}/--no-{name}",) if on else (f"--{name}",)


def command(
    example: str, name: str | None = None, *, to: typer.Typer = app
) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Return a decorator that makes a function a command, with an example in its help.

    The options are the parameters of the function and, if it takes a request, the fields of the request.
    """

    def entered(function: Callable[..., int]) -> Callable[..., int]:
        with_request = any(_requests(get_type_hints(function, include_extras=True)))
        whole = requested(function) if with_request else function
        to.command(name, cls=BenchCommand, epilog=f"Example: {example}")(whole)
        KNOWN[whole] = to.registered_commands[-1]
        return whole

    return entered
