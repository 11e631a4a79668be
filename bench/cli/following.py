"""run --follow: after a run its diagnosis, then at once what it proposes to measure, then both runs as one."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.cli import diagnose, printing
from bench.cli.source import Request
from bench.run.folder import Run
from bench.run.prompts import YES, ask
from bench.run.terminal import TerminalPerson
from drivers.interfaces import NoAnswer, Prompt, PromptKind


def follow(run: Run, carry_out: Callable[[str, str], int]) -> int:
    """Diagnose a run; carry out what would settle what it leaves open, and diagnose both together.

    `carry_out` is given the procedure file and the name of the further run, and returns its exit status; on real
    instruments the person is asked before. Returns that status, 0 where there is nothing more to measure.
    """
    out = printing.console()
    following = _diagnosed([run])["next_measurement"]
    if following is None:
        out.print(f"{run.name}: no procedure would tell more")
        return 0
    procedure = following["procedure"]
    if not run.simulated and not _agreed(procedure, following["minutes"], out):
        out.print(f"{run.name}: not measured further; later with: bench run {procedure}")
        return 0
    further = next(f for n in count(2) if not (f := run.folder.with_name(f"{run.name}-{n}")).exists())
    status = carry_out(procedure, further.name)
    _diagnosed([run, Run(further)])
    return status


def _diagnosed(runs: list[Run]) -> dict[str, Any]:
    """Diagnose runs as one body of data, tell it, and return the result, which the last run's folder keeps."""
    names = [str(run.folder) for run in runs]
    request = Request(
        sources=names, runs=runs[0].folder.parent, bench=None, model=None, g_m_s2=None, out=None,
        skip_bad_rows=False,
    )  # fmt: skip
    file = runs[-1].folder / ("diagnose-together.json" if len(runs) > 1 else "diagnose.json")
    diagnose.diagnose(request, diagnose.Options(together=len(runs) > 1), str(file))
    result: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return result


def _agreed(procedure: str, minutes: float, out: Console) -> bool:
    prompt = Prompt(
        id="follow",
        kind=PromptKind.CONFIRM,
        text=f"Carry out {Path(procedure).name} now (about {minutes:.0f} min)?",
        action={"do": "answer"},
    )
    try:
        return ask(TerminalPerson(sys.stdin, out), prompt).lower() in YES
    except NoAnswer:
        return False
