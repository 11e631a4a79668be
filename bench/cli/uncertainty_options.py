"""Commands on uncertainty and planning: budget, require, plan-points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli.options import (
    ESTIMATORS_IN_A_BUDGET,
    BenchOption,
    GravityOption,
    JsonOption,
    ModelOption,
    OutOption,
    RuleOption,
    WithEstimators,
    app,
)

ProcedureOption = Annotated[
    str, typer.Option("--procedure", metavar="FILE", help="Procedure, by path or shipped name.")
]
EstimatorOption = Annotated[str, typer.Option(help=ESTIMATORS_IN_A_BUDGET)]
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
    limit: Annotated[
        float | None, typer.Option(help="Limit of |Δg| in g, in place of the bench file's.")
    ] = None,
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
    from bench.cli import budget as command

    return command.budget(
        command.Request(
            bench,
            procedure,
            estimator,
            model,
            coefficients,
            trials,
            rule,
            limit,
            same_voltmeters,
            g,
            json,
            out,
        )
    )


@app.command(
    cls=WithEstimators,
    epilog="Example: bench require --accuracy 3e-4 --estimator closed-form --procedure paper",
)
def require(
    accuracy: Annotated[str, typer.Option(help="What k u must keep to: g (of a coefficient V/g or V).")],
    of: Annotated[
        str, typer.Option(help="delta-g, acceleration (its vector), modulus, or a coefficient such as Kyx.")
    ] = "delta-g",
    up_to: Annotated[
        str | None, typer.Option(help="Largest acceleration, such as 5g (default: the block's range).")
    ] = None,
    k: Annotated[float, typer.Option(help="How many standard uncertainties the accuracy is.")] = 3.0,
    with_reading: Annotated[
        bool,
        typer.Option(
            "--with-reading", help="The errors of the reading in use count, not the coefficients' alone."
        ),
    ] = False,
    all_errors: Annotated[
        bool,
        typer.Option(
            "--all-errors", help="So do gain, gravity, temperature, nonlinearity, which no reading shows."
        ),
    ] = False,
    share: Annotated[
        str, typer.Option(help="Limits together: equal parts of the variance, or cost.")
    ] = "equal",
    cost: Annotated[
        list[str] | None,
        typer.Option("--cost", metavar="NAME=WEIGHT", help="Cost of making an error small (default 1)."),
    ] = None,
    estimator: EstimatorOption = "gls",
    procedure: ProcedureOption = "calibration",
    bench: BenchOption = None,
    json: JsonOption = None,
) -> int:
    """How large each error of the bench may be for an accuracy; exit status 1 when it is not kept now."""
    from bench.cli import require as command

    return command.require(
        command.Request(
            accuracy=accuracy,
            of=of,
            up_to=up_to,
            k=k,
            reading=with_reading,
            every_source=all_errors,
            share=share,
            costs=tuple(cost or ()),
            estimator=estimator,
            procedure=procedure,
            bench=bench,
            json=json,
        )
    )


@app.command("plan-points", epilog="Example: bench plan-points --u all=5e-5 --out procedures/short.yaml")
def plan_points(
    bench: BenchOption = None,
    u: Annotated[
        list[str] | None,
        typer.Option(
            "--u", metavar="NAME=U", help="Standard uncertainty asked for: Kyx=20e-6 (V/g), U0, K, all."
        ),
    ] = None,
    delta_g: Annotated[
        float | None, typer.Option("--delta-g", help="u(Δg) asked for at the verification points, g.")
    ] = None,
    modulus: Annotated[
        float | None, typer.Option(help="u(|a|) asked for in every direction, g: see --up-to.")
    ] = None,
    up_to: Annotated[
        str | None, typer.Option(help="Largest |a| for --modulus, g (default: the block's range).")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="The most uncertainty taken away in so much bench time, such as 4h.")
    ] = None,
    least: Annotated[str, typer.Option(help="What is to be least: time or settings.")] = "time",
    installations: Annotated[
        str | None,
        typer.Option(help="Installations to choose from, such as 1,2,1T90 (default: 1,2)."),
    ] = None,
    angles: Annotated[int, typer.Option(help="Angles in a turn to choose from.")] = 24,
    visits: Annotated[int, typer.Option(help="How often an installation may be mounted.", min=1, max=4)] = 1,
    most_mountings: Annotated[int, typer.Option(help="Mountings of a plan at most.", min=1, max=6)] = 3,
    most_settings: Annotated[int, typer.Option(help="Settings of a plan at most.", min=4)] = 300,
    cost_setting: Annotated[str, typer.Option(help="Time to set the head once.")] = "2min",
    cost_remount: Annotated[str, typer.Option(help="Time to mount the block.")] = "20min",
    cost_soak: Annotated[str, typer.Option(help="Time in which the block settles after it.")] = "10min",
    warm_up: Annotated[str, typer.Option(help="Time before the first reading.")] = "1h",
    verify: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Verification points at the end of the procedure.")
    ] = True,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Procedure file to write; never overwritten.")
    ] = None,
    json: JsonOption = None,
) -> int:
    """Test points that reach an uncertainty in the least bench time, or the most in a given time."""
    from bench.cli import plan_points as command

    return command.plan_points(
        command.Request(
            bench=bench,
            u=tuple(u or ()),
            delta_g=delta_g,
            modulus=modulus,
            up_to=up_to,
            time=time,
            least=least,
            installations=installations,
            angles=angles,
            visits=visits,
            most_mountings=most_mountings,
            most_settings=most_settings,
            cost_setting=cost_setting,
            cost_remount=cost_remount,
            cost_soak=cost_soak,
            warm_up=warm_up,
            verify=verify,
            out=out,
            json=json,
        )
    )
