"""show: what a run holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.cli import printing
from bench.cli.options import RUNS, JsonOption, RunArgument, RunsOption, app

_SAID: Final = ("answered", "answer_refused")

if TYPE_CHECKING:
    from rich.console import Console

    from bench.run.folder import Run


@app.command(epilog="Example: bench show unit-17 --verify")
def show(
    run: RunArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Check the record for changed lines.")] = False,
    head: Annotated[
        str | None, typer.Option("--head", metavar="SHA256", help="Head of the chain, as noted elsewhere.")
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="PUB", help="Public key that the seal must be signed with."),
    ] = None,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="PEM", help="Certificate that its time stamp must stand on."),
    ] = None,
    runs: RunsOption = RUNS,
    json: JsonOption = None,
) -> int:
    """Show what a run holds: inputs, events, readings."""
    from bench.run.folder import find_run
    from bench.services.records import proof_of, record_head, run_summary, supply_in_words

    found = find_run(run, runs)
    verify = verify or any(given is not None for given in (head, key, authority))
    problems, told = list(found.history.problems), []
    if verify and not problems:
        proof = proof_of(found, head, key, authority)
        problems, told = list(proof.problems), list(proof.told)
    summary = run_summary(found)
    record = {**record_head(found), "told": told}
    printing.write_json(
        [{**summary, "manifest": found.manifest, "record": record, "problems": problems}], json
    )
    if json == "-":
        return 1 if problems else 0
    out = printing.console()
    for name, value in {**summary, **found.manifest}.items():
        if value not in ("", None):
            out.print(f"{name.replace('_', ' ')}: {_text(value)}")
    if supply := supply_in_words(found):
        out.print(f"supply of the block: {supply}")
    if verify:
        _print_proof(found, told, problems, out)
    else:
        _print_events(found, out)
    return 1 if problems else 0


def _print_proof(run: Run, told: list[str], problems: list[str], out: Console) -> None:
    """Print what the record proves, and what not."""
    events = len(run.history.events)
    wrong = run.history.problems
    out.print(f"record: {events} events, {'; '.join(wrong) if wrong else 'chain of hashes whole'}")
    if run.history.torn:
        out.print("record: the last line is half written; 'bench resume' drops it")
    for line in told:
        out.print(line)
    for problem in problems if not wrong else ():
        out.print(problem, style="bold")


def _text(value: object) -> str:
    """Return a value of the manifest as text; what it holds by name as a list."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {part}" for name, part in value.items())
    return str(value)


def _print_events(run: Run, out: Console) -> None:
    from bench.run.record import resume_point
    from bench.run.sentences import duration, said, sentence

    if run.imported:
        return
    steps = run.plan.steps
    for event in run.history.events:
        if event.type == "step_started":
            continue
        text = event.type
        if "step" in event.data and event.type == "step_done":
            text = steps[int(event.data["step"])].describe()
        reading = event.data.get("reading")
        if reading:
            text += "  " + "  ".join(f"{value:+.6f} {reading['unit']}" for value in reading["mean"])
        if event.type in _SAID:
            text = said(event)
        elif event.type == "chosen":
            text = sentence(event)
        for told in ("error", "reason", *(("text",) if event.type == "asked" else ())):
            if event.data.get(told):
                text += f": {event.data[told]}"
        if event.data.get("by") and event.type not in _SAID:
            text += f" ({event.data['by']}, {event.data.get('role')}, {event.data.get('where')})"
        out.print(f"{event.number:5d}  {duration(event.bench_s):>11}  {text}")
    point = resume_point(run.plan, run.history)
    if point.step < len(steps):
        out.print(f"next: step {point.step + 1}, {steps[point.step].describe()}")
