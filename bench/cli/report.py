"""report: the page of a run."""

from __future__ import annotations

from typing import Annotated

import typer

from bench.cli import completing, printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    GuardBandOption,
    JsonOption,
    LimitOption,
    ModelOption,
    OutOption,
    PopulationOption,
    RuleOption,
    RunsOption,
    SkipOption,
    app,
)


@app.command(epilog="Example: bench report unit-17")
def report(
    source: Annotated[
        str, typer.Argument(help="Run (name or path) or readings file.", autocompletion=completing.sources)
    ],
    limit: LimitOption = None,
    rule: RuleOption = None,
    guard_band: GuardBandOption = None,
    population: PopulationOption = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Write the report of a run: one HTML page."""
    from bench.results.verification import ReportResult
    from bench.services.calibration import calibration_of
    from bench.services.errors import Refused
    from bench.services.source import Request, load_sources
    from bench.services.verification import Asked

    printing.check_target(json)
    asked = Asked(limit, rule, guard_band, population)
    asked.check()
    (loaded,) = load_sources(Request([source], runs, bench, model, g, out, skip_bad_rows))
    on = printing.console(json=json)
    printing.bench_files([loaded], json)
    result = calibration_of(loaded)
    try:
        verdict, page = printing.report(result, on, asked)
    except OSError as error:
        raise Refused(
            f"{error.filename}: the page cannot be written ({error.strerror}); choose another place with --out DIR"
        ) from error
    if verdict is not None:
        printing.notes_on(on, verdict.sentences)
        on.print(verdict.verdict(), style="bold")
    written = ReportResult(
        report=str(page),
        bench=loaded.taken.part(),
        verification=None if verdict is None else verdict.result(),
    )
    printing.write_json([written.to_dict()], json)
    return 0 if result.accepted and (verdict is None or verdict.passed) else 1
