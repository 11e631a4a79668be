"""resume: an interrupted run gone on with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli import printing
from bench.cli.options import RUNS, JsonOption, LatestRun, RunsOption, WireLogOption, app
from bench.cli.run import conclude

if TYPE_CHECKING:
    from bench.run.folder import Run


@app.command(epilog="Example: bench resume unit-17")
def resume(
    name: LatestRun = None,
    wire_log: WireLogOption = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Go on with an interrupted run at the first point without a reading."""
    from bench.api.execution import carry_out, refuse_missing_devices, taken_up, unfinished_run
    from bench.run.folder import Run
    from bench.run.signals import Interrupts
    from drivers.wire.log import logged_wire

    printing.check_target(json)
    found = unfinished_run(name, runs)
    refuse_missing_devices(found)
    _accept_changes(found, json)
    with logged_wire(wire_log) as wire, Interrupts() as interrupts:
        record, history = taken_up(found, interrupts.shield)
        if history.torn:
            printing.notes_aside(["the last line of the record was half written and is dropped"])
        carry_out(found, record, history, wire, printing.console(json=json), interrupts)
    return conclude(Run(found.folder), json)


def _accept_changes(run: Run, target: str | None) -> None:
    """Say what was changed since the run began; on a real bench the person must agree to go on without it."""
    from bench.run.prompts import agree
    from bench.run.terminal import TerminalPerson
    from drivers.interfaces import Prompt, PromptKind

    changes = _changed_since(run)
    out = printing.console(json=target)
    for change in changes:
        out.print(f"note: {change}; the run goes on with the copy in its folder")
    if changes and not run.simulated:
        prompt = Prompt(
            id="changed",
            kind=PromptKind.CONFIRM,
            text="Go on as the run was begun, without these changes?",
            action={"do": "answer"},
        )
        agree(TerminalPerson(sys.stdin, out, wishes=()), prompt)


def _changed_since(run: Run) -> list[str]:
    """Say which of the files that a run was begun with look different now, where they still are."""
    from bench.run.folder import BENCH, PROCEDURE

    changes = []
    for kind, copy in (("procedure", PROCEDURE), ("bench", BENCH)):
        original = Path(str(run.manifest.get(kind)))
        if original.is_file() and original.read_bytes() != (run.folder / copy).read_bytes():
            changes.append(f"{original} was changed since the run began")
    return changes
