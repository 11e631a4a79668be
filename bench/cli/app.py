"""The `bench` command line: its global options, and the reporting of errors."""

from __future__ import annotations

import sys
import traceback
from functools import cache
from typing import Annotated, Any

import typer
from typer.main import get_command

from bench.base import computing
from bench.base.languages import message, speaking, translated
from bench.base.text import bounded, visible
from bench.cli.commands import COMMANDS
from bench.cli.options import app
from bench.run.interrupts import stopped_by
from bench.services.errors import Refused

DONE, NOT_DONE = 0, 2
ANYWHERE = ("--debug", "--quiet")
"""Options accepted before or after a command."""
CTRL_C = 130
"""The exit status that the command-line library returns after Ctrl-C."""


def _print_version(asked: bool) -> None:
    if asked:
        from importlib import metadata

        print(f"bench {metadata.version('triaxial-bench')}")
        raise typer.Exit


@app.callback()
def _common(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="No progress and no notes; results, questions and errors stay.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the program's version.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    """Calibrates triaxial accelerometer blocks on a dividing head."""


@cache
def _program() -> Any:
    """Return the group of commands, made once; the library would make it again at every call."""
    return get_command(app)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status; report an error as a message on standard error.

    `arguments` are those of `sys.argv` by default. With `--debug`, the traceback of an error is printed as well.
    """
    given = sys.argv[1:] if arguments is None else arguments
    hushed = computing.quiet.set("--quiet" in given)
    try:
        with speaking(None):  # --language lasts until the error is reported
            status = _status_of(given)
    finally:
        computing.quiet.reset(hushed)
    sys.exit(status if isinstance(status, int) else DONE)


def _status_of(given: list[str]) -> Any:
    """Carry out the arguments and report any error; return the exit status, or what the command returned."""
    try:
        typed = [word for word in given if word not in ANYWHERE]
        status = _program()(typed or ["--help"], prog_name="bench", standalone_mode=False)
        return _fail(stopped_by()) if status == CTRL_C else status
    except KeyboardInterrupt:
        return _fail(stopped_by())
    except typer.Abort:
        return _fail("stopped")
    except Exception as error:
        if "--debug" in given:
            traceback.print_exc()
        return _fail(explain(error, _command_in(given)))


def _command_in(given: list[str]) -> str:
    """Return the command that the arguments name, in the form of messages, such as "bench run"."""
    return " ".join(["bench", *[word for word in given if word in COMMANDS][:1]])


def explain(error: Exception, command: str = "bench") -> str:
    """Return the message for an error; if it is unforeseen, the message names the command and `--debug`."""
    from bench.services.errors import expected, kind_and_words, sentence

    if isinstance(error, typer.TyperException):
        said = error.format_message().replace(" Did you mean", "; did you mean")  # names the option
        asked = f"{command} --help-all"
        more = message(f"See '{asked}'")
        return f"{said}{'' if said.endswith(('.', '?')) else '.'} {more}"
    if isinstance(error, Refused | OSError) or expected(error):
        return sentence(error)
    return message(
        f"'{command}' was stopped by an error of the program ({kind_and_words(error)}); run it again with --debug "
        "and report what it shows"
    )


def _fail(text: str) -> int:
    print(f"bench: {visible(bounded(translated(text)))}", file=sys.stderr)
    return NOT_DONE
