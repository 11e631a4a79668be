"""require: what the bench must be for an accuracy, error by error and as a balanced set."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.base.numbers import figures
from bench.cli import printing, progress
from bench.cli.options import BenchOption, EstimatorOption, JsonOption, ProcedureOption, WithEstimators, app

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.calibration.budget.error_source import ErrorSource
    from bench.planning.requirements import Limit
    from bench.services.budget import RequirementAnswer

_MICRO: Final = 1e-6
_SHOWN: Final = {
    "rad": ("″", math.pi / 648000),
    "rad/s": ("″ a day", math.pi / 648000 / 86400),
    "V": (" µV", _MICRO),
    "1": (" ppm", _MICRO),
    "1/g": (" µg/g²", _MICRO),
    "1/g^2": (" µg/g³", _MICRO),
}


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
    printing.check_target(json)
    with progress.shown():
        from bench.services.bench_selection import find_bench_file
        from bench.services.budget import requirements

        taken = find_bench_file(bench)

        answer = requirements(
            accuracy,
            of,
            up_to=up_to,
            k=k,
            reading=with_reading,
            every_source=all_errors,
            share=share,
            costs=tuple(cost or ()),
            estimator=estimator,
            procedure=procedure,
            bench=taken,
        )
    printing.bench_file(taken, json)
    _print(answer, printing.console(json=json))
    printing.write_json([answer.to_json()], json)
    asked = answer.requirement
    return 0 if asked.keeps(asked.reached()) else 1


def _print(answer: RequirementAnswer, out: Console) -> None:
    """Print the limits, the alternatives, whether the bench as it is keeps to the accuracy."""
    asked = answer.requirement
    what = answer.of
    if answer.up_to_g is not None:
        what += f" up to {answer.up_to_g:g} g"
    out.print(
        f"{what}: {asked.k:g} u within {_micro(asked.accuracy)} µ{answer.unit}, by {asked.estimator} from "
        f"procedure {answer.plan.name} on {answer.taken.file.name}"
    )
    out.print(_limit_table(answer))
    if answer.unbalanced:
        out.print(f"no balanced set: {answer.unbalanced}")
    out.print(_alternative_table(answer))
    kept = "KEPT" if asked.keeps(asked.reached()) else "NOT KEPT"
    counted = " by the errors counted" if answer.beside else ""
    out.print(
        f"bench as it is: {asked.k:g} u = {_micro(asked.reached())} µ{answer.unit}{counted}: {kept}",
        style="bold",
    )
    if answer.beside:
        out.print(_not_counted(answer))


def _not_counted(answer: RequirementAnswer) -> str:
    asked = answer.requirement
    more = ", MORE THAN THE ACCURACY" if answer.beside > asked.accuracy else ""
    return (
        f"not counted: {' and '.join(answer.left_out)}: {asked.k:g} u = {_micro(answer.beside)} µ{answer.unit} "
        f"by itself{more}"
    )


def _limit_table(answer: RequirementAnswer) -> Table:
    how = "equal shares" if answer.share == "equal" else "by cost"
    table = printing.table(
        "error", "as", ">now", ">part of variance", ">limit alone", f">limits together, {how}"
    )
    shares = answer.requirement.shares()
    balanced = {limit.source.name: limit for limit in answer.balanced}
    for limit in answer.alone:
        source = limit.source
        together = _limit_in_words(balanced[source.name]) if source.name in balanced else ""
        table.add_row(
            source.name,
            _form(source),
            _size(source.distribution.limit, source),
            f"{shares[source.name]:.1%}",
            _limit_in_words(limit),
            together,
        )
    return table


def _alternative_table(answer: RequirementAnswer) -> Table:
    from bench.run.sentences import duration

    name = answer.alternatives[0].limit.source.name if answer.alternatives else ""
    k_u = f">{answer.requirement.k:g} u"
    table = printing.table("estimator", "procedure", ">settings", ">time", k_u, f">limit of {name} alone")
    for other in answer.alternatives:
        table.add_row(
            other.estimator,
            other.procedure,
            str(other.settings),
            duration(other.time_s),
            f"{_micro(other.reached)} µ{answer.unit}",
            _limit_in_words(other.limit),
        )
    return table


def _form(source: ErrorSource) -> str:
    """How the bench file states the size: limits of a rectangle, or so many sigma."""
    distribution = source.distribution
    return "limits" if distribution.shape == "rectangular" else f"k = {distribution.k:g}"


def _limit_in_words(limit: Limit) -> str:
    return limit.verdict if limit.stated is None else _size(limit.stated, limit.source, down=True)


def _size(value: float, source: ErrorSource, *, down: bool = False) -> str:
    unit, size = _SHOWN.get(source.unit, (f" {source.unit}", 1.0))
    return f"{figures(value / size, down=down)}{unit}"


def _micro(value: float) -> str:
    return figures(value / _MICRO, 4)
