"""check, init, budget, require, plan-points: preparations of a measurement."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.languages import message
from bench.base.text import as_typed
from bench.cli import printing
from bench.cli.options import JsonOption, OutOption, command
from bench.services.errors import Refused, refusing
from bench.services.requests.measuring import Budget, Check, Init, PlanPoints, Require
from bench.services.requests.shared import devices_to_type, runs_to_type

if TYPE_CHECKING:
    from rich.console import Console

    from bench.results.budget import BudgetResult
    from bench.results.check import Findings


@command("bench check calibration --bench my-bench.yaml")
def check(
    request: Check,
    json: JsonOption = None,
    every_step: Annotated[
        bool, typer.Option("--all", help="List every step; by default, equal steps share a line.")
    ] = False,
    instruments: Annotated[
        bool, typer.Option("--instruments", help="Also open the instruments of the bench.")
    ] = False,
) -> int:
    """Check a procedure against a bench; list its steps and time.

    With --morning, check the bench itself before the day's work.
    """
    if request.morning:
        return _morning(request, json)
    from bench.results.check import print_findings
    from bench.services.until import look_ahead

    found = look_ahead(request)
    printing.write_json([found.result.to_dict()], json)
    if json != "-":
        print_findings(found, printing.console(), every_step=every_step)
    status = 1 if found.result.problems else 0
    if instruments:
        from bench.cli.instruments import look

        status = max(status, look(None if request.bench is None else str(request.bench)))
    if json != "-" and not status:
        _offer_dry_run(found, request)
    return status


def _morning(request: Check, json: str | None) -> int:
    """Carry out the morning check and print one line; return the exit status, as for a commissioning."""
    from bench.base.text import visible
    from bench.run.commission.session import WISHES
    from bench.run.terminal import TerminalPerson
    from bench.services.instruments import PAGE, line_of, morning

    if not request.dry_run and not sys.stdin.isatty():
        raise Refused(
            "the morning check asks a person and turns the head; start it in a terminal, or add --dry-run"
        )
    out = printing.console(json=json)
    person = None if request.dry_run else TerminalPerson(sys.stdin, out, wishes=WISHES)
    result, folder = morning(request, person, lambda line: printing.in_words(out, visible(line)))
    printing.write_json([result], json)
    printing.written("page", folder / PAGE, out)
    status = 1 if result["to_do"] else int(result["status"])
    printing.in_words(out, line_of(result), style="bold red" if status else "bold green")
    return status


def _offer_dry_run(found: Findings, request: Check) -> None:
    if found.can_be_tried:
        bench = f" --bench {as_typed(request.bench)}" if request.bench else ""
        until = "".join(f" --until {as_typed(goal)}" for goal in request.until or ())
        runs = "" if request.runs is None else runs_to_type(Path(request.runs))
        words = f"bench run {as_typed(request.procedure)}{bench}{until}{runs}{devices_to_type()} --dry-run"
        printing.console().print(f"no mistakes found; try it with: {words}")


@command("bench init my-lab")
def init(request: Init) -> int:
    """Copy the shipped procedures and bench files, to edit them."""
    from bench.config.shipped import copy_shipped

    folder = request.folder
    with refusing("choose another folder", folder):
        copied = copy_shipped(folder)
    out = printing.console()
    for path in copied:
        out.print(f"wrote {path}")
    if not copied:
        out.print(f"{folder}: every shipped file exists already; nothing was written")
    return 0


@command("bench budget paper --bench my-bench.yaml --estimator closed-form")
def budget(request: Budget, json: JsonOption = None, out: OutOption = None) -> int:
    """Compute what each error of the bench contributes to coefficients and accelerations.

    With --rule, exit status 1 if a verification point passes with less than 95 % probability.
    """
    with printing.progress():
        from bench.services.planning import budget_of

        found = budget_of(request)
    printing.bench_file(found.bench_file, json)
    printing.write_json([found.to_dict()], json)
    if out is not None:
        _write_page(out, found, printing.console(json=json))
    if json != "-":
        found.print_on(printing.console())
    return 1 if request.rule is not None and found.capable is False else 0


def _write_page(folder: Path, found: BudgetResult, out: Console) -> None:
    """Write the page of a budget and its figures into a folder. Raises `OSError`."""
    from bench.results.budget import figures

    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "budget.html"
    found.report(page)
    printing.written("page", page, out)
    for figure in figures(found):
        for file in figure.save(folder):
            printing.written(message("figure", "heading"), file, out)


@command("bench require paper --accuracy 3e-4 --estimator closed-form")
def require(request: Require, json: JsonOption = None) -> int:
    """Compute how large each error of the bench may be for a required accuracy.

    Exit status 1 if the bench does not keep the limits now.
    """
    with printing.progress():
        from bench.services.planning import requirements

        found = requirements(request)
    printing.bench_file(found.result.bench_file, json)
    printing.told(found.result, json, found.print_on)
    return 0 if found.result.kept else 1


@command("bench plan-points --u all=1.2e-4 --out procedures/short.yaml", "plan-points")
def plan_points(request: PlanPoints, json: JsonOption = None) -> int:
    """Find test points that reach an uncertainty in the least bench time.

    With --time, find the lowest uncertainty in that time.
    """
    with printing.progress():
        from bench.services.planning import planned

        found = planned(request)
    printing.bench_file(found.result.bench_file, json)
    printing.told(found.result, json, found.print_on)
    return 1 if found.result.reached is False else 0
