"""runs: the runs there are."""

from __future__ import annotations

from bench.cli import printing
from bench.cli.options import RUNS, JsonOption, RunsOption, app


@app.command(epilog="Example: bench runs")
def runs(runs: RunsOption = RUNS, json: JsonOption = None) -> int:
    """List the runs, what became of them, and how to go on."""
    from bench.api.records import run_summary
    from bench.run.folder import all_runs

    found = [run_summary(run) for run in all_runs(runs)]
    printing.write_json([{"runs": found}], json)
    if json == "-":
        return 0
    out = printing.console()
    if not found:
        out.print(f"{runs}: no runs there")
        return 0
    table = printing.table("run", "begun", "instruments", "state", ">readings", "to go on")
    for s in found:
        begun = str(s["created"])[:19].replace("T", " ")
        table.add_row(
            str(s["name"]), begun, *(str(s[key]) for key in ("instruments", "state", "readings", "to_go_on"))
        )
    out.print(table)
    return 0
