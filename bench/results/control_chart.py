"""The result of `bench chart`: the control chart of a check block, as JSON, as text and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import escape
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.base.numbers import MINUS, fixed, probability, scale_for, two_digits
from bench.base.result_model import Real, ResultModel
from bench.base.tables import as_text, print_notes, table
from bench.calibration.intrinsic import INTRINSIC
from bench.history.control_chart import ControlChart, Verdict
from bench.results.parts import ValuePart, by_name, small_unit
from bench.results.plots import BLUE, GREY, VERMILION, svg_figure, symbol
from bench.results.tables import Row, page
from bench.results.tables import symbol as html_symbol
from bench.stats.control_charts import Basis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAST_ROWS: Final = 12
"""Number of runs, the latest, that a terminal lists."""


class DesignPart(ResultModel):
    """The design of the chart: false alarm rate, weight of the EWMA, and basis of the limits."""

    arl: float = Field(description="mean number of runs between false alarms of the whole chart")
    arl_of_each: float = Field(description="mean number of runs between false alarms of one statistic")
    smoothing: float = Field(description="λ of the EWMA")
    limits_from: Basis


class LimitsPart(ResultModel):
    """The control limits of T² and of each number (in units of its u), for single runs and for the EWMA."""

    t2: float = Field(description="limit of T² of a run")
    ewma_t2: float = Field(description="limit of T² of the EWMA")
    single: float = Field(description="limit of a single coefficient, in units of its u")
    single_ewma: float = Field(description="limit of the EWMA of a single coefficient, in units of its u")


class ShortTermPart(ResultModel):
    """The scatter of the readings within a run."""

    s: float = Field(description="short-term standard deviation of a reading, in `unit`")
    dof: float
    f: Real = Field(description="F: square of `s` divided by that of the baseline")
    p: Real = Field(description="p-value of the F test")


class DeviationPart(ResultModel):
    """A number's deviation from its centre line, with its `u` and ratio `z`, for the run and the EWMA."""

    deviation: float
    u: float
    z: float
    ewma: Real
    ewma_u: Real
    ewma_z: Real


class ChartedRun(ResultModel):
    """A run of the check block after the baseline, with its verdict."""

    run: str
    when: str = Field(description="time of the run (ISO 8601)")
    accepted: bool
    reasons: list[str] = Field(description="reasons for which the run is rejected")
    t2: float = Field(description="T² of the twelve coefficients")
    p: float = Field(description="p-value of T²")
    ewma_t2: Real = Field(description="T² of the EWMA; null for a run that T² rejects")
    ewma_p: Real
    short_term: ShortTermPart
    coefficients: dict[str, DeviationPart]


class VariabilityPart(ResultModel):
    """The variability of a coefficient or an intrinsic number in the baseline, as standard deviations."""

    noise: float = Field(description="standard deviation between runs due to the noise of readings")
    stated: float = Field(description="stated u of one run, from all errors that change between runs")
    scatter: float = Field(description="observed standard deviation between runs")
    f: float = Field(description="(scatter/stated)²")
    p: float = Field(description="p-value of the F test")
    between: float = Field(description="part of the scatter that exceeds the stated u")
    between_most: float = Field(description="upper 95 % limit of `between`")


class PooledPart(ResultModel):
    """The short-term standard deviation of a reading, pooled over the baseline runs."""

    s: float
    dof: float


class ComponentsPart(ResultModel):
    """Short-term and long-term variability in the baseline."""

    coefficients: dict[str, VariabilityPart]
    runs: int
    birge: float = Field(description="Birge ratio of all coefficients: observed scatter divided by stated u")
    birge_dof: int
    birge_p: float = Field(description="p-value of the hypothesis that the Birge ratio is 1")
    alike_p: float = Field(description="p-value for the same ratio in all directions")
    short_term: PooledPart | None


class DriftPart(ResultModel):
    """The drift rate of a coefficient or intrinsic number in the accepted runs, minus the known drift."""

    per_year: float
    u: float
    p: float = Field(description="p-value of the hypothesis that no coefficient drifts")


class NineRun(ResultModel):
    """The statistics of a run of the check block in the chart of its nine intrinsic numbers."""

    t2: float = Field(description="T² of the nine intrinsic numbers")
    p: float = Field(description="p-value of T²")
    ewma_t2: Real = Field(description="T² of the EWMA; null for a run that T² rejects")
    ewma_p: Real
    values: dict[str, DeviationPart]


class NineChart(ResultModel):
    """The chart of the nine intrinsic numbers, which do not depend on the mounting; it gives the verdict."""

    centre: dict[str, ValuePart] = Field(description="centre lines, in unit/g, degrees and g")
    scale: float = Field(description="factor on the stated u")
    dof: Real = Field(description="degrees of freedom of `scale`, or of the stated u; null if known")
    limits_from: Basis
    limits: LimitsPart
    runs: dict[str, NineRun] = Field(description="statistics of each run, by its name")
    components: ComponentsPart | None
    drift: dict[str, DriftPart] | None = Field(description="drift per year beyond the known drift")


class ChartResult(ResultModel):
    """The control chart of a check block, and whether its last run is in control."""

    block: str
    unit: str = Field(description="unit of the signals")
    g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    simulated: bool
    intrinsic: NineChart
    design: DesignPart
    baseline: list[str] = Field(description="runs that define the centre lines")
    reference: str | None = Field(description="result file used in place of the baseline; null if none")
    centre: dict[str, ValuePart] = Field(description="centre line of each coefficient")
    scale: float = Field(description="factor on the stated u")
    dof: Real = Field(description="degrees of freedom of `scale`, or of the stated u; null if known")
    limits: LimitsPart
    runs: list[ChartedRun] = Field(description="runs after the baseline, oldest first")
    components: ComponentsPart | None
    drift: dict[str, DriftPart] | None
    """drift per year of the accepted runs beyond the known drift"""
    baseline_alone_p: list[float] | None
    """for each baseline run, p-value of the hypothesis that it agrees with the other baseline runs"""
    in_control: bool
    last: str | None = Field(description="the run that is judged last")
    notes: list[str]


@dataclass(frozen=True)
class CheckBlockChart:
    """The control charts of a check block: `chart`, of its nine intrinsic numbers, gives the verdict.

    `twelve` is the chart of the twelve coefficients. `unit` is the unit of the signals; `g_m_s2` is the local
    g, m/s², to which scale factors refer. `notes` names the runs that are not in the charts.
    """

    chart: ControlChart
    twelve: ControlChart
    block: str
    unit: str
    g_m_s2: float
    simulated: bool
    notes: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether the last run of the check block was in control."""
        return self.chart.in_control

    def sentence(self) -> str:
        """Return the verdict on the last run as a sentence."""
        if not self.chart.verdicts:
            first = self.chart.baseline[-1].name
            return message(f"NO VERDICT yet: {first} is the first run, and there is nothing to compare with")
        last = self.chart.verdicts[-1]
        if last.accepted:
            return message(f"IN CONTROL: {last.run}")
        return message(f"OUT OF CONTROL: {last.run}: {'; '.join(last.reasons)}")

    @cached_property
    def result(self) -> ChartResult:
        """The result of `bench chart --json`."""
        chart, design = self.twelve, self.twelve.design
        nine = {
            run.name: NineRun(**_joint_of(self.chart, row), values=_deviations(self.chart, row))
            for row, run in enumerate(self.chart.later)
        }
        return ChartResult.from_object(
            self,
            intrinsic=NineChart(limits_from=self.chart.design.basis, runs=nine, **_members(self.chart)),
            design=DesignPart.from_object(design, arl_of_each=design.each_arl, limits_from=design.basis),
            baseline=[run.name for run in chart.baseline],
            reference=chart.reference and chart.reference.name,
            **_members(chart),
            runs=[_run(chart, row, self.chart.verdicts[row]) for row in range(len(chart.later))],
            baseline_alone_p=None if chart.alone is None else chart.alone.tolist(),
            in_control=self.chart.in_control,
            last=chart.verdicts[-1].run if chart.verdicts else None,
            notes=[*self.notes, *self.chart.notes],
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the result of `bench chart --json` as a dictionary."""
        return self.result.to_dict()

    def print_on(self, out: Console) -> None:
        """Print the last runs, the deviations of the last run, and the verdict."""
        result = self.result
        what = result.reference or message(f"a baseline of {_counted(result.baseline)}")
        out.print(
            f"Control chart of the check block {result.block}{', SIMULATED' if result.simulated else ''}: "
            f"{_counted(result.runs)} against {what}"
        )
        if result.runs:
            out.print(_runs_table(result))
            out.print("")
            last, nine = result.runs[-1], result.intrinsic
            out.print(
                _numbers_table(
                    last.run, nine.runs[last.run].values, nine.limits, nine.components, result.unit
                )
            )
            out.print("the twelve coefficients, which a turn of the block changes, too:")
            out.print(
                _numbers_table(last.run, last.coefficients, result.limits, result.components, result.unit)
            )
            basis = {
                "stated": message("stated u"),
                "scaled": message(f"stated u, times {nine.scale:.2f} as the baseline shows"),
                "scatter": message("the scatter of the baseline"),
            }[nine.limits_from]
            out.print(
                f"false alarms: one in {result.design.arl:g} runs, all three statistics together; "
                f"limits from {basis}"
            )
        print_notes(out, result.notes)
        out.print(self.sentence(), style="bold")

    def __repr__(self) -> str:
        """Return the text that `bench chart` prints."""
        return as_text(self.print_on)


def _members(chart: ControlChart) -> dict[str, Any]:
    """Return the members that both charts (nine intrinsic numbers, twelve coefficients) have."""
    centre = chart.centre
    u = np.sqrt(np.diag(centre.covariance) * centre.scale)
    return {
        "centre": by_name(chart.names, ValuePart, value=centre.value, u=u),
        "scale": float(np.sqrt(centre.scale)),
        "dof": centre.dof,
        "limits": LimitsPart(
            t2=chart.limit_t2, ewma_t2=chart.limit_ewma, single=chart.limit_single,
            single_ewma=chart.limit_single_ewma,
        ),
        "components": _components(chart),
        "drift": chart.drift and by_name(chart.names, DriftPart, chart.drift),
    }  # fmt: skip


def _joint_of(chart: ControlChart, row: int) -> dict[str, float]:
    shewhart, ewma = chart.shewhart, chart.ewma
    return {
        "t2": shewhart.t2[row], "p": shewhart.p_joint[row], "ewma_t2": ewma.t2[row], "ewma_p": ewma.p_joint[row],
    }  # fmt: skip


def _deviations(chart: ControlChart, row: int) -> dict[str, DeviationPart]:
    shewhart, ewma = chart.shewhart, chart.ewma
    return by_name(
        chart.names, DeviationPart, deviation=shewhart.deviation[row], u=shewhart.u[row], z=shewhart.z[row],
        ewma=ewma.deviation[row], ewma_u=ewma.u[row], ewma_z=ewma.z[row],
    )  # fmt: skip


def _run(chart: ControlChart, row: int, verdict: Verdict) -> ChartedRun:
    run, short = chart.later[row], chart.short
    return ChartedRun.from_object(
        verdict,
        when=verdict.when.isoformat(),
        **_joint_of(chart, row),
        short_term=ShortTermPart(
            s=run.s, dof=run.s_dof, f=None if short is None else short.f[row],
            p=None if short is None else short.p[row],
        ),
        coefficients=_deviations(chart, row),
    )  # fmt: skip


def _components(chart: ControlChart) -> ComponentsPart | None:
    found, short = chart.components, chart.short
    if found is None:
        return None
    return ComponentsPart.from_object(
        found,
        coefficients=by_name(chart.names, VariabilityPart, found),
        birge=float(np.sqrt(found.birge2)),
        short_term=None if short is None else PooledPart(s=short.pooled, dof=short.pooled_dof),
    )


def _counted(runs: Sequence[object]) -> str:
    return message(f"{len(runs)} run{'' if len(runs) == 1 else 's'}")


def _in_u(z: float | None) -> str:
    return "–" if z is None else f"{z:+.1f}".replace("-", MINUS)


def _run_cells(result: ChartResult, run: ChartedRun) -> list[str]:
    """Return the cells of a run: start, T² of the nine numbers, T² of their EWMA, s by that of the baseline."""
    f, nine = run.short_term.f, result.intrinsic.runs[run.run]
    ewma_t2 = "–" if nine.ewma_t2 is None else f"{nine.ewma_t2:.1f}"
    return [
        run.when[:16].replace("T", " "), f"{nine.t2:.1f}", ewma_t2, "–" if f is None else f"{f**0.5:.2f}",
    ]  # fmt: skip


def _deviation_cells(name: str, own: DeviationPart, signal: str) -> list[str]:
    """Return the cells of a number: its deviation d, u of d, d divided by its u, EWMA divided by its u."""
    size, unit = _scale_of(name, own.u, signal)
    off = f"{fixed(own.deviation / size, 1)} {unit}"
    return [off, f"{own.u / size:.1f} {unit}", _in_u(own.z), _in_u(own.ewma_z)]


def _scale_of(name: str, largest: float, signal: str) -> tuple[float, str]:
    """Return factor and unit to print deviations of the intrinsic number or coefficient `name`."""
    if name in INTRINSIC:
        return small_unit(name, largest, signal)
    scale = scale_for(largest, signal)
    return scale.size, scale.unit if name.startswith("U0") else scale.per_g


def _runs_table(result: ChartResult) -> Table:
    limits = result.intrinsic.limits
    t2, ewma_t2 = f">T² (≤ {limits.t2:.1f})", f">EWMA T² (≤ {limits.ewma_t2:.1f})"
    shown = table("run", "begun", t2, ewma_t2, ">s / baseline", "verdict")
    for run in result.runs[-LAST_ROWS:]:
        shown.add_row(run.run, *_run_cells(result, run), "in control" if run.accepted else "OUT OF CONTROL")
    return shown


def _numbers_table(
    run: str,
    numbers: dict[str, DeviationPart],
    limits: LimitsPart,
    parts: ComponentsPart | None,
    signal: str,
) -> Table:
    """Return a table with a row for each number of a run: its deviation, and the scatter of the baseline."""
    shown = table(
        run, ">off the centre", ">u", f">in u (≤ {limits.single:.1f})",
        f">EWMA in u (≤ {limits.single_ewma:.1f})", ">scatter / stated u", ">",
    )  # fmt: skip
    for name, own in numbers.items():
        ratio, more = "–", ""
        if parts is not None:
            variability = parts.coefficients[name]
            ratio = f"{variability.scatter / variability.stated:.2f}"
            # Bonferroni over the numbers
            p = min(1.0, len(parts.coefficients) * variability.p)
            more = probability(p) if p < 0.01 else ""
        shown.add_row(name, *_deviation_cells(name, own, signal), ratio, more)
    return shown


MOST_SHOWN: Final = 60
"""Number of runs, the latest, that the page draws and lists."""
BASIS_IN_WORDS: Final = {
    "stated": message("stated u, unchanged"),
    "scaled": message("stated u, times one factor for all coefficients that the baseline shows"),
    "scatter": message("the scatter of the baseline alone (Hotelling's T²)"),
}


def render_chart(found: CheckBlockChart) -> str:
    """Return the HTML page; the same chart always gives the same text."""
    chart, result = found.chart, found.result
    last = chart.verdicts[-1] if chart.verdicts else None
    look = "none" if last is None else "passed" if last.accepted else "failed"
    word = {
        "none": message("No verdict yet"),
        "passed": message("✓ In control"),
        "failed": message("✗ Out of control"),
    }[look]
    figures = []
    if last is not None:
        joint, single = partial(draw_joint, chart, found.unit), partial(draw_single, chart, found.unit)
        figures = [
            svg_figure("joint", (7.4, 5.6), joint, message("T², EWMA and s of every run")),
            svg_figure("single", (7.4, 6.4), single, message("each of the nine by run")),
        ]
    return page(
        "control_chart.html.j2",
        found=found,
        chart=chart,
        look=look,
        word=word,
        last=last,
        basis=BASIS_IN_WORDS[chart.design.basis],
        figures=figures,
        result=result,
        runs=_runs(result),
        numbers=partial(_coefficients, signal=found.unit),
        components=_plotted_components(found),
        drift=_drift(result),
    )


def draw_joint(chart: ControlChart, unit: str, figure: Figure) -> None:
    """Draw panels of T² of each run, T² of the EWMA and, if known, the standard deviation of a reading."""
    shown = slice(-MOST_SHOWN, None)
    panels = figure.subplots(3 if chart.short is not None else 2, sharex=True, squeeze=False)[:, 0]
    along = np.arange(1.0, len(chart.later) + 1)[shown]
    _panel(panels[0], along, chart.shewhart.t2[shown], np.full(len(along), chart.limit_t2))
    panels[0].set_ylabel(message("T² of the run"))
    _panel(panels[1], along, chart.ewma.t2[shown], np.full(len(along), chart.limit_ewma))
    panels[1].set_ylabel(message(f"T² of the EWMA (λ = {chart.design.smoothing:g})"))
    if chart.short is not None:
        scale = scale_for(chart.short.pooled, unit)
        limits = chart.short.limits(chart.design.alpha)[shown] / scale.size
        _panel(panels[2], along, chart.short.s[shown] / scale.size, limits)
        panels[2].axhline(chart.short.pooled / scale.size, color=GREY, linewidth=0.7)
        panels[2].set_ylabel(message(f"s of a reading / {scale.unit}"))
    _name_runs(panels[-1], chart, along)


def draw_single(chart: ControlChart, unit: str, figure: Figure) -> None:
    """Draw a panel for each number: its deviations from the centre line and their EWMA, each with its limits."""
    shown = slice(-MOST_SHOWN, None)
    along = np.arange(1.0, len(chart.later) + 1)[shown]
    rows = -(-len(chart.names) // 3)
    grid = figure.subplots(rows, 3, sharex=True, squeeze=False)
    for k, name in enumerate(chart.names):
        axes = grid.flat[k]
        largest = max(float(np.max(chart.shewhart.u[:, k])), 1e-30) * chart.limit_single
        size, own = _scale_of(name, largest, unit)
        _coefficient(axes, chart, k, along, shown, size)
        axes.set_title(f"{symbol(name)} / {own}")
        axes.xaxis.get_major_locator().set_params(integer=True)
    figure.supylabel(message("off the centre"), fontsize=8)
    figure.supxlabel(message("run after the baseline"), fontsize=8)


def _coefficient(axes: Axes, chart: Any, k: int, along: Floats, shown: slice, size: float) -> None:
    own, smoothed = chart.shewhart, chart.ewma
    limit = chart.limit_single * own.u[shown, k] / size
    value = own.deviation[shown, k] / size
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    _level(axes, along, limit, color=VERMILION, linewidth=0.8)
    _level(axes, along, -limit, color=VERMILION, linewidth=0.8)
    near = chart.limit_single_ewma * smoothed.u[shown, k] / size
    _level(axes, along, near, color=GREY, linewidth=0.8, linestyle="--")
    _level(axes, along, -near, color=GREY, linewidth=0.8, linestyle="--")
    axes.plot(along, smoothed.deviation[shown, k] / size, color=GREY, linewidth=1.2)
    beyond = np.abs(own.z[shown, k]) > chart.limit_single
    axes.plot(along[~beyond], value[~beyond], "o", color=BLUE, markersize=3)
    axes.plot(along[beyond], value[beyond], "X", color=VERMILION, markersize=5)


def _panel(axes: Axes, along: Floats, values: Floats, limits: Floats) -> None:
    beyond = values > limits
    axes.plot(along, values, color=GREY, linewidth=0.7)
    axes.plot(along[~beyond], values[~beyond], "o", color=BLUE, markersize=4)
    axes.plot(along[beyond], values[beyond], "X", color=VERMILION, markersize=6)
    _level(axes, along, limits, color=VERMILION, linewidth=1.0)
    axes.set_ylim(bottom=0.0)


def _level(axes: Axes, along: Floats, level: Floats, **style: Any) -> None:
    """Draw a control limit as a step of width 1 around each run: visible even if there is only one run."""
    axes.plot(np.column_stack((along - 0.5, along + 0.5)).ravel(), np.repeat(level, 2), **style)


def _name_runs(axes: Axes, chart: Any, along: Floats) -> None:
    """Label at most 15 runs with their start date, and also with the time if several began on one day."""
    every = max(1, len(along) // 8)
    ticks = along[::-1][::every][::-1]
    days = {f"{run.when:%Y-%m-%d}" for run in chart.later}
    text = "%m-%d %H:%M" if len(days) < len(chart.later) else "%Y-%m-%d"
    axes.set_xticks(ticks, [f"{chart.later[int(k) - 1].when:{text}}" for k in ticks], fontsize=7)


def _runs(result: ChartResult) -> list[Row]:
    return [
        Row(
            escape(run.run),  # a name is not translated
            *_run_cells(result, run),
            "in control" if run.accepted else "; ".join(run.reasons),
            bad=not run.accepted,
        )
        for run in result.runs[-MOST_SHOWN:][::-1]
    ]


def _coefficients(numbers: dict[str, DeviationPart], limits: LimitsPart, signal: str) -> list[Row]:
    return [
        Row(
            html_symbol(name),
            *_deviation_cells(name, own, signal),
            bad=abs(own.z) > limits.single or abs(own.ewma_z or 0.0) > limits.single_ewma,
        )
        for name, own in numbers.items()
    ]


def _plotted_components(found: CheckBlockChart) -> list[Row]:
    parts = found.chart.components
    if parts is None:
        return []
    rows = []
    for k, name in enumerate(found.chart.names):
        scale, unit = _scale_of(name, float(parts.stated[k]), found.unit)
        columns = (parts.noise, parts.stated, parts.scatter, parts.between, parts.between_most)
        sizes = ["0" if column[k] == 0.0 else two_digits(float(column[k]) / scale) for column in columns]
        cells = (f"{size} {unit}" for size in sizes)
        p = probability(float(parts.p[k]))
        rows.append(
            Row(html_symbol(name), *cells, f"{parts.f[k]:.2f}", p, bad=bool(parts.more_than_stated[k] < 0.01))
        )
    return rows


def _drift(result: ChartResult) -> list[Row]:
    rows = []
    for name, one in (result.intrinsic.drift or {}).items():
        size, unit = _scale_of(name, one.u, result.unit)
        sizes = (f"{fixed(one.per_year / size, 1)} {unit}", f"{one.u / size:.1f} {unit}")
        rows.append(Row(html_symbol(name), *sizes, probability(one.p), bad=one.p < 0.01))
    return rows
