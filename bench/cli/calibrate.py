"""calibrate: coefficients with uncertainty from runs or readings files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    CalibrateEstimatorOption,
    GravityOption,
    JoinFreeOption,
    JoinVerificationOption,
    JsonOption,
    ModelOption,
    NominalOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    StrictFitOption,
    WithEstimators,
    app,
)


@app.command(
    cls=WithEstimators,
    epilog="Example: bench calibrate readings.csv --bench my-bench.yaml --json coefficients.json",
)
def calibrate(
    sources: Sources,
    estimator: CalibrateEstimatorOption = "gls",
    nominal_angles: NominalOption = False,
    join_free: JoinFreeOption = True,
    join_verification: JoinVerificationOption = False,
    prior: Annotated[
        Path | None,
        typer.Option(
            "--prior", metavar="FILE", help="What units of its type tell: a file of 'bench fleet prior'."
        ),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: StrictFitOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Coefficients with uncertainty from runs or readings files; exit status 1 where they do not fit."""
    from bench.calibration.estimators import GLS, find_estimator
    from bench.services.calibration import calibration_of
    from bench.services.source import Request, done, each, load_each

    printing.check_target(json)
    loaded = load_each(Request(sources, runs, bench, model, g, out, skip_bad_rows))
    printing.bench_files(done(loaded), json)
    everyone = each(
        loaded,
        lambda source: calibration_of(
            source,
            estimator,
            nominal_angles=nominal_angles,
            join_free=join_free,
            join_verification=join_verification,
            prior=prior,
        ),
    )
    results = done(everyone)
    other = find_estimator(estimator).name != GLS or nominal_angles or not join_free or join_verification
    other = other or prior is not None
    for result in results:
        what_if = other or result.source.what_if
        file = printing.write_result(result.source, "calibrate", result.to_dict(), what_if=what_if)
        if json == "-":
            printing.notes_aside(result.notes)
        else:
            printing.calibration(result, file)
    printing.write_json([one.to_dict() for one in everyone], json)
    if printing.failed(everyone):
        return 2
    accepted = [result.strictly_accepted if strict else result.accepted for result in results]
    return 0 if all(accepted) else 1
