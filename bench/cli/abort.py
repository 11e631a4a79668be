"""abort: an interrupted run ended for good."""

from __future__ import annotations

from bench.cli import printing
from bench.cli.options import RUNS, LatestRun, RunsOption, app


@app.command(epilog="Example: bench abort unit-17")
def abort(name: LatestRun = None, runs: RunsOption = RUNS) -> int:
    """End an interrupted run for good; its record is kept."""
    from bench.run.person import at_the_shell
    from bench.services.left_runs import give_up, unfinished_run

    found = unfinished_run(name, runs)
    left = give_up(found, at_the_shell("command"))
    out = printing.console()
    out.print(f"{found.name}: aborted; its record is kept in {found.folder}")
    for sentence in left:
        out.print(f"look: {sentence}")
    return 0
