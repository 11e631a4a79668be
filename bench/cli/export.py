"""export: the readings of a run as a readings file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, RunArgument, RunsOption, app
from bench.services.errors import Refused


@app.command(epilog="Example: bench export unit-17 --csv readings.csv")
def export(
    run: RunArgument,
    csv: Annotated[str, typer.Option("--csv", metavar="FILE", help="File; - is standard output.")],
    runs: RunsOption = RUNS,
) -> int:
    """Write the readings of a run as a readings file."""
    from bench.base.files import write_whole
    from bench.readings.csv import format_csv
    from bench.services.bench_selection import SUFFIX, is_told
    from bench.services.source import Request, load_sources

    (source,) = load_sources(Request([run], runs))
    text = format_csv(source.as_read)
    if csv == "-":
        sys.stdout.write(text)
    else:
        beside = Path(csv + SUFFIX)
        if beside.exists() and not is_told(beside):
            raise Refused(f"{beside}: is a file of something else; export under another name")
        write_whole(Path(csv), text)
        printing.console().print(f"{len(source.readings)} readings written to {csv}")
        if source.origin is not None:
            write_whole(beside, source.origin.text_beside(Path(csv), text.encode()))
            printing.written("where they come from", beside)
    return 0
