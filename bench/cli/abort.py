"""abort: an interrupted run ended for good."""

from __future__ import annotations

from bench.cli import printing
from bench.cli.options import RUNS, LatestRun, RunsOption, app


@app.command(epilog="Example: bench abort unit-17")
def abort(name: LatestRun = None, runs: RunsOption = RUNS) -> int:
    """End an interrupted run for good; its record is kept."""
    from bench.api.execution import taken_up, unfinished_run

    found = unfinished_run(name, runs)
    record, history = taken_up(found)
    record.append("run_aborted", history.events[-1].bench_s if history.events else 0.0)
    record.close()
    out = printing.console()
    out.print(f"{found.name}: aborted; its record is kept in {found.folder}")
    if history.progress.power in {"on", "found on", "fault"}:
        out.print("look: the block was on when the run stopped, and nobody has switched it off since")
    return 0
