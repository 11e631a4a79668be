"""The page on commands, from the command line's own description of itself."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Final

import typer

import bench.cli.app  # noqa: F401 - it brings the commands
from bench.cli.options import app
from docs.generators.markdown import code, table

_INTRODUCTION: Final = """\
# Commands

This page lists all commands and options. `bench --help` lists the common commands, `bench help --all` all of them.
`bench help COMMAND` (or `bench COMMAND --help`, `-h`) shows the common options of a command, `bench help COMMAND
--all` (or `bench COMMAND --help-all`) all options.

The exit status of every command is 0 if the result is accepted, 1 if it is not accepted, and 2 if the command
failed, with one line on standard error. A result as JSON (`--json FILE`, `-` for standard output) has the form in
[results](results.md).

Two options work before or after every command: `--debug` shows the traceback of an error, `--quiet` hides progress
and notes. On a terminal, long computations show their progress and the time left. `bench --install-completion`
makes your shell complete commands, options, runs and procedures (it writes into the shell's own files);
`bench --show-completion` only prints the script.
"""


@cache
def commands() -> dict[str, Any]:
    """Return the commands by name, each imported; those of groups as "group name"."""
    return dict(_all(typer.main.get_command(app), ""))


def _all(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    context = typer.Context(group)
    for name in group.list_commands(context):
        whole = f"{prefix} {name}".strip()
        command = group.get_command(context, name)
        if hasattr(command, "list_commands"):
            yield from _all(command, whole)
        else:
            yield whole, command


def page() -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    parts += [_section(name, command) for name, command in commands().items()]
    return "\n\n".join(parts)


def _section(name: str, command: Any) -> str:
    context = typer.Context(command, info_name=f"bench {name}")
    if hasattr(command, "get_help"):
        command.get_help(context)  # texts that are made when help is shown are there afterwards
    usage = " ".join([f"bench {name}", *command.collect_usage_pieces(context)])
    parts = [f"## {name}", command.help or "", f"```text\n{usage}\n```"]
    rows = [row for option in command.params for row in _rows(option)]
    if rows:
        parts.append(table(("argument or option", "meaning", "default"), rows))
    if command.epilog and command.epilog.startswith("Example: "):
        parts.append(f"Example: {code(command.epilog.removeprefix('Example: '))}")
    return "\n\n".join(part for part in parts if part)


def _rows(option: Any) -> Iterator[tuple[str, str, str]]:
    if getattr(option, "hidden", False):
        return
    help_text = getattr(option, "help", None) or ""
    default = option.default
    if option.param_type_name == "argument":
        yield (
            code(option.metavar or option.name.upper()),
            help_text,
            "" if not option.required else "required",
        )
        return
    names = ", ".join(code(name) for name in (*option.opts, *option.secondary_opts))
    value = "" if option.is_flag else f" {code(option.metavar or _kind(option))}"
    shown = "" if default is None or option.is_flag or callable(default) or default == () else code(default)
    environment = f" Also {code(option.envvar)}." if option.envvar else ""
    yield f"{names}{value}", f"{help_text}{environment}", "required" if option.required else shown


def _kind(option: Any) -> str:
    """Return what the value of an option is, in capitals as the help shows it."""
    annotation = getattr(getattr(option, "type_descriptor", None), "annotation", None)
    kind = getattr(annotation, "__name__", "") or getattr(getattr(option, "type", None), "name", "")
    return {"str": "TEXT", "int": "NUMBER", "float": "NUMBER", "Path": "FILE"}.get(
        kind, kind.upper() or "VALUE"
    )
