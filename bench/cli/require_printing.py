"""The answer to `bench require`, and its text in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rich.table import Table

from bench.analysis.budget.sources import ErrorSource
from bench.analysis.planning.requirements import Limit, Requirement
from bench.base.arrays import ARCSEC
from bench.base.numbers import figures
from bench.cli import printing
from bench.files.bench.file import BenchFile
from bench.model.block import COEFFICIENTS
from bench.procedure.plan import Plan
from bench.run.terminal import duration

_MICRO: Final = 1e-6
_SHOWN: Final = {
    "rad": ("″", ARCSEC),
    "V": (" µV", _MICRO),
    "1": (" ppm", _MICRO),
    "1/g": (" µg/g²", _MICRO),
    "1/g^2": (" µg/g³", _MICRO),
}


@dataclass(frozen=True)
class Request:
    """The options of `bench require`."""

    accuracy: str
    of: str
    up_to: str | None
    k: float
    reading: bool
    every_source: bool
    share: str
    costs: Sequence[str]
    estimator: str
    procedure: str
    bench: str | None
    json: str | None


@dataclass(frozen=True)
class Alternative:
    """Another estimator or procedure: what it gives on the bench as it is, and the limit of one source."""

    estimator: str
    procedure: str
    settings: int
    time_s: float
    reached: float
    limit: Limit


@dataclass(frozen=True)
class RequirementAnswer:
    """What is found; `up_to_g` is None where no acceleration is asked about, `beside` is k u not counted."""

    requirement: Requirement
    unit: str
    up_to_g: float | None
    alone: tuple[Limit, ...]
    balanced: tuple[Limit, ...]
    unbalanced: str
    alternatives: tuple[Alternative, ...]
    beside: float
    bench: BenchFile
    plan: Plan


def tell(answer: RequirementAnswer, request: Request) -> None:
    """Print the limits, the alternatives, whether the bench as it is keeps to the accuracy."""
    out = printing.console(json=request.json)
    asked = answer.requirement
    what = request.of
    if answer.up_to_g is not None:
        what += f" up to {answer.up_to_g:g} g"
    out.print(
        f"{what}: {asked.k:g} u within {_micro(asked.accuracy)} µ{answer.unit}, by {asked.estimator} from "
        f"procedure {answer.plan.name} on {answer.bench.name}"
    )
    out.print(_limit_table(answer, request))
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
        out.print(_not_counted(answer, request))


def _not_counted(answer: RequirementAnswer, request: Request) -> str:
    asked, of_coefficients = answer.requirement, request.of in COEFFICIENTS
    left_out = []
    if not request.every_source:
        left_out.append(
            "what no reading shows (gain, gravity, temperature, nonlinearity of the block: --all-errors)"
        )
    if not (request.reading or of_coefficients):
        left_out.append("the reading in use (--with-reading)")
    more = ", MORE THAN THE ACCURACY" if answer.beside > asked.accuracy else ""
    return (
        f"not counted: {' and '.join(left_out)}: {asked.k:g} u = {_micro(answer.beside)} µ{answer.unit} "
        f"by itself{more}"
    )


def _limit_table(answer: RequirementAnswer, request: Request) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("error")
    table.add_column("as", justify="left")
    together = "equal shares" if request.share == "equal" else "by cost"
    for heading in ("now", "part of variance", "limit alone", f"limits together, {together}"):
        table.add_column(heading, justify="right")
    shares = answer.requirement.shares()
    balanced = {limit.source.name: limit for limit in answer.balanced}
    for limit in answer.alone:
        source = limit.source
        together = _told(balanced[source.name]) if source.name in balanced else ""
        table.add_row(
            source.name,
            _form(source),
            _size(source.distribution.limit, source),
            f"{shares[source.name]:.1%}",
            _told(limit),
            together,
        )
    return table


def _alternative_table(answer: RequirementAnswer) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("estimator")
    table.add_column("procedure")
    name = answer.alternatives[0].limit.source.name if answer.alternatives else ""
    for heading in ("settings", "time", f"{answer.requirement.k:g} u", f"limit of {name} alone"):
        table.add_column(heading, justify="right")
    for other in answer.alternatives:
        table.add_row(
            other.estimator,
            other.procedure,
            str(other.settings),
            duration(other.time_s),
            f"{_micro(other.reached)} µ{answer.unit}",
            _told(other.limit),
        )
    return table


def _form(source: ErrorSource) -> str:
    """How the bench file states the size: limits of a rectangle, or so many sigma."""
    distribution = source.distribution
    return "limits" if distribution.shape == "rectangular" else f"k = {distribution.k:g}"


def _told(limit: Limit) -> str:
    return limit.verdict if limit.stated is None else _size(limit.stated, limit.source, down=True)


def _size(value: float, source: ErrorSource, *, down: bool = False) -> str:
    unit, size = _SHOWN.get(source.unit, (f" {source.unit}", 1.0))
    return f"{figures(value / size, down=down)}{unit}"


def _micro(value: float) -> str:
    return figures(value / _MICRO, 4)
