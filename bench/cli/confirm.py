"""confirm: new readings with and without a model file; is its effect confirmed, changed or gone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base.computing import one_thread
from bench.cli import completing, printing, progress
from bench.cli.options import RUNS, BenchOption, GravityOption, JsonOption, RunsOption, SkipOption, app


@app.command(epilog="Example: bench confirm unit-18 --model runs/unit-17/diagnose-model.yaml")
def confirm(
    source: Annotated[
        str,
        typer.Argument(
            metavar="NEW", help="New readings: a run or a readings file.", autocompletion=completing.sources
        ),
    ],
    model: Annotated[
        Path,
        typer.Option("--model", metavar="FOUND", help="Model file of 'diagnose', found in other readings."),
    ],
    bench: BenchOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    skip_bad_rows: SkipOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """New readings with and without a model: how far it closes the gap; exit status 1 unless confirmed."""
    one_thread()
    from bench.services.confirmation import confirmation_of
    from bench.services.source import Request, load_sources

    printing.check_target(json)
    loaded = load_sources(Request([source], runs, bench, model, g, None, skip_bad_rows))
    printing.bench_files(loaded, json)
    with progress.shown():
        result = confirmation_of(loaded[0])
    printing.write_json([result.to_dict()], json)
    result.print_on(printing.console(json=json))
    return 0 if result.confirmed else 1
