"""runs: the runs there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from bench.cli import printing
from bench.cli.options import RUNS, JsonOption, RunsOption, app

_NAME: Final = 19
"""Characters of the column of names, so that a line with everything has 80."""


@app.command(epilog="Example: bench runs")
def runs(runs: RunsOption = RUNS, json: JsonOption = None) -> int:
    """List the runs, what became of them, and how to go on."""
    from bench.services.records import run_summaries

    found = run_summaries(runs)
    printing.write_json([{"runs": found}], json)
    if json == "-":
        return 0
    out = printing.console()
    if not found:
        out.print(f"{runs}: no runs there")
        return 0
    out.print(_line("run", ("begun", "instruments", "state", "readings", "verdict")), style="bold")
    for s in found:
        begun = str(s["created"])[:16].replace("T", " ")
        state, _, damage = str(s["state"]).partition(": ")
        facts = (begun, s["instruments"], state, s["readings"], str(s["verdict"] or "-").upper())
        out.print(_line(str(s["name"]), facts))
        if damage:
            out.print(f"    {damage}")
        if s["to_go_on"]:
            out.print(f"    {s['to_go_on']}")
    return 0


def _line(name: str, facts: Sequence[object]) -> str:
    """Return a line of 80 characters; a name that is too long for its column has a line of its own."""
    begun, instruments, state, readings, verdict = facts
    shown = f"{begun!s:16}  {instruments!s:11}  {state!s:10}  {readings!s:>8}  {verdict}"
    separate = "\n" if len(name) > _NAME else ""
    return f"{name}{separate}{'':{_NAME if separate else max(_NAME - len(name), 0)}} {shown}"
