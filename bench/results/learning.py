"""The result of `bench learn`: the errors that the runs of one bench have in common, as JSON and as text."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from rich.console import Console

from bench.base.languages import HEADING, message, translated
from bench.base.result_model import Matrix, Real, ResultModel, Vector
from bench.base.tables import table
from bench.history.learned import Contrasts, Learned
from bench.results.parts import BenchPart


class RecordPart(ResultModel):
    """A run from which the errors were learned."""

    name: str
    readings: str = Field(description="SHA-256 of the readings file made from the record")
    head: str = Field(default="", description="SHA-256 of the last line of the record")


class ContradictionPart(ResultModel):
    """A run that was left out because it contradicts the other runs."""

    run: str
    what: str
    size: float = Field(description="deviation divided by the one expected from the other runs")
    p: float = Field(description="p-value corrected for everything that was examined (Holm)")
    sentence: str


class SizePart(ResultModel):
    """A learned quantity of the bench: a mean angle, a standard deviation, a difference of voltmeters, …"""

    value: float
    u: float = Field(description="standard uncertainty")
    unit: str
    dof: Real = Field(description="degrees of freedom; null: infinite")
    told: bool = Field(description="whether the runs determine the size; if not, it keeps its prior value")


class MeansPart(ResultModel):
    """The covariance of the mean stand angles and of the head's harmonics."""

    order: list[str]
    covariance_rad2: Matrix


class VariancesPart(ResultModel):
    """The covariance of variance components: angles between mountings (rad²), drift by channel (unit²/h)."""

    order: list[str]
    covariance: Matrix


class ContrastsPart(ResultModel):
    """The differences between the voltmeters in gain or in offset, in SI units."""

    value: Vector = Field(description="value of each meter relative to the mean of its group")
    covariance: Matrix
    dof: list[Real]
    """degrees of freedom of the difference from the first meter of the group; null: infinite"""
    between_runs: float
    """standard deviation that a block adds between runs beyond the stated one, as used"""


class MetersPart(ResultModel):
    """The differences between voltmeters, from runs in which different ones read one channel of a block."""

    meters: list[str]
    group: list[int] = Field(description="number of the group, whose meters were compared")
    runs: list[str]
    gain: ContrastsPart
    offset_v: ContrastsPart


class LearnResult(ResultModel):
    """The errors of stand, noise and voltmeters that the runs of one bench have in common."""

    bench: BenchPart
    learned_for: str
    """hash of stand, head, installations and meters of the bench file to which the result applies"""
    made: str = Field(description="date of the result")
    expires: str = Field(description="last date on which the result is used")
    simulated: bool
    records: list[RecordPart] = Field(description="runs from which the sizes were estimated")
    runs: list[str]
    contradicting: list[ContradictionPart]
    """runs that contradict the others, largest deviation first"""
    sizes: dict[str, SizePart]
    means: MeansPart
    variances: VariancesPart
    meters: MetersPart | None = Field(description="differences between meters; null if not determined")
    not_identified: list[str] = Field(description="sizes that these runs do not determine, with the reason")
    effects: list[str] = Field(description="effects of the bench that the learned file holds")
    notes: list[str]


def learn_result(found: Learned, **made_from: Any) -> LearnResult:
    """Return the result on errors learned from runs; `made_from` gives the fields that `found` does not."""
    meters = found.meters
    return LearnResult(
        runs=list(found.runs),
        contradicting=found.contradicting,
        sizes={size.name: size for size in found.sizes()},
        means=MeansPart(order=list(found.names), covariance_rad2=found.covariance),
        variances=VariancesPart(
            order=[one.name for one in found.variances], covariance=found.variances_covariance
        ),
        meters=None
        if isinstance(meters, str)
        else MetersPart.from_object(meters, gain=_contrasts(meters.gain), offset_v=_contrasts(meters.zero)),
        not_identified=found.not_identified(),
        **made_from,
    )


def _contrasts(found: Contrasts) -> ContrastsPart:
    return ContrastsPart.from_object(
        found, value=found.values, dof=found.freedom.tolist(), between_runs=found.between
    )


def print_learned(found: Learned, result: LearnResult, out: Console) -> None:
    """Print the contradicting runs, the learned errors, and the quantities that these runs do not determine."""
    for one in result.contradicting:
        out.print(f"{one.sentence} (p {one.p:.1g}, adjusted for several tests); it is left out", style="bold")
    out.print(
        f"Bench {result.bench.name}: learned from {len(result.runs)} "
        f"{'simulated runs' if result.simulated else 'runs'}, valid until {result.expires}"
    )
    shown = table("size", ">value", ">u", ">dof", "", "")
    for name, size in result.sizes.items():
        dof = translated("many", HEADING) if size.dof is None or size.dof >= 1e5 else f"{size.dof:.0f}"
        told = "" if size.told else message("as stated before")
        shown.add_row(name, f"{size.value:.4g}", f"{size.u:.2g}", dof, size.unit, told)
    out.print(shown)
    for sentence in () if isinstance(found.meters, str) else found.meters.words():
        out.print(sentence)
    for sentence in result.not_identified:
        out.print(f"not determined: {sentence}")
