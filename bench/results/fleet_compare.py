"""The result of `bench fleet compare`: benches against one another, as JSON, as text and as a figure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from bench.base.numbers import quantity, scale_for
from bench.base.result_model import Real, ResultModel
from bench.base.tables import table
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.history.equivalence import STANDARD_GRAVITY, BenchComparison
from bench.model.geometry import COEFFICIENTS
from bench.results.fleet import MOST_SHOWN, FleetResult, limit_in_words, signed_size
from bench.results.parts import print_notes
from bench.results.plots import BLUE, GREY, VERMILION, svg_file, symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class DegreePart(ResultModel):
    """The degree of equivalence of a bench."""

    d: float = Field(description="bench less reference")
    u: float = Field(description="of d")
    U: float = Field(description="of d, k = 2")
    en: float = Field(description="|d| over U")


class PairPart(ResultModel):
    """Two benches on the units that both measured."""

    first: str
    second: str
    units: int = Field(description="that both measured")
    difference: float = Field(description="first less second")
    u: float = Field(description="as stated")
    en: float


class EquivalencePart(ResultModel):
    """The benches in one coefficient."""

    method: Literal["weighted mean", "Mandel-Paule", "DerSimonian-Laird"]
    dark: Real = Field(description="what benches differ by beyond their stated u, 1 sigma")
    chi2: float = Field(description="of the stated uncertainties")
    dof: int
    p: float
    consistent: bool = Field(description="whether p is 5 % or more")
    birge: float = Field(description="Birge ratio")
    degrees_of_equivalence: dict[str, DegreePart] = Field(description="by bench")
    pairs: list[PairPart]


class TogetherPart(ResultModel):
    """All twelve coefficients at once."""

    chi2: float = Field(description="of the vector of twelve differences with its covariance")
    dof: int
    p: float
    p_all_looks: float = Field(description="after Holm over all benches, or all pairs")
    apart: bool = Field(description="whether p_all_looks is below 5 %")


class PairTogether(TogetherPart):
    """Two benches in all twelve coefficients at once."""

    first: str
    second: str


class AllTogether(ResultModel):
    """Benches, and pairs of them, in all twelve coefficients at once."""

    benches: dict[str, TogetherPart] = Field(description="degrees of equivalence, by bench")
    pairs: list[PairTogether]


class BeyondPart(ResultModel):
    """A degree of equivalence beyond U (k = 2)."""

    bench: str
    coefficient: str
    en: float


class BenchesResult(FleetResult):
    """Benches against one another on common units."""

    per_g_m_s2: float = Field(description="the g that scale factors are per")
    benches: list[str] = Field(description="that take part")
    units: list[str] = Field(description="measured on several of them")
    alone: list[str] = Field(description="benches that share no unit with another")
    coefficients: dict[str, EquivalencePart] = Field(description="by name")
    together: AllTogether
    apart: list[BeyondPart] = Field(description="beyond U (k = 2), the largest E_n first")


def benches_result(found: BenchComparison) -> BenchesResult:
    """Return benches held against one another, as `--json` writes them."""
    names = [{"first": found.benches[p.first], "second": found.benches[p.second]} for p in found.pairs[0]]
    return BenchesResult.from_object(
        found,
        per_g_m_s2=STANDARD_GRAVITY,
        coefficients={
            name: EquivalencePart.from_object(
                one,
                degrees_of_equivalence={
                    bench: DegreePart(d=d, u=u, U=COVERAGE_FACTOR * u, en=en)
                    for bench, d, u, en in zip(found.benches, one.degree, one.u_degree, one.en, strict=True)
                },
                pairs=[PairPart.from_object(pair, **who) for pair, who in zip(both, names, strict=True)],
            )
            for name, one, both in zip(COEFFICIENTS, found.found, found.pairs, strict=True)
        },
        together=AllTogether(
            benches={
                name: TogetherPart.from_object(one)
                for name, one in zip(found.benches, found.together, strict=True)
            },
            pairs=[
                PairTogether.from_object(one, **who)
                for one, who in zip(found.pairs_together, names, strict=True)
            ],
        ),
        apart=[BeyondPart(bench=b, coefficient=c, en=en) for b, c, en in found.apart],
    )


def print_benches(result: BenchesResult, out: Console) -> None:
    """Print consistency and the worst bench of each coefficient, and who is off."""
    out.print(
        f"{len(result.benches)} benches on {len(result.units)} common units, {result.calibrations} calibrations; "
        "d = bench less reference, U with k=2"
    )
    if result.alone:
        out.print(f"not compared, no unit joins them: {', '.join(result.alone)}")
    shown = table(
        "coefficient", ">chi2", ">dof", ">Birge", ">dark", "reference", ">worst bench", ">d", ">U", ">E_n"
    )
    for name, one in result.coefficients.items():
        worst, degree = max(one.degrees_of_equivalence.items(), key=lambda of: of[1].en)
        shown.add_row(
            name, f"{one.chi2:.1f}", str(one.dof), f"{one.birge:.2f}",
            limit_in_words(one.dark, result.signal), one.method, worst,
            signed_size(degree.d, result.signal), quantity(degree.U, result.signal), f"{degree.en:.2f}",
        )  # fmt: skip
    out.print(shown)
    print_notes(result.notes, out)
    if result.apart:
        told = ", ".join(
            f"{one.bench} in {one.coefficient} (E_n {one.en:.1f})" for one in result.apart[:MOST_SHOWN]
        )
        out.print(f"beyond U (k=2): {told}", style="bold")
    else:
        out.print("no bench is off by more than U (k=2)", style="bold")
    _print_together(result.together, out)


def _print_together(found: AllTogether, out: Console) -> None:
    """Print which benches, and pairs of them, differ in all twelve coefficients taken together."""
    benches: Iterable[tuple[str, TogetherPart]] = found.benches.items()
    pairs = ((f"{pair.first} and {pair.second}", pair) for pair in found.pairs)
    apart = [(name, one) for name, one in (*benches, *pairs) if one.apart]
    for name, one in sorted(apart, key=lambda row: row[1].p_all_looks)[:MOST_SHOWN]:
        out.print(
            f"all twelve together, {name}: chi2 {one.chi2:.1f} for {one.dof}, p {one.p_all_looks:.2g} in all looks"
        )
    if not apart:
        out.print("all twelve together: no bench and no pair differs beyond its covariance (5 %, all looks)")


def equivalence_figure(of: BenchComparison) -> str:
    """Return an SVG file; benches beyond U are crosses in red, the band is the dark size of the others."""
    benches, found, signal = of.benches, of.found, of.signal
    rows = np.arange(len(benches))

    def draw(figure: Figure) -> None:
        grid = figure.subplots(4, 3, sharey=True)
        for axes, name, one in zip(grid.flat, COEFFICIENTS, found, strict=True):
            U = COVERAGE_FACTOR * one.u_degree
            scale = scale_for(float(np.max(np.abs(one.degree) + U)), signal)
            if one.dark > 0:
                axes.axvspan(-one.dark / scale.size, one.dark / scale.size, color="#DDE2E6", zorder=0)
            axes.axvline(0.0, color=GREY, linewidth=0.7)
            for beyond, marker, colour in ((one.en <= 1.0, "o", BLUE), (one.en > 1.0, "X", VERMILION)):
                axes.errorbar(
                    one.degree[beyond] / scale.size, rows[beyond], xerr=U[beyond] / scale.size,
                    fmt=marker, color=colour, capsize=2.0,
                )  # fmt: skip
            unit = scale.unit if name.startswith("U0") else scale.per_g
            axes.set_title(f"{symbol(name)} / {unit}")
            axes.set_yticks(rows, benches)
            axes.set_ylim(len(benches) - 0.5, -0.5)
        figure.supxlabel("degree of equivalence: bench less reference, bars k = 2", fontsize=8)

    return svg_file("equivalence", (7.4, 2.4 + 0.9 * len(benches)), draw)
