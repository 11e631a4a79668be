"""export: the readings of a run as a readings file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, RunArgument, RunsOption, app


@app.command(epilog="Example: bench export unit-17 --csv readings.csv")
def export(
    run: RunArgument,
    csv: Annotated[str, typer.Option("--csv", metavar="FILE", help="File; - is standard output.")],
    runs: RunsOption = RUNS,
) -> int:
    """Write the readings of a run as a readings file."""
    from bench.api.source import Request, load_sources
    from bench.readings.csv import format_csv

    (source,) = load_sources(Request([run], runs))
    text = format_csv(source.readings)
    if csv == "-":
        sys.stdout.write(text)
    else:
        Path(csv).write_text(text, encoding="utf-8", newline="")
        printing.console().print(f"{len(source.readings)} readings written to {csv}")
    return 0
