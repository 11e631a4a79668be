"""The help of commands: common options first; the others only where the whole help is asked for."""

from __future__ import annotations

import re
from typing import Any, Final

from typer.core import TyperCommand, TyperGroup

MORE: Final = "More options"
"""Heading of the options that only the whole help shows; an option is marked with it as its `rich_help_panel`."""
WHOLE: Final = "--help-all"
HELP_FLAGS: Final = ("--help", "-h", WHOLE)
_ASKED: Final = "bench.cli.whole_help"
_VALUES: Final = {"int": "N", "int range": "N", "float": "X", "float range": "X", "path": "PATH"}


def ask_whole_help(ctx: Any) -> None:
    """Make the help of a context's command, and of those below it, show all options."""
    ctx.meta[_ASKED] = True


def is_whole_help(ctx: Any) -> bool:
    """Return whether the whole help is asked for."""
    return bool(ctx.meta.get(_ASKED))


def with_plain_help(ctx: Any, args: list[str]) -> list[str]:
    """Return arguments with `--help-all` replaced by `--help`, after noting that the whole help is asked for."""
    options = args[: args.index("--")] if "--" in args else args
    if WHOLE not in options:
        return args
    ask_whole_help(ctx)
    place = options.index(WHOLE)
    return [*args[:place], "--help", *args[place + 1 :]]


def argument_name(argument: Any) -> str:
    """Return how the help names an argument."""
    return str(argument.metavar or argument.name.upper())


class BenchCommand(TyperCommand):
    """A command whose help shows the common options, and all of them with `--help-all`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `--help-all` shows the whole help."""
        return list(super().parse_args(ctx, with_plain_help(ctx, args)))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the arguments, in brackets where optional, and then the options."""
        arguments = [one for one in self.params if one.param_type_name == "argument"]
        return [*map(_in_usage, arguments), "[OPTIONS]"]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and common options; the other options only in the whole help."""
        shown: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": [], MORE: []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            if parameter.param_type_name == "argument":
                words = re.sub(r" +\[required\]$", "", record[1])
                shown["Arguments"].append((argument_name(parameter), words))
            else:
                panel = getattr(parameter, "rich_help_panel", None)
                heading = MORE if panel == MORE else "Options"
                shown[heading].append((_named(record[0]), record[1]))
        if shown[MORE]:
            words = f"Show all options ({len(shown[MORE])} more)."
            shown["Options"].append((WHOLE, words))
        if not is_whole_help(ctx):
            del shown[MORE]
        for heading, rows in shown.items():
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


class CommandGroup(TyperGroup):
    """A group of commands whose help lists each with its whole summary."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `--help-all` in place of a command shows the whole help of the group."""
        given = with_plain_help(ctx, args) if args[:1] == [WHOLE] else args
        return list(super().parse_args(ctx, given))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with the first line of its help."""
        rows = [(name, (command.help or "").partition("\n")[0]) for name, command in self.commands.items()]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def _in_usage(argument: Any) -> str:
    name = argument_name(argument)
    return name if argument.required or name.startswith("[") else f"[{name}]"


def _named(option: str) -> str:
    """Return an option with its value in capitals, as "--seed N" for "--seed <int range>"."""
    return re.sub(r"<(.+?)>$", lambda value: _VALUES.get(value[1], "TEXT"), option)
