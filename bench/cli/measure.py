"""run, resume, abort, control: carry out procedures on a bench or dry, and control runs in progress."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING

from bench.base.languages import message
from bench.base.text import as_typed
from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.errors import Refused
from bench.services.requests.measuring import AbortRun, ControlRun, ResumeRequest, RunRequest
from bench.services.requests.shared import runs_folder

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from bench.diagnosis.next_measurement import Proposal
    from bench.run.folder import Run
    from bench.run.interrupts import Interrupts
    from bench.services.execution import NewRun


@command("bench run calibration --bench my-bench.yaml --name unit-17")
def run(request: RunRequest, json: JsonOption = None) -> int:
    """Run a procedure, then calibrate, verify and report.

    With --dry-run, instruments and clock are simulated.
    """
    if request.follow and json is not None:
        raise Refused(
            "--follow makes two runs, but --json holds one result; remove --json (each run's folder holds "
            "its result)"
        )
    from bench.services.validated import refuse_contradictions

    refuse_contradictions(request)
    done, status = _measured(request, json)
    if not request.follow:
        return status
    return max(status, _follow(done, request))


def _measured(request: RunRequest, json: str | None) -> tuple[Run, int]:
    """Carry out a run and print its results; return the run and the exit status."""
    from bench.services.execution import started

    out = printing.console(json=json)

    def announce(new: NewRun) -> None:
        if json != "-":
            out.print(message(f"bench file: {new.manifest['bench']}, {new.manifest['bench_why']}"))
        printing.notes_on(out, new.notes)
        if request.panel:
            _print_link(new.folder, out, request.operator, request.laboratory)

    with started(request, out, announce) as (done, interrupts):
        return done, _results(done, interrupts, json, out)


@command("bench resume unit-17")
def resume(request: ResumeRequest, json: JsonOption = None) -> int:
    """Resume an interrupted run at the first point without a reading.

    A finished run without results gets its results.
    """
    from bench.services.execution import resumed

    out = printing.console(json=json)

    def announce(found: Run) -> None:
        if request.panel:
            _print_link(found.folder, out, request.operator, None)

    with resumed(request, out, announce) as (done, interrupts):
        return _results(done, interrupts, json, out)


def _print_link(run: Path, out: Console, operator: str, laboratory: Path | None) -> None:
    from bench.cli.panel import link_to

    out.print(message(f"panel: {link_to(run.name, run.parent, operator, laboratory)}"), soft_wrap=True)


def _results(run: Run, interrupts: Interrupts, json: str | None, out: Console) -> int:
    """Make and print the results of a finished run; return the exit status."""
    from bench.services.conclusion import ending, make_results

    found = make_results(run, interrupts)
    verdict, *others = ending(found)
    out.print(verdict, style="bold")
    for line in others:
        out.print(line)
    if found.chart_unwritten:
        printing.notes_aside([f"{found.chart_unwritten} was not written; 'bench chart --page FILE' draws it"])
    printing.write_json([found.to_dict()], json)
    return 0 if found.accepted else 1


@command("bench abort unit-17")
def abort(request: AbortRun) -> int:
    """End an interrupted run for good; its record is kept."""
    from bench.services.execution import give_up, unfinished_run
    from bench.services.persons import acting_at

    found = unfinished_run(request.name, runs_folder(request.runs))
    left = give_up(found, acting_at("command", request.operator))
    out = printing.console()
    out.print(message(f"{found.name}: aborted; its record is kept in {found.folder}"))
    for sentence in left:
        out.print(f"note: {sentence}")
    return 0


@command('bench control unit-17 skip "the cable came loose"')
def control(request: ControlRun) -> int:
    """Pause, continue, skip or stop a run that another program carries out.

    At a prompt of the run itself, type :pause, :redo, …
    """
    from bench.run.events import Wish
    from bench.run.folder import find_run
    from bench.run.person import SIGN, leave_wish, parse_wish
    from bench.run.record import is_being_written
    from bench.services.persons import acting_at

    found = find_run(request.run, runs_folder(request.runs))
    try:
        wish = parse_wish(f"{request.wish} {request.reason}")
    except ValueError as mistake:
        raise Refused(str(mistake).replace(SIGN, "")) from mistake
    if not is_being_written(found.folder):
        raise Refused(
            f"{found.name}: no program is carrying out this run; 'bench runs' shows how to continue"
        )
    asked = replace(wish, by_person=False, who=acting_at("command", request.operator))
    leave_wish(found.folder, asked)
    when = (
        message("at once")
        if asked.wish is Wish.STOP
        else message("before the next step, or at the open question")
    )
    printing.console().print(message(f"{found.name}: {asked.wish} was sent; it takes effect {when}"))
    return 0


# --- run --follow -----------------------------------------------------------------------------------


def _follow(run: Run, request: RunRequest) -> int:
    """Diagnose a run, carry out the measurement that the diagnosis proposes, and diagnose both runs together.

    On real instruments, a person must agree first. Returns the exit status of the second run; 0 if there was none.
    """
    from bench.run.folder import Run as RunFolder
    from bench.services.conclusion import run_again

    out = printing.console()
    proposal = _diagnosed([run])
    if proposal is None:
        out.print(message(f"{run.name}: no procedure would show more"))
        return 0
    if not run.simulated and not _agreed(proposal, out):
        out.print(
            message(
                f"{run.name}: not continued; measure it later with: {run_again(run, as_typed(proposal.procedure))}"
            )
        )
        return 0
    name = next(name for n in count(2) if not run.folder.with_name(name := f"{run.name}-{n}").exists())
    # with another seed, a dry run simulates other errors of the stand for the further mountings
    seed = request.seed + 1
    further = replace(request, procedure=str(proposal.procedure), name=name, seed=seed, until=None)
    _, status = _measured(further, None)
    _diagnosed([run, RunFolder(run.folder.with_name(name))])
    return status


def _diagnosed(runs: list[Run]) -> Proposal | None:
    """Diagnose runs as one body of readings and print the result; return the proposed next measurement, or None.

    The JSON result is written into the folder of the last run.
    """
    from bench.cli.evaluate import carried_out
    from bench.services.requests.evaluation import Diagnose
    from bench.services.source import done

    request = Diagnose([str(run.folder) for run in runs], runs=runs[0].folder.parent)
    file = runs[-1].folder / ("diagnose-together.json" if len(runs) > 1 else "diagnose.json")
    (result,) = done(carried_out(request, str(file), together=True))
    return result.next_measurement


def _agreed(proposal: Proposal, out: Console) -> bool:
    from bench.run.person import YES, ask
    from bench.run.terminal import TerminalPerson
    from drivers.interfaces import NoAnswer
    from drivers.person import Prompt, PromptKind

    prompt = Prompt(
        id="follow",
        kind=PromptKind.CONFIRM,
        text=message(f"Carry out {proposal.procedure.name} now (about {proposal.minutes:.0f} min)?"),
        action={"do": "answer"},
    )
    try:
        return ask(TerminalPerson(sys.stdin, out), prompt).lower() in YES
    except NoAnswer:
        return False
