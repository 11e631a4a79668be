"""run --follow: after a run its diagnosis, then at once what it proposes to measure, then both runs as one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import count

from rich.console import Console

from bench.cli import printing
from bench.cli.diagnose import diagnosed
from bench.diagnosis.full import FullDiagnosis
from bench.diagnosis.next_measurement import Proposal
from bench.run.folder import Run
from bench.run.person import YES, ask
from bench.run.terminal import TerminalPerson
from bench.services.source import Request, done
from drivers.interfaces import NoAnswer
from drivers.person import Prompt, PromptKind


def follow(run: Run, carry_out: Callable[[str, str], int]) -> int:
    """Diagnose a run; carry out what would settle what it leaves open, and diagnose both together.

    `carry_out` is given the procedure file and the name of the further run, and returns its exit status; on real
    instruments the person is asked before. Returns that status, 0 where there is nothing more to measure.
    """
    out = printing.console()
    proposal = _diagnosed([run]).next_measurement
    if proposal is None:
        out.print(f"{run.name}: no procedure would tell more")
        return 0
    if not run.simulated and not _agreed(proposal, out):
        out.print(f"{run.name}: not measured further; later with: bench run {proposal.procedure}")
        return 0
    further = next(f for n in count(2) if not (f := run.folder.with_name(f"{run.name}-{n}")).exists())
    status = carry_out(str(proposal.procedure), further.name)
    _diagnosed([run, Run(further)])
    return status


def _diagnosed(runs: list[Run]) -> FullDiagnosis:
    """Diagnose runs as one body of data and print it; the last run's folder keeps the JSON."""
    names = [str(run.folder) for run in runs]
    request = Request(names, runs[0].folder.parent)
    file = runs[-1].folder / ("diagnose-together.json" if len(runs) > 1 else "diagnose.json")
    (result,) = done(diagnosed(request, str(file), together=len(runs) > 1))
    return result


def _agreed(proposal: Proposal, out: Console) -> bool:
    prompt = Prompt(
        id="follow",
        kind=PromptKind.CONFIRM,
        text=f"Carry out {proposal.procedure.name} now (about {proposal.minutes:.0f} min)?",
        action={"do": "answer"},
    )
    try:
        return ask(TerminalPerson(sys.stdin, out), prompt).lower() in YES
    except NoAnswer:
        return False
