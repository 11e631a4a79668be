"""budget: what each error of a bench contributes to the coefficients and to any measured acceleration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.cli import printing, progress
from bench.cli.options import (
    BenchOption,
    EstimatorOption,
    GravityOption,
    GuardBandOption,
    JsonOption,
    LimitOption,
    ModelOption,
    OutOption,
    ProcedureOption,
    RuleOption,
    WithEstimators,
    app,
)

if TYPE_CHECKING:
    from rich.console import Console

    from bench.services.budget import BudgetResult

CoefficientsOption = Annotated[
    Path | None,
    typer.Option(
        "--coefficients", metavar="FILE", help="Block as 'calibrate --json' found it, not the bench file's."
    ),
]


@app.command(
    cls=WithEstimators,
    epilog="Example: bench budget --bench my-bench.yaml --procedure paper --estimator closed-form",
)
def budget(
    bench: BenchOption = None,
    procedure: ProcedureOption = "calibration",
    estimator: EstimatorOption = "gls",
    model: ModelOption = None,
    coefficients: CoefficientsOption = None,
    trials: Annotated[
        int, typer.Option(help="Monte Carlo trials beside the linear result; 0 for none.", min=0)
    ] = 20_000,
    rule: RuleOption = None,
    guard_band: GuardBandOption = None,
    limit: LimitOption = None,
    same_voltmeters: Annotated[
        bool,
        typer.Option("--same-voltmeters", help="The block is used with the calibration's voltmeters."),
    ] = False,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
) -> int:
    """What each error of the bench contributes to the coefficients and to any measured acceleration.

    With --rule the exit status is 1 when the check at the verification points cannot be passed with 95 %.
    """
    printing.check_target(json)
    with progress.shown():
        from bench.services import budget as api
        from bench.services.bench_selection import find_bench_file

        taken = find_bench_file(bench)
        found = api.budget(
            taken,
            procedure,
            estimator,
            model=model,
            coefficients=coefficients,
            trials=trials,
            rule=rule,
            limit=limit,
            guard_band=guard_band,
            same_voltmeters=same_voltmeters,
            g=g,
        )
    printing.bench_file(taken, json)
    printing.write_json([found.to_dict()], json)
    if out is not None:
        _write_page(out, found, printing.console(json=json))
    if json != "-":
        found.print_on(printing.console())
    return 1 if rule is not None and found.capable is False else 0


def _write_page(folder: Path, found: BudgetResult, out: Console) -> None:
    """Write the page and its figures. Raises `OSError`."""
    from bench.results.budget import figures

    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "budget.html"
    found.report(page)
    printing.written("page", page, out)
    for figure in figures(found.to_dict()):
        for file in figure.save(folder):
            printing.written("figure", file, out)
