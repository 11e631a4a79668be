"""The list of commands. A command's module is imported when it is used, so that `bench --help` is quick."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from keyword import iskeyword
from typing import Any, Final

from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_from_info, get_group

COMMANDS: Final = {
    "run": "Run a procedure on the bench, or dry on simulated instruments; then calibrate, verify, report.",
    "resume": "Go on with an interrupted run at the first point without a reading; make the results that it lacks.",
    "abort": "End an interrupted run for good; its record is kept.",
    "control": "Ask something of a run that another program is carrying out;"
    " typed at a prompt it is :pause, :redo, …",
    "init": "Write copies of the shipped procedures and bench files, to edit.",
    "check": "Validate a procedure against a bench and print steps, time and operator actions;"
    " touch no instrument.",
    "instruments": "Open every instrument of a bench at once:"
    " identity, self-test, a reading, and all that is wrong.",
    "panel": "Serve the operator's panel in a browser over a folder of runs; make the tokens of who may come in.",
    "simulate": "Serve the simulated instruments of a bench file until Ctrl-C,"
    " or command a bench that is served.",
    "runs": "List the runs, what became of them, and how to go on.",
    "show": "Show what a run holds: inputs, events, readings.",
    "seal": "Seal a run that has ended: note the head of its chain, signed with a key, stamped with the time.",
    "key": "Make the laboratory's key (Ed25519, PEM), with which 'bench seal' signs;"
    " or one that signs certificates.",
    "export": "Write the readings of a run as a readings file.",
    "import": "Make a run of a readings file that was measured elsewhere.",
    "catalogue": "Many run folders in a database: what was measured with what, a unit's history, when it is due.",
    "calibrate": "Coefficients with uncertainty from runs or readings files; exit status 1 where they do not fit.",
    "coefficients": "Write N = K⁻¹ and misalignments for other software: JSON, CSV, C, Excel,"
    " Kalibr, PX4, ArduPilot.",
    "certificate": "Certificates, on paper and for machines: issue, verify, amend, revoke, read.",
    "verify": "Δg at the verification points against the limit; exit status 1 unless all are accepted.",
    "report": "Write the report of a run: one HTML page.",
    "diagnose": "Where readings and model disagree: name the missing effect, add it, show the gap shrink.",
    "confirm": "New readings with and without a model: how far it closes the gap; exit status 1 unless confirmed.",
    "accept": "Give terms without a name, which a diagnosis found, a name and a sentence.",
    "compensate": "Coefficients as polynomials in temperature; tables (C, CSV, JSON) for a computer on board.",
    "tumble": "Each axis of a multi-point tumble by IEEE 1293:"
    " bias, scale factor, misalignments, K2, K3, Koq.",
    "stability": "Allan deviation and noise terms of a block at rest, and the averaging that a reading deserves.",
    "chart": "Control charts of the check block (Shewhart, EWMA); exit status 1 unless its last run is in control.",
    "batch": "Compute many runs anew: what changes, which verdicts would be different; goes on where it stopped.",
    "compare": "What changed between calibrations of one block: E_n, a joint test, drift.",
    "learn": "What many runs tell of one bench: its stand, noise, head; as a file that its bench file takes.",
    "fleet": "Many units on many benches: is it the bench or the block? Equivalence, priors, drift, CMC.",
    "budget": "What each error of the bench contributes to the coefficients and to any measured acceleration.",
    "require": "How large each error of the bench may be for an accuracy; exit status 1 when it is not kept now.",
    "plan-points": "Test points that reach an uncertainty in the least bench time, or the most in a given time.",
}  # fmt: skip
"""Every command with the first line of its help, in the order in which the help lists them."""

MODULES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("calibrate", "verify", "report", "coefficients", "compensate", "tumble"), "evaluate"),
    **dict.fromkeys(("diagnose", "confirm", "accept"), "evaluate"),
    **dict.fromkeys(("check", "init", "budget", "require", "plan-points"), "planning"),
    **dict.fromkeys(("run", "resume", "abort", "control"), "measure"),
    **dict.fromkeys(("chart", "compare", "learn", "stability"), "history"),
    **dict.fromkeys(("runs", "show", "seal", "key", "export", "import"), "records"),
    "simulate": "instruments",
}
"""The module in this package that defines a command, if it is not named after the command."""

HEADINGS: Final = {
    "run": "Measure",
    "init": "Prepare",
    "runs": "Records",
    "calibrate": "Evaluate",
    "budget": "Plan",
}  # fmt: skip
"""Headings in the help, by the first command below each."""


COMPLETED_BY: Final[list[Callable[[Any], Any]]] = []
"""Holds the function that adds the shared options to a command. `bench.cli.options` appends it when it is
imported, because importing it here would be circular."""


class Commands(TyperGroup):
    """The group of all commands; the module of a command is imported when the command is used."""

    def __init__(self, **settings: Any) -> None:
        listed = {name: TyperCommand(name, help=line) for name, line in COMMANDS.items()}
        super().__init__(**{**settings, "commands": listed})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of this name after importing its module; None if there is no such command."""
        return load_command(cmd_name) if cmd_name in COMMANDS else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands with their full summaries under headings, without importing their modules."""
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


def load_command(name: str) -> Any:
    """Import the module of a command; return the library's object for the command or the group of commands."""
    word = name.replace("-", "_") + "_" * iskeyword(name)
    module = import_module(f"bench.cli.{MODULES.get(name, word)}")
    if hasattr(module, "GROUP"):
        group = get_group(module.GROUP)
        for command in group.commands.values():
            COMPLETED_BY[0](command)
        return group
    mine = {one.callback: one for one in module.app.registered_commands}
    info = mine[getattr(module, word)]
    command = get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=None)
    return COMPLETED_BY[0](command)
