"""The result of `bench budget` as JSON, as text, and as a page with figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.files import write_whole
from bench.base.languages import HEADING, message, translated
from bench.base.numbers import fixed
from bench.base.result_model import Matrix, Real, ResultModel, Vector
from bench.base.tables import as_html, as_text, print_notes, table
from bench.calibration.budget.assessment import DIGITS, Assessment, AtMagnitude, DeltaG, ExactResult
from bench.calibration.budget.coefficients import Contribution
from bench.calibration.budget.propagation import COVERAGE, correlation_of, coverage_factor
from bench.calibration.conformity import DecisionRule
from bench.model.geometry import COEFFICIENTS
from bench.results import tables
from bench.results.parts import BenchPart, by_coefficient, by_name
from bench.results.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION, drawn, svg_figure, symbol
from bench.results.tables import Row, page
from bench.results.verification import RulePart, rule_in_words
from bench.run.events import writing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Twelve = Annotated[Vector, Field(min_length=12, max_length=12)]
Dof = Annotated[Real, Field(description="effective degrees of freedom; null for infinitely many")]
BySource = Annotated[dict[str, float], Field(description="standard uncertainty from each error alone")]


class ReadingCounts(ResultModel):
    """How many fitted readings and how many verification points the procedure has."""

    fitted: int
    verification: int


class CoefficientPart(ResultModel):
    """A coefficient with its uncertainty, in V/g or V."""

    value: float
    u: float = Field(description="combined standard uncertainty")
    dof: Dof
    k: float = Field(description="coverage factor")
    U: float = Field(description="expanded uncertainty")
    by_source: BySource


class CovariancePart(ResultModel):
    """Standard uncertainties and covariance of the twelve coefficients."""

    u: Twelve
    covariance: Matrix


class SourcePart(ResultModel):
    """An error source of the bench, and its contribution to the coefficients."""

    symbol: str
    u: float = Field(description="standard uncertainty in SI units")
    unit: str
    shown: str = Field(description="standard uncertainty in the unit of the bench file")
    limit: float | None
    distribution: str
    common_to: str = Field(description="the readings that share one value of this error")
    group: str
    dof: Real
    prior: bool
    """true if the size is a plausible value that the bench file does not state; marked with a star in the
    text
    """
    origin: str = Field(description="where the size comes from")
    contribution_u: Twelve
    covariance: Matrix
    correlation: Matrix


class AccelerationPart(ResultModel):
    """The uncertainty of a measured acceleration, by its magnitude."""

    range_g: float
    same_voltmeters: bool = Field(description="whether it is read with the voltmeters of the calibration")
    magnitudes: list[AtMagnitude]


class VerificationPart(RulePart):
    """The uncertainty of Δg at each verification point, and whether that is small enough for a decision."""

    capable: bool | None = Field(description="whether the bench can verify every point; null without points")
    passes: float | None = None
    """probability that a calibration without a mistake passes at all points together; null without points"""
    points: list[DeltaG]

    @property
    def decision(self) -> DecisionRule:
        """The rule, with its guard band, that decides whether Δg is accepted."""
        return DecisionRule.of_json(self.to_dict())


class OutputPart(ResultModel):
    """The distribution of a coefficient or Δg by the Monte Carlo method, compared with the linear result."""

    mean: float
    u: float
    u_linear: float
    ratio: float
    interval: Vector = Field(description="coverage interval with equal probabilities below and above it")
    shortest: Vector = Field(description="shortest coverage interval")
    differences: list[float] = Field(description="ends of the interval minus those of the linear budget")
    tolerance: float
    validated: bool


class MonteCarloPart(ResultModel):
    """The budget by the Monte Carlo method on the exact geometry (JCGM 101, clause 8)."""

    trials: int
    probability: float
    digits: int
    covariance: Matrix
    outputs: dict[str, OutputPart]
    validated: bool = Field(description="whether the Monte Carlo simulation confirms the linear budget")


class BudgetResult(ResultModel):
    """The contribution of each error source to the coefficients and to a measured acceleration."""

    bench: str
    bench_file: BenchPart
    procedure: str
    model: str
    about: str = Field(description="the block whose coefficients the budget states")
    g_m_s2: float
    readings: ReadingCounts
    estimator: str
    order: Annotated[list[str], Field(min_length=12, max_length=12)]
    probability: float = Field(description="coverage probability of U")
    coefficients: dict[str, CoefficientPart]
    """the twelve coefficients by name, as in `order`"""
    covariance: Matrix
    correlation: Matrix
    per_local_g: CovariancePart
    """u and covariance without the uncertainty of local gravity, as `bench calibrate` states them"""
    groups: dict[str, CovariancePart] = Field(description="combined contribution of stand, scale and block")
    sources: dict[str, SourcePart] = Field(description="contribution of each error, by name")
    acceleration: AccelerationPart
    verification: VerificationPart
    monte_carlo: MonteCarloPart | None
    notes: list[str]

    @property
    def capable(self) -> bool | None:
        """Whether U is small enough at every verification point for a decision; None without points."""
        return self.verification.capable

    def report(self, path: str | Path) -> None:
        """Write the budget as one self-contained HTML page. Raises `RecordError`."""
        with writing(path) as file:
            write_whole(file, render_budget(self))

    def print_on(self, out: Console) -> None:
        """Print the tables of coefficients, sources, accelerations and verification points, and the notes."""
        out.print(_headline(self))
        out.print(
            message(
                "standard uncertainties by source: K in µV/g, U0 in µV; * a plausible size, not a stated one"
            )
        )
        for shown in (_coefficient_table(self), _source_table(self), _acceleration_table(self)):
            out.print(shown)
        if self.verification.points:
            _print_check(self, out)
        if self.monte_carlo is not None:
            out.print(_monte_carlo_in_words(self.monte_carlo))
        print_notes(out, self.notes)

    def __repr__(self) -> str:
        """Return the printed tables and the path of the bench file."""
        return f"{as_text(self.print_on)}\nbench: {self.bench_file.words}"

    def _repr_html_(self) -> str:
        shown = _coefficient_table(self), _acceleration_table(self)
        notes = (f"note: {note}" for note in self.notes)
        return as_html([_headline(self)], *shown) + as_html([f"bench: {self.bench_file.words}", *notes])


def budget_result(
    found: Assessment, *, bench: BenchPart, procedure: str, about: str, g_m_s2: float
) -> BudgetResult:
    """Return the result of a budget; `about` names the block to which it applies."""
    budget, question = found.budget, found.question
    total, setup, contributions = budget.combined, budget.setup, budget.contributions
    factor = coverage_factor(total.dof)
    return BudgetResult(
        bench=bench.name,
        bench_file=bench,
        procedure=procedure,
        model=setup.model.name,
        about=about,
        g_m_s2=g_m_s2,
        readings=ReadingCounts(fitted=int(setup.fitted.sum()), verification=int(setup.verification.sum())),
        estimator=budget.estimator,
        order=COEFFICIENTS,
        probability=COVERAGE,
        coefficients=by_coefficient(
            CoefficientPart, total, k=factor, U=factor * total.u,
            by_source=[{c.source.name: c.u[i] for c in contributions} for i in range(len(COEFFICIENTS))],
        ),
        covariance=total.covariance,
        correlation=total.correlation,
        per_local_g=budget.per_local_g,
        groups={c.source.group: budget.of_group(c.source.group) for c in contributions},
        sources={c.source.name: _source_part(c) for c in contributions},
        acceleration=AccelerationPart(
            range_g=question.range_g,
            same_voltmeters=question.same_voltmeters,
            magnitudes=found.accelerations,
        ),
        verification=VerificationPart.from_object(found, limit_g=question.limit_g, **question.rule.to_json()),
        monte_carlo=None if found.exact is None else _monte_carlo_part(found.exact),
        notes=found.notes,
    )  # fmt: skip


def _source_part(contribution: Contribution) -> SourcePart:
    source = contribution.source
    return SourcePart.from_object(
        source,
        limit=source.distribution.limit,
        distribution=source.distribution.shape,
        common_to=source.common,
        contribution_u=contribution.u,
        covariance=contribution.covariance,
        correlation=correlation_of(contribution.covariance),
    )


def _monte_carlo_part(exact: ExactResult) -> MonteCarloPart:
    trials, linear, verdict = exact.trials, exact.linear, exact.verdict
    outputs = by_name(
        exact.names, OutputPart, verdict, mean=trials.mean, u=trials.u, u_linear=linear.u,
        interval=trials.symmetric, shortest=trials.shortest,
        differences=np.column_stack([verdict.low, verdict.high]).tolist(),
    )  # fmt: skip
    return MonteCarloPart.from_object(
        trials, digits=DIGITS, outputs=outputs, validated=np.all(verdict.validated)
    )


# --- text in the terminal -----------------------------------------------------------------------------


def _headline(result: BudgetResult) -> str:
    return message(
        f"Budget of {result.procedure} on {result.bench}: {result.estimator}, model {result.model}, "
        f"{result.readings.fitted} readings, about {result.about}"
    )


def _coefficient_table(result: BudgetResult) -> Table:
    """Return a table of sources by coefficients, with combined u, effective degrees of freedom and U."""
    shown = _table(_by_source(result), "source", *result.order)
    for row in _combined(result):
        shown.add_row(row.head, *row.cells, style="bold" if "dof" not in row.head else None)
    return shown


def _source_table(result: BudgetResult) -> Table:
    shown = table("source", "", ">u", "common to", ">dof", "where its size comes from")
    for name, one in result.sources.items():
        shown.add_row(
            name, one.symbol, one.shown, translated(one.common_to, HEADING), _dof(one.dof, "g"), one.origin
        )
    return shown


def _acceleration_table(result: BudgetResult) -> Table:
    how = (
        message("the same voltmeters") if result.acceleration.same_voltmeters else message("voltmeters alike")
    )
    shown = _table(_by_magnitude(result), message("measured |a|"), *ACCELERATION_COLUMNS)
    shown.title = translated(message(f"one reading with {how}, over all directions, µg"))
    shown.title_justify = "left"
    return shown


def _print_check(result: BudgetResult, out: Console) -> None:
    check = result.verification
    out.print(_table(_by_point(check), "verification point", *POINT_COLUMNS))
    surely = message(f"CANNOT BE PASSED with {100 * result.probability:.4g} %")
    verdict = message("can be passed") if check.capable else surely
    out.print(
        message(
            f"check of |Δg| ≤ {check.limit_g * 1e6:g} µg, rule: {check.decision.words}: {verdict} "
            "(U against what is accepted, at every point)"
        ),
        style="bold",
    )
    out.print(_all_points_in_words(check))


def _all_points_in_words(check: VerificationPart) -> str:
    """Return a sentence on the probability that all verification points are passed together; empty if unknown."""
    if check.passes is None:
        return ""
    return message(
        f"a calibration without a mistake passes all points together with {100 * check.passes:.3g} %"
    )


def _monte_carlo_in_words(found: MonteCarloPart) -> str:
    ratios = [output.ratio for output in found.outputs.values() if output.u_linear > 0.0]
    names = ", ".join(name for name, output in found.outputs.items() if not output.validated)
    verdict = message(f"not validated for {names}") if names else message("validated for every output")
    return message(
        f"Monte Carlo on the exact geometry, {found.trials} trials: u over linear u {min(ratios):.3f} to "
        f"{max(ratios):.3f}; JCGM 101, clause 8: {verdict}"
    )


def _table(rows: Iterable[Row], first: str, *others: str) -> Table:
    shown = table(first, *(f">{heading}" for heading in others), no_wrap=True)
    for row in rows:
        shown.add_row(row.head, *row.cells)
    return shown


# --- rows of the tables, for both terminal and page -----------------------------------------------------

ACCELERATION_COLUMNS: Final = (
    message("u(|a|) mean"), message("largest"), message("U(|a|) largest"), message("u(vector) mean"),
    message("largest"), message("most of it"),
)  # fmt: skip
POINT_COLUMNS: Final = ("u(Δg)", "U(Δg)", message("accepted up to"), message("passes"), message("most of it"))


def _by_source(result: BudgetResult) -> Iterator[Row]:
    for name, source in result.sources.items():
        yield Row(f"{name}{'*' if source.prior else ''}", *_micro(source.contribution_u))


def _combined(result: BudgetResult) -> Iterator[Row]:
    """Yield the rows below the sources: u of the stand, combined u (exact or stated local g), dof, U."""
    coefficients = [result.coefficients[name] for name in result.order]
    if "stand" in result.groups:
        yield Row(message("stand, as calibrate states"), *_micro(result.groups["stand"].u))
    yield Row(message("combined u, per local g"), *_micro(result.per_local_g.u))
    yield Row(message("combined u"), *_micro(one.u for one in coefficients))
    if any(one.dof is not None for one in coefficients):
        yield Row(message("effective dof"), *(_dof(one.dof, ".0f") for one in coefficients))
    factors = [one.k for one in coefficients]
    k = f"k = {factors[0]:.2f}" if max(factors) - min(factors) < 0.005 else message("k by dof")
    yield Row(f"U ({k}, {100 * result.probability:.4g} %)", *_micro(one.U for one in coefficients))


def _by_magnitude(result: BudgetResult) -> Iterator[Row]:
    for at in result.acceleration.magnitudes:
        name = max(at.share, key=at.share.__getitem__)
        sizes = (at.u_modulus_mean, at.u_modulus_max, at.U_modulus_max, at.u_vector_mean, at.u_vector_max)
        cells = (f"{1e6 * size:.1f}" for size in sizes)
        yield Row(f"{at.magnitude_g:g} g", *cells, f"{name} {100 * at.share[name]:.0f} %")


def _by_point(check: VerificationPart) -> Iterator[Row]:
    for point in check.points:
        yield Row(
            message(f"{point.point} at {point.angle_deg:g}°"),
            f"{1e6 * point.u:.1f} µg",
            f"{1e6 * point.U:.1f} µg",
            f"{1e6 * point.accepted_up_to:.1f} µg"
            if point.accepted_up_to > 0
            else translated(message("nothing")),
            f"{100 * point.passes:.4g} %",
            max(point.by_source, key=point.by_source.__getitem__),
            bad=not point.capable,
        )


def _by_output(found: MonteCarloPart) -> Iterator[Row]:
    for name, one in found.outputs.items():
        sizes = [
            *_micro([one.u_linear, one.u]),
            f"{one.ratio:.3f}",
            *_micro([*one.differences, one.tolerance]),
        ]
        yield Row(name, *sizes, "yes" if one.validated else "no", bad=not one.validated)


def _dof(dof: float | None, form: str) -> str:
    return "∞" if dof is None else format(dof, form)


def _micro(values: Iterable[float]) -> tuple[str, ...]:
    return tuple(fixed(1e6 * value, 1) if abs(value) >= 5e-8 else "0" for value in values)


# --- page ---------------------------------------------------------------------------------------------


def render_budget(result: BudgetResult) -> str:
    """Return the HTML page; the same result always gives the same text."""
    check = result.verification
    return page(
        "budget.html.j2",
        result=result,
        headings=[message("source"), *(tables.symbol(name) for name in result.order)],
        coefficients=[
            Row(row.head.replace("_", " "), *row.cells) for row in (*_by_source(result), *_combined(result))
        ],
        sources=[
            Row(
                f"{name.replace('_', ' ')} ({one.symbol})",
                one.shown,
                one.distribution,
                one.common_to,
                _dof(one.dof, "g"),
                one.origin,
            )
            for name, one in result.sources.items()
        ],
        acceleration_columns=["|a|", *ACCELERATION_COLUMNS],
        accelerations=list(_by_magnitude(result)),
        point_columns=[message("verification point"), *POINT_COLUMNS],
        points=list(_by_point(check)),
        all_points=_all_points_in_words(check),
        verdict={True: "passed", False: "failed", None: "none"}[check.capable],
        limit=f"{1e6 * check.limit_g:g}",
        rule_in_words=rule_in_words(check.decision),
        monte_carlo=[] if result.monte_carlo is None else list(_by_output(result.monte_carlo)),
        contributions=contributions(result).svg(),
        modulus=modulus(result).svg(),
    )


COLOURS: Final = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, "#56B4E9", "#F0E442", GREY)
HATCHES: Final = ("", "////", "....", "xxxx")
VISIBLE: Final = 0.01
"""Sources below this fraction of every coefficient's variance are drawn as one, "others"."""
DOTS_PER_INCH: Final = 160


@dataclass(frozen=True)
class BudgetFigure:
    """A figure: its name, size in inches, drawing function, and alternative text."""

    name: str
    inches: tuple[float, float]
    draw: Callable[[Figure], None]
    alt: str

    def svg(self) -> str:
        """Return the figure as an SVG element for a page."""
        return svg_figure(self.name, self.inches, self.draw, self.alt)

    def save(self, folder: Path) -> tuple[Path, Path]:
        """Write the figure as SVG and as PNG to a folder; return both paths. Raises `OSError`."""
        with drawn(self.name, self.inches, self.draw) as figure:
            svg, png = folder / f"{self.name}.svg", folder / f"{self.name}.png"
            figure.savefig(png, dpi=DOTS_PER_INCH)
            figure.savefig(svg, metadata={"Date": None})
        return svg, png


def figures(result: BudgetResult) -> tuple[BudgetFigure, ...]:
    """Return the two figures of a budget: contributions by coefficient, and u of a measured acceleration."""
    return contributions(result), modulus(result)


def contributions(result: BudgetResult) -> BudgetFigure:
    """Return a bar chart of each coefficient's u; a bar is divided among sources in proportion to their u²."""
    names = result.order
    u = np.array([result.coefficients[name].u for name in names])
    parts = {name: np.array(source.contribution_u) ** 2 for name, source in result.sources.items()}
    shares = _gathered({source: part / np.where(u > 0, u, 1.0) ** 2 for source, part in parts.items()})

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        base = np.zeros(len(names))
        for i, (source, share) in enumerate(shares.items()):
            axes.bar(
                range(len(names)), 1e6 * share * u, bottom=base, width=0.72, label=source,
                color=COLOURS[i % len(COLOURS)], hatch=HATCHES[i // len(COLOURS)],
                edgecolor="white", linewidth=0.4,
            )  # fmt: skip
            base += 1e6 * share * u
        axes.set_xticks(range(len(names)), [symbol(name) for name in names])
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(message("combined u / (µV/g)") + "\n(biases: µV)")
        figure.legend(loc="outside upper center", ncols=4)

    alt = message(
        "Combined standard uncertainty of the twelve coefficients, "
        "divided in proportion to the variance from each source"
    )
    return BudgetFigure("budget-coefficients", (7.4, 3.8), draw, alt)


def modulus(result: BudgetResult) -> BudgetFigure:
    """Return a plot of u(|a|) against |a|: mean and maximum over directions, and u from the largest sources."""
    rows = result.acceleration.magnitudes
    at = np.array([row.magnitude_g for row in rows])
    mean = np.array([row.u_modulus_mean for row in rows])
    largest = np.array([row.u_modulus_max for row in rows])
    shares = {
        source: np.array([row.share[source] for row in rows])
        for source in rows[0].share
        if max(row.share[source] for row in rows) > 10 * VISIBLE
    }

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for i, (source, share) in enumerate(shares.items()):
            axes.plot(
                at, 1e6 * np.sqrt(share) * mean, linestyle=("--", ":", "-.")[i % 3], linewidth=1.0,
                color=COLOURS[(i + 2) % len(COLOURS)], label=source,
            )  # fmt: skip
        axes.plot(at, 1e6 * largest, "v-", color=VERMILION, label=message("largest over directions"))
        axes.plot(at, 1e6 * mean, "o-", color=BLUE, label=message("mean over directions"))
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(at, [f"{a:g}" for a in at])
        axes.minorticks_off()
        axes.set_xlabel("|a| / g")
        axes.set_ylabel("u(|a|) / µg")
        figure.legend(loc="outside upper center", ncols=3)

    alt = message(f"Standard uncertainty of a measured |a| from {at[0]:g} g to {at[-1]:g} g")
    return BudgetFigure("budget-acceleration", (7.4, 3.8), draw, alt)


def _gathered(shares: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the shares of at least `VISIBLE`, and the sum of all other shares as "others"."""
    seen = {source: share for source, share in shares.items() if np.max(share) >= VISIBLE}
    rest = sum((share for source, share in shares.items() if source not in seen), np.zeros(12))
    return {**seen, message("others"): rest} if np.any(rest > 0.0) else seen
