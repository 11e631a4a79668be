"""Comparisons of one block over time, and of benches that measured the same blocks; as JSON and as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.languages import message, translated
from bench.base.numbers import probability, quantity, rounded, uncertainty
from bench.base.result_model import Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.intrinsic import INTRINSIC
from bench.history.comparison import Changes, Comparison, InNumbers, Snapshot
from bench.history.equivalence import BenchComparison, BenchesIn
from bench.history.measured import STANDARD_GRAVITY
from bench.model.geometry import COEFFICIENTS
from bench.results.fleet import MOST_SHOWN, FleetResult, limit_in_words, signed_size
from bench.results.parts import BenchPart, by_name, small_unit
from bench.results.plots import BLUE, GREY, VERMILION, svg_file, symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class CalibrationOfBlock(ResultModel):
    """One of the compared calibrations: its source, date and block."""

    name: str = Field(description="the result file, run or readings file")
    made_at: str | None = Field(description="time of the readings (ISO 8601); null if not recorded")
    block: str | None = Field(description="type and serial number; null if not recorded")


class ChangePart(ResultModel):
    """The change of a coefficient or intrinsic number since the first calibration, in the number's unit."""

    difference: float
    u: float = Field(description="standard uncertainty of the difference")
    en: float = Field(description="E_n: the size of the difference over its U (k = 2)")
    p_all_looks: float = Field(description="p-value, corrected for the number of comparisons (Holm)")
    changed: bool = Field(description="whether p_all_looks is below 5 %")


class NineChangesPart(ResultModel):
    """The changes of the nine intrinsic numbers, which do not depend on the mounting."""

    values: dict[str, ChangePart] = Field(description="change of each of the nine, in unit/g, degrees or g")
    chi2: float
    dof: int
    p: float = Field(description="p-value of all nine changes together")


class ChangesPart(CalibrationOfBlock):
    """The changes of all coefficients from the first calibration to a later one."""

    intrinsic: NineChangesPart
    coefficients: dict[str, ChangePart]
    """change of each of the twelve, to which a turn of the block contributes; empty for free positions alone
    """
    chi2: Real
    dof: int
    p: Real = Field(description="p-value of all twelve changes together")


class RatePart(ResultModel):
    """The drift rate of a coefficient or an intrinsic number, per year."""

    value: float
    u: float
    p_all_looks: float = Field(description="p-value, corrected for the number of rates tested (Holm)")
    shown: bool = Field(description="whether p_all_looks is below 5 %")


class LinesPart(ResultModel):
    """The weighted straight line through each coefficient or intrinsic number over time."""

    per_year: dict[str, RatePart]
    chi2: float = Field(description="chi-square of the residuals from the straight lines")
    dof: int
    p: float


class BenchOfSource(BenchPart):
    """A compared run or readings file, and the bench file with which it was calibrated."""

    source: str = Field(description="run or readings file for which the bench file was used")


class CompareResult(ResultModel):
    """A comparison of calibrations of one block: changes since the first, and drift."""

    first: CalibrationOfBlock = Field(description="calibration with which the others are compared")
    unit: str = Field(description="unit of the signals")
    g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    compared: list[ChangesPart]
    p_constant_intrinsic: float = Field(description="p-value for no change of the nine")
    p_constant: Real = Field(description="p-value for no change of the twelve; applies to one mounting")
    drift: LinesPart | None = Field(description="lines through the twelve; null with too few dates")
    drift_intrinsic: LinesPart | None = Field(description="lines through the nine; null with too few dates")
    changed: bool = Field(description="whether the nine changed: `p_constant_intrinsic` is below 5 %")
    notes: list[str]
    bench: list[BenchOfSource] = Field(description="bench files used for runs and readings files")


def compare_result(found: Comparison, bench: Sequence[BenchOfSource]) -> CompareResult:
    """Return the result of a comparison; `bench` are the bench files used for runs and readings files."""
    nine, twelve = found.nine, found.twelve
    beside = [None] * len(nine.changes) if twelve is None else twelve.changes
    return CompareResult(
        first=CalibrationOfBlock(**_of_block(nine.first)),
        unit=nine.first.unit,
        g_m_s2=nine.first.g_m_s2,
        compared=[_changes(own, other) for own, other in zip(nine.changes, beside, strict=True)],
        p_constant_intrinsic=nine.p_constant,
        p_constant=twelve and twelve.p_constant,
        drift=twelve and _lines(twelve),
        drift_intrinsic=_lines(nine),
        changed=found.changed,
        notes=list(found.notes),
        bench=list(bench),
    )


def _of_block(snapshot: Snapshot) -> dict[str, str | None]:
    when = snapshot.when.isoformat() if snapshot.when else None
    return {"name": snapshot.name, "made_at": when, "block": snapshot.block or None}


def _changes(nine: Changes, twelve: Changes | None) -> ChangesPart:
    return ChangesPart(
        **_of_block(nine.later),
        intrinsic=NineChangesPart(
            values=by_name(INTRINSIC, ChangePart, nine), chi2=nine.chi2, dof=len(INTRINSIC), p=nine.p
        ),
        coefficients={} if twelve is None else by_name(COEFFICIENTS, ChangePart, twelve),
        chi2=twelve and twelve.chi2,
        dof=len(COEFFICIENTS),
        p=twelve and twelve.p,
    )


def _lines(found: InNumbers) -> LinesPart | None:
    drift = found.drift
    if drift is None:
        return None
    return LinesPart.from_object(drift, per_year=by_name(found.names, RatePart, drift, value=drift.per_year))


# --- as text ------------------------------------------------------------------------------------------


def print_compare(result: CompareResult, out: Console) -> None:
    """Print the changes since the first calibration, the drift, and the verdict from the nine intrinsic numbers."""
    unit = result.unit
    out.print(
        message(
            f"Against {_named(result.first)}: S in {unit}/g, θ in degrees, b in g; K in {unit}/g, U0 in {unit}, "
            f"g = {result.g_m_s2:.6g} m/s²"
        )
    )
    for later in result.compared:
        out.print(f"{_named(later)}:")
        nine = later.intrinsic
        out.print(_changes_table(nine.values))
        out.print(
            message(
                f"all nine together: chi2 {nine.chi2:.1f} for {nine.dof} degrees of freedom, {probability(nine.p)}"
            )
        )
        if later.p is not None and later.chi2 is not None:
            out.print(message("the twelve coefficients, which a turn of the block changes, too:"))
            out.print(_changes_table(later.coefficients))
            out.print(
                message(
                    f"all twelve together: chi2 {later.chi2:.1f} for 12 degrees of freedom, {probability(later.p)}"
                )
            )
    for drift, of in (
        (result.drift_intrinsic, message("drift of the nine (weighted straight lines):")),
        (result.drift, message("drift of the twelve (weighted straight lines):")),
    ):
        if drift is not None:
            out.print(of)
            out.print(_drift_table(drift))
            out.print(
                message(
                    f"residuals from the lines: chi2 {drift.chi2:.1f} for {drift.dof} degrees of freedom, "
                    f"{probability(drift.p)}"
                )
            )
    print_notes(out, result.notes)
    out.print(
        f"{translated(verdict_of(result))}; "
        + translated(
            message(
                "test that the nine numbers are equal in all calibrations: "
                f"{probability(result.p_constant_intrinsic)}"
            )
        ),
        style="bold",
    )


def verdict_of(result: CompareResult) -> str:
    """Return a clause that says whether the block changed, and which of its numbers differ."""
    nine = [name for one in result.compared for name, row in one.intrinsic.values.items() if row.changed]
    twelve = [name for one in result.compared for name, row in one.coefficients.items() if row.changed]
    if result.changed:
        which = ", ".join(dict.fromkeys(nine)) or message("no single number, but all nine together")
        return message(f"CHANGED by more than the uncertainty (5 %, all nine together): {which}")
    if not twelve:
        return message("no change exceeds the uncertainty")
    return message(
        f"no change exceeds the uncertainty; {', '.join(dict.fromkeys(twelve))} of the twelve differ, because "
        "the block is turned"
    )


def _named(one: CalibrationOfBlock) -> str:
    return f"{one.name} ({one.made_at[:10]})" if one.made_at else one.name


def _changes_table(changes: Mapping[str, ChangePart]) -> Table:
    shown = table("number", ">difference", ">U (k=2)", ">En", ">p adjusted for several tests", "")
    for name, one in changes.items():
        sizes = (rounded(one.difference, 2 * one.u, sign=True), uncertainty(2 * one.u))
        shown.add_row(
            name, *sizes, f"{one.en:.2f}", f"{one.p_all_looks:.2g}", "CHANGED" if one.changed else ""
        )
    return shown


def _drift_table(drift: LinesPart) -> Table:
    shown = table("number", ">per year", ">U (k=2)", ">p adjusted for several tests", "")
    for name, one in drift.per_year.items():
        sizes = (rounded(one.value, 2 * one.u, sign=True), uncertainty(2 * one.u))
        shown.add_row(name, *sizes, f"{one.p_all_looks:.2g}", "DRIFTS" if one.shown else "")
    return shown


# --- as a figure --------------------------------------------------------------------------------------


def history_figure(comparison: Comparison) -> str:
    """Return an SVG plot of each intrinsic number minus its first value, with U (k = 2); changed ones are red."""
    found = comparison.nine
    snapshots = [found.first, *(changes.later for changes in found.changes)]
    dates = [snapshot.when for snapshot in snapshots if snapshot.when is not None]
    dated = len(dates) == len(snapshots)
    values = np.array([snapshot.vector for snapshot in snapshots]) - found.first.vector
    bars = COVERAGE_FACTOR * np.sqrt([np.diag(snapshot.covariance) for snapshot in snapshots])
    changed = np.any([changes.changed for changes in found.changes], axis=0)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(3, 3, sharex=True)
        for j, name in enumerate(found.names):
            size, unit = small_unit(name, float(np.max(np.abs(values[:, j]) + bars[:, j])), found.first.unit)
            axes = grid.flat[j]
            along = dates if dated else list(range(1, len(snapshots) + 1))
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            axes.errorbar(
                along, values[:, j] / size, bars[:, j] / size,
                fmt="X" if changed[j] else "o", color=VERMILION if changed[j] else BLUE, capsize=2.5,
            )  # fmt: skip
            axes.set_title(f"{symbol(name)} / {unit}" + (" changed" if changed[j] else ""))
            if dated:
                axes.set_xticks([dates[0], dates[-1]], [f"{date:%Y-%m-%d}" for date in (dates[0], dates[-1])])
            else:
                axes.set_xticks(along)
        figure.supylabel(message("less the first; bars k = 2"), fontsize=8)

    return svg_file("history", (7.4, 6.2), draw)


class DegreePart(ResultModel):
    """The degree of equivalence of a bench: its deviation from the reference value, with U."""

    d: float = Field(description="degree of equivalence: value of the bench minus reference")
    u: float = Field(description="standard uncertainty of `d`")
    U: float = Field(description="expanded uncertainty of `d`, k = 2")
    en: float = Field(description="E_n: |d| divided by U")


class PairPart(ResultModel):
    """The difference between two benches, from the units that both of them measured."""

    first: str
    second: str
    units: int = Field(description="number of units that both benches measured")
    difference: float = Field(description="first bench minus second bench")
    u: float = Field(description="standard uncertainty of the difference, from the stated uncertainties")
    en: float


class EquivalencePart(ResultModel):
    """The comparison of the benches by one number: a coefficient or an intrinsic number."""

    method: Literal["weighted mean", "Mandel-Paule", "DerSimonian-Laird"]
    dark: Real = Field(description="standard deviation between benches beyond their stated u")
    chi2: float = Field(description="chi-square of the values with their stated uncertainties")
    dof: int
    p: float
    consistent: bool = Field(description="whether p is 5 % or more")
    birge: float = Field(description="Birge ratio: observed scatter divided by the expected one")
    degrees_of_equivalence: dict[str, DegreePart] = Field(description="degree of equivalence of each bench")
    pairs: list[PairPart]


class TogetherPart(ResultModel):
    """A joint chi-square test for a difference in the twelve coefficients or the nine intrinsic numbers."""

    chi2: float = Field(description="chi-square of the vector of differences")
    dof: int
    p: float
    p_all_looks: float = Field(description="p-value corrected for the number of benches or pairs (Holm)")
    apart: bool = Field(description="whether p_all_looks is below 5 %")


class PairTogether(TogetherPart):
    """A joint chi-square test of the difference between two benches in all numbers."""

    first: str
    second: str


class AllTogether(ResultModel):
    """Joint chi-square tests over all numbers, for each bench and for each pair of benches."""

    benches: dict[str, TogetherPart] = Field(description="degrees of equivalence, by bench")
    pairs: list[PairTogether]


class BeyondPart(ResultModel):
    """A bench that deviates from the reference value of a number (`coefficient`) by more than U (k = 2)."""

    bench: str
    coefficient: str
    en: float


class NineOfBenches(ResultModel):
    """The comparison of the benches by the nine intrinsic numbers, which do not depend on the mounting."""

    values: dict[str, EquivalencePart] = Field(description="each of the nine, in unit/g, degrees or g")
    together: AllTogether = Field(description="comparison of all nine together, which decides")
    beyond: list[BeyondPart] = Field(description="differences above U (k = 2), largest E_n first")


class BenchesResult(FleetResult):
    """A comparison of benches by units that several of them measured."""

    per_g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    benches: list[str] = Field(description="benches that were compared")
    units: list[str] = Field(description="units measured on several of the benches")
    alone: list[str] = Field(description="benches that share no unit with another")
    intrinsic: NineOfBenches
    coefficients: dict[str, EquivalencePart] = Field(description="each of the twelve coefficients")
    together: AllTogether = Field(description="all twelve together, to which a turn of the block contributes")
    apart: list[BeyondPart] = Field(description="differences above U (k = 2), largest E_n first")

    @property
    def off(self) -> tuple[str, ...]:
        """The benches that differ significantly in the joint test of the nine intrinsic numbers."""
        return tuple(name for name, one in self.intrinsic.together.benches.items() if one.apart)


def benches_result(found: BenchComparison) -> BenchesResult:
    """Return the result of a comparison of benches."""
    nine, twelve = found.nine, found.twelve
    return BenchesResult.from_object(
        found,
        per_g_m_s2=STANDARD_GRAVITY,
        intrinsic=NineOfBenches(
            values=_equivalences(found, nine), together=_together(found, nine), beyond=_beyond(found, nine)
        ),
        coefficients=_equivalences(found, twelve),
        together=_together(found, twelve),
        apart=_beyond(found, twelve),
    )


def _equivalences(of: BenchComparison, numbers: BenchesIn) -> dict[str, EquivalencePart]:
    names = _pairs_of(of, numbers)
    return {
        name: EquivalencePart.from_object(
            one,
            degrees_of_equivalence={
                bench: DegreePart(d=d, u=u, U=COVERAGE_FACTOR * u, en=en)
                for bench, d, u, en in zip(of.benches, one.degree, one.u_degree, one.en, strict=True)
            },
            pairs=[PairPart.from_object(pair, **who) for pair, who in zip(both, names, strict=True)],
        )
        for name, one, both in zip(numbers.names, numbers.found, numbers.pairs, strict=True)
    }


def _together(of: BenchComparison, numbers: BenchesIn) -> AllTogether:
    names = _pairs_of(of, numbers)
    return AllTogether(
        benches=dict(zip(of.benches, numbers.together, strict=True)),
        pairs=[
            PairTogether.from_object(one, **who)
            for one, who in zip(numbers.pairs_together, names, strict=True)
        ],
    )


def _pairs_of(of: BenchComparison, numbers: BenchesIn) -> list[dict[str, str]]:
    return [{"first": of.benches[p.first], "second": of.benches[p.second]} for p in numbers.pairs[0]]


def _beyond(of: BenchComparison, numbers: BenchesIn) -> list[BeyondPart]:
    return [BeyondPart(bench=b, coefficient=c, en=en) for b, c, en in numbers.apart(of.benches)]


def print_benches(result: BenchesResult, out: Console) -> None:
    """Print for each number the test of consistency and the worst bench, then the joint tests of all numbers."""
    out.print(
        f"{len(result.benches)} benches on {len(result.units)} common units, {result.calibrations} calibrations; "
        "d = bench less reference, U with k=2"
    )
    if result.alone:
        out.print(f"not compared, as no unit connects them: {', '.join(result.alone)}")
    for numbers in (result.intrinsic.values, result.coefficients):
        shown = table(
            "number", ">chi2", ">dof", ">Birge", ">dark", "reference", ">worst bench", ">d", ">U", ">E_n"
        )
        for name, one in numbers.items():
            worst, degree = max(one.degrees_of_equivalence.items(), key=lambda of: of[1].en)
            size, unit = unit_of_change(name, result.signal)
            shown.add_row(
                name, f"{one.chi2:.1f}", str(one.dof), f"{one.birge:.2f}",
                limit_in_words(None if one.dark is None else one.dark * size, unit), one.method, worst,
                signed_size(degree.d * size, unit), quantity(degree.U * size, unit), f"{degree.en:.2f}",
            )  # fmt: skip
        out.print(shown)
    print_notes(out, result.notes)
    told = [f"{one.bench} in {one.coefficient} (E_n {one.en:.1f})" for one in result.intrinsic.beyond]
    if told:
        out.print(f"beyond U (k=2): {', '.join(told[:MOST_SHOWN])}", style="bold")
    _print_together(result.intrinsic.together, "nine", out)
    _print_together(result.together, "twelve", out)


def unit_of_change(name: str, unit: str) -> tuple[float, str]:
    """Return the factor that converts differences of the number `name` to the printed unit, and that unit."""
    if name.startswith("theta"):
        return 3600.0, "″"
    return 1.0, "g" if name in INTRINSIC[6:] else unit


def _print_together(found: AllTogether, count: str, out: Console) -> None:
    """Print the benches, and pairs of benches, that differ significantly by the joint test of all numbers."""
    benches: Iterable[tuple[str, TogetherPart]] = found.benches.items()
    pairs = ((f"{pair.first} and {pair.second}", pair) for pair in found.pairs)
    apart = [(name, one) for name, one in (*benches, *pairs) if one.apart]
    for name, one in sorted(apart, key=lambda row: row[1].p_all_looks)[:MOST_SHOWN]:
        out.print(
            f"all {count} together, {name}: chi2 {one.chi2:.1f} for {one.dof} degrees of freedom, p adjusted "
            f"for several tests {one.p_all_looks:.2g}",
            style="bold" if count == "nine" else None,
        )
    if not apart:
        out.print(
            f"all {count} together: no bench and no pair differs beyond its covariance (5 %, p adjusted for "
            "several tests)"
        )


def equivalence_figure(of: BenchComparison) -> str:
    """Return an SVG file of the benches' deviations in the nine intrinsic numbers, as `draw_degrees` draws them."""

    def draw(figure: Figure) -> None:
        draw_degrees(
            figure, of.benches, [(one.degree, one.u_degree, one.dark) for one in of.nine.found], of.signal
        )
        figure.supxlabel("degree of equivalence: bench less reference, bars k = 2", fontsize=8)

    return svg_file("equivalence", (7.4, 2.4 + 0.7 * len(of.benches)), draw)


def draw_degrees(
    figure: Figure, who: Sequence[str], nine: Sequence[tuple[Floats, Floats, float]], signal: str
) -> None:
    """Draw the deviation of each bench or laboratory in each intrinsic number, with bars of ±U (k = 2).

    `nine` has for each number the deviations (w,), their u (w,), and the dark uncertainty, drawn as a band.
    Deviations larger than U are red crosses. `who` (w,) are the names of benches or laboratories, `signal` is the
    unit of the signals.
    """
    rows = np.arange(len(who))
    grid = figure.subplots(3, 3, sharey=True)
    for axes, name, (d, u, dark) in zip(grid.flat, INTRINSIC, nine, strict=True):
        U = COVERAGE_FACTOR * u
        size, unit = small_unit(name, float(np.max(np.abs(d) + U)), signal)
        if dark > 0:
            axes.axvspan(-dark / size, dark / size, color="#DDE2E6", zorder=0)
        axes.axvline(0.0, color=GREY, linewidth=0.7)
        for chosen, marker, colour in ((np.abs(d) <= U, "o", BLUE), (np.abs(d) > U, "X", VERMILION)):
            axes.errorbar(
                d[chosen] / size, rows[chosen], xerr=U[chosen] / size, fmt=marker, color=colour, capsize=2.0
            )
        axes.set_title(f"{symbol(name)} / {unit}")
        axes.set_yticks(rows, who)
        axes.set_ylim(len(rows) - 0.5, -0.5)
