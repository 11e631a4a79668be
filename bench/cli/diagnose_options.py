"""The command on discrepancies between simulation and bench: diagnose."""

from __future__ import annotations

import os
from typing import Annotated, Final

import typer

from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    ModelOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    app,
)

THREADS: Final = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Where the libraries of linear algebra look for the number of their threads."""


@app.command(epilog="Example: bench diagnose unit-17 --json diagnosis.json")
def diagnose(
    sources: Sources,
    together: Annotated[
        bool, typer.Option("--together", help="Several sources are one body of data: one block, one bench.")
    ] = False,
    accept_first: Annotated[
        bool,
        typer.Option(
            "--accept-first",
            help="Write the model also where the data cannot tell: with the likeliest effect.",
        ),
    ] = False,
    report: Annotated[
        bool | None,
        typer.Option(
            "--report/--no-report", help="Write the page (default: for one source, not for several)."
        ),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[bool, typer.Option("--strict", help="A discrepancy found is not accepted.")] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Where readings and model disagree: name the missing effect, add it, show the gap shrink."""
    # many small matrices: the threads of a linear algebra library would wait for one another
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from bench.cli import diagnose as command
    from bench.cli.source import Request

    request = Request(sources, runs, bench, model, g, out, skip_bad_rows)
    options = command.Options(together, accept_first, report, strict)
    return command.diagnose(request, options, json)
