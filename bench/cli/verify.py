"""verify: Δg at the verification points against the limit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
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
    Sources,
    app,
)


@app.command(epilog="Example: bench verify unit-17 --coefficients last-year.json")
def verify(
    sources: Sources,
    coefficients: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Result of 'calibrate --json' of another day.")
    ] = None,
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
    """Δg at the verification points against the limit; exit status 1 unless all are accepted."""
    from bench.services.calibration import verification_of
    from bench.services.source import Request, done, each, load_each
    from bench.services.verification import Asked

    printing.check_target(json)
    asked = Asked(limit, rule, guard_band, population)
    asked.check()
    loaded = load_each(Request(sources, runs, bench, model, g, out, skip_bad_rows))
    printing.bench_files(done(loaded), json)
    everyone = each(loaded, lambda source: verification_of(source, coefficients, asked))
    results = done(everyone)
    for result in results:
        printing.notes_aside(result.warnings)
    for result in results:
        what_if = result.source.what_if or coefficients is not None or result.otherwise
        file = printing.write_result(result.source, "verify", result.to_dict(), what_if=what_if)
        if json == "-":
            printing.notes_aside(result.notes)
        else:
            printing.verification(result, file)
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    return 0 if all(result.accepted for result in results) else 1
