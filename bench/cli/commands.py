"""The commands and their help. A command's module is imported when it is used, so that `bench --help` is quick.

The help shows common options; `--help-all` shows all options.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from keyword import iskeyword
from typing import Any, Final

from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_from_info, get_group

from bench.base.requests import ESTIMATORS_IN_A_BUDGET, ESTIMATORS_TOLD

MORE: Final = "More options"
"""Heading of the options that only the whole help shows; such an option has it as `rich_help_panel`."""
WHOLE: Final = "--help-all"
HELP_FLAGS: Final = ("--help", "-h", WHOLE)
_ASKED: Final = "bench.cli.whole_help"
_VALUES: Final = {"int": "N", "int range": "N", "float": "X", "float range": "X", "path": "PATH"}


def ask_whole_help(ctx: Any) -> None:
    """Note in the context that the help of the command, and of its subcommands, shall show all options."""
    ctx.meta[_ASKED] = True


def is_whole_help(ctx: Any) -> bool:
    """Return whether help with all options was requested (`--help-all`)."""
    return bool(ctx.meta.get(_ASKED))


def with_plain_help(ctx: Any, args: list[str]) -> list[str]:
    """Replace `--help-all` by `--help` in the arguments; note the request in the context."""
    options = args[: args.index("--")] if "--" in args else args
    if WHOLE not in options:
        return args
    ask_whole_help(ctx)
    place = options.index(WHOLE)
    return [*args[:place], "--help", *args[place + 1 :]]


def argument_name(argument: Any) -> str:
    """Return the name of an argument as the help shows it."""
    return str(argument.metavar or argument.name.upper())


class BenchCommand(TyperCommand):
    """A command whose help shows the common options; with `--help-all`, all options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `--help-all` shows the whole help."""
        return list(super().parse_args(ctx, with_plain_help(ctx, args)))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line: the arguments, optional ones in brackets, then the options."""
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
                shown[heading].append((_named(record[0]), _with_estimators(record[1])))
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
    """A group of commands; its help shows the whole summary of each command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `--help-all` instead of a command shows the whole help of the group."""
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


def _with_estimators(words: str) -> str:
    """Return the help of an option, with the estimators in place of their placeholder."""
    for placeholder in (ESTIMATORS_TOLD, ESTIMATORS_IN_A_BUDGET):
        if placeholder in words:
            from bench.calibration.estimators import estimators_in_words  # takes a second

            return words.replace(
                placeholder, estimators_in_words(budget=placeholder == ESTIMATORS_IN_A_BUDGET)
            )
    return words


COMMANDS: Final = {
    "run": "Run a procedure, then calibrate, verify and report.",
    "resume": "Resume an interrupted run at the first point without a reading.",
    "abort": "End an interrupted run for good; its record is kept.",
    "control": "Pause, continue, skip or stop a run that another program carries out.",
    "init": "Copy the shipped procedures and bench files, to edit them.",
    "check": "Check a procedure against a bench; list its steps and time.",
    "validate": "Validate this installation: reference data, instruments, records, certificates, machine.",
    "instruments": "Test all instruments of a bench: identity, self-test, reading.",
    "persons": "List the persons of the laboratory; add or change a person, or end their rights.",
    "panel": "Serve the operator's panel in a browser.",
    "simulate": "Serve the simulated instruments of a bench file until Ctrl-C.",
    "runs": "List the runs, their states and how to continue.",
    "show": "Show the inputs, events and readings of a run.",
    "seal": "Seal a run that has ended: sign its record and stamp the time.",
    "key": "Make the laboratory's key for seals, or a key for certificates.",
    "export": "Write the readings of a run as a readings file.",
    "import": "Make a run of readings that were measured elsewhere.",
    "failures": "Collect failures of runs in a register; note remedies; write a page for the review.",
    "catalogue": "Search many runs in a database; list the history and due date of units.",
    "calibrate": "Compute coefficients and their uncertainty from readings.",
    "coefficients": "Write coefficients for other software: JSON, CSV, C, Excel, Kalibr, PX4, ArduPilot.",
    "certificate": "Issue, verify, amend, revoke or read certificates.",
    "verify": "Compare Δg at the verification points with the limit.",
    "report": "Write the report of a run as one HTML page.",
    "diagnose": "Find the effect that explains why readings and model disagree.",
    "confirm": "Test a diagnosed model on new readings.",
    "accept": "Name and describe the unnamed terms that a diagnosis found.",
    "compensate": "Fit coefficients as polynomials in temperature; write tables for an onboard computer.",
    "tumble": "Fit each axis of a multi-point tumble by IEEE 1293:"
    " bias, scale factor, misalignments, K2, K3, Koq.",
    "stability": "Compute the Allan deviation and noise terms of a block at rest, and the averaging to use.",
    "monitor": "Chart runs of few positions over days: bias, scale factor, angle.",
    "chart": "Draw the control charts of the check block (Shewhart, EWMA).",
    "batch": "Recompute many runs; list the results and verdicts that change.",
    "compare": "Compare calibrations of one block: E_n, a joint test, drift.",
    "learn": "Estimate the errors of a bench from many runs, for its bench file.",
    "fleet": "Compare many units on many benches: equivalence, priors, drift, CMC.",
    "kit": "Compare laboratories by a travelling block: plan, sealed results, report.",
    "budget": "Compute what each error of the bench contributes to coefficients and accelerations.",
    "require": "Compute how large each error of the bench may be for a required accuracy.",
    "plan-points": "Find test points that reach an uncertainty in the least bench time.",
    "help": "Show the commands, or the help of one.",
}  # fmt: skip
"""Every command with the first line of its help, in the order in which the whole help lists them."""

MODULES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("calibrate", "verify", "report", "coefficients", "compensate", "tumble"), "evaluate"),
    **dict.fromkeys(("diagnose", "confirm", "accept"), "evaluate"),
    **dict.fromkeys(("check", "init", "budget", "require", "plan-points"), "planning"),
    **dict.fromkeys(("run", "resume", "abort", "control"), "measure"),
    **dict.fromkeys(("chart", "compare", "learn", "monitor", "stability"), "history"),
    **dict.fromkeys(("runs", "show", "seal", "key", "export", "import"), "records"),
    **dict.fromkeys(("persons", "failures", "validate"), "laboratory"),
    "simulate": "instruments",
}
"""The module in this package that defines a command, if it is not named after the command."""

HEADINGS: Final = {
    "run": "Measure",
    "init": "Prepare",
    "runs": "Records",
    "calibrate": "Evaluate",
    "budget": "Plan",
    "help": "Help",
}
"""The headings of the whole help; each key is the first command under its heading."""

COMMON: Final[Mapping[str, tuple[str, ...]]] = {
    "Prepare": ("init", "instruments", "check", "panel"),
    "Measure": ("run", "resume", "abort", "runs", "show"),
    "Evaluate": ("calibrate", "verify", "report", "diagnose", "confirm", "certificate"),
}
"""The commands that `bench --help` lists, under their headings."""

_WIDTH: Final = max(len(name) for names in COMMON.values() for name in names)

KNOWN: Final[dict[Any, Any]] = {}
"""The library's settings of each command, by the function of the command."""


class Commands(CommandGroup):
    """The group of all commands; the module of a command is imported when the command is used."""

    def __init__(self, **settings: Any) -> None:
        listed = {name: TyperCommand(name, help=line) for name, line in COMMANDS.items()}
        super().__init__(**{**settings, "commands": listed})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of this name after importing its module; None if there is no such command."""
        return load_command(cmd_name) if cmd_name in COMMANDS else None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the common commands on one screen; all commands and options if the whole help is requested."""
        if is_whole_help(ctx):
            super().format_help(ctx, formatter)
            return
        formatter.write("Usage: bench COMMAND [OPTIONS]\n")
        formatter.write(f"{self.help}\n\n")
        for heading, names in COMMON.items():
            formatter.write(f"{heading}:\n")
            with formatter.indentation():
                formatter.write_dl([(name.ljust(_WIDTH), COMMANDS[name]) for name in names])
        formatter.write("\nmore: bench help --all\none command: bench help COMMAND\n")

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write all commands with their summaries under headings, without importing their modules."""
        sections: list[tuple[str, list[tuple[str, str]]]] = []
        for name, line in COMMANDS.items():
            if name in HEADINGS or not sections:
                sections.append((HEADINGS.get(name, "Commands"), []))
            sections[-1][1].append((name, line))
        width = max(map(len, COMMANDS))
        for heading, rows in sections:
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), line) for name, line in rows])

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return completions for the name of a command or an option, without importing the commands."""
        listed = TyperGroup(name=self.name, commands=dict(self.commands), params=self.params)
        return listed.shell_complete(ctx, incomplete)


@cache
def load_command(name: str) -> Any:
    """Import the module of a command; return Typer's object for the command or the group of commands.

    The object is cached, because Typer evaluates all annotations of the command each time it makes one.
    """
    word = name.replace("-", "_") + "_" * iskeyword(name)
    module = import_module(f"bench.cli.{MODULES.get(name, word)}")
    if hasattr(module, "GROUP"):
        return get_group(module.GROUP)
    info = KNOWN[getattr(module, word)]
    return get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=None)
