"""resume: an interrupted run gone on with."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from bench.base.files import read_regular
from bench.cli import printing
from bench.cli.options import (
    RUNS,
    AnswersOption,
    JsonOption,
    LatestRun,
    PanelOption,
    RunsOption,
    WireLogOption,
    app,
)
from bench.cli.panel import link_to
from bench.cli.run import is_away, make_results

if TYPE_CHECKING:
    from rich.console import Console

    from bench.run.folder import Run
    from bench.run.listening import Asker


@app.command(epilog="Example: bench resume unit-17")
def resume(
    name: LatestRun = None,
    wire_log: WireLogOption = None,
    answers: AnswersOption = None,
    panel: PanelOption = False,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Go on with an interrupted run at the first point without a reading; make the results that it lacks."""
    from bench.run.events import RunState
    from bench.run.folder import Run
    from bench.run.listening import Interrupts, WishListener
    from bench.run.person import ControlFile
    from bench.services.execution import carry_out
    from bench.services.heard import heard_in
    from bench.services.left_runs import refuse_missing_devices, taken_up, unfinished_run
    from drivers.wire.replay import logged_wire

    printing.check_target(json)
    away = is_away(answers, panel=panel)
    found = unfinished_run(name, runs, results_too=True)
    refuse_missing_devices(found)
    out = printing.console(json=json)
    if panel:
        out.print(f"panel: {link_to(found.name, found.folder.parent)}", soft_wrap=True)
    with Interrupts() as interrupts:
        record, history = taken_up(found, interrupts.shield, results_too=True)
        with (
            closing(record),
            logged_wire(wire_log) as wire,
            WishListener(ControlFile(found.folder)) as wishes,
        ):
            if history.torn:
                printing.notes_aside(["the last line of the record was half written and is dropped"])
            if history.state is not RunState.FINISHED:
                heard = heard_in(found, record, history, wishes, out, away=away)
                _accept_changes(found, heard.asker, out)
                carry_out(found, record, history, wire, out, interrupts, heard)
        return make_results(Run(found.folder), json, interrupts)


def _accept_changes(run: Run, asker: Asker | None, out: Console) -> None:
    """Say what was changed since the run began; on a real bench the person must agree to go on without it."""
    from bench.run.person import agree
    from drivers.person import Prompt, PromptKind

    changes = _changed_since(run)
    for change in changes:
        out.print(f"note: {change}; the run goes on with the copy in its folder")
    if changes and not run.simulated and asker is not None:
        prompt = Prompt(
            id="changed",
            kind=PromptKind.CONFIRM,
            text=f"{'; '.join(changes)}. Go on as the run was begun, without these changes?",
            action={"do": "answer"},
        )
        agree(asker, prompt)


def _changed_since(run: Run) -> list[str]:
    """Say which of the files that a run was begun with look different now, where they still are."""
    from bench.run.folder import BENCH, PROCEDURE

    changes = []
    for kind, copy in (("procedure", PROCEDURE), ("bench", BENCH)):
        original = Path(str(run.manifest.get(kind)))
        if original.is_file() and read_regular(original) != read_regular(run.folder / copy):
            changes.append(f"{original} was changed since the run began")
    return changes
