"""The result of `bench chart`: the control chart of a check block, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.numbers import MINUS, fixed, probability, scale_for
from bench.base.result_model import Real, ResultModel
from bench.base.tables import as_text, table
from bench.history.control_chart import ControlChart
from bench.results.parts import ValuePart, by_coefficient, print_notes
from bench.stats.control_charts import Basis

LAST_ROWS: Final = 12
"""So many of the last runs are listed in a terminal."""


class DesignPart(ResultModel):
    """By which rules the chart judges."""

    arl: float = Field(description="mean number of runs between false alarms of the whole")
    arl_of_each: float = Field(description="the same of each of the three statistics that reject a run")
    smoothing: float = Field(description="λ of the EWMA")
    limits_from: Basis


class LimitsPart(ResultModel):
    """The limits of the charts."""

    t2: float = Field(description="of T² of a run")
    ewma_t2: float = Field(description="of T² of the EWMA")
    single: float = Field(description="of one coefficient, in u")
    single_ewma: float = Field(description="of the EWMA of one coefficient, in its u")


class ShortTermPart(ResultModel):
    """The scatter within a run."""

    s: float = Field(description="short-term standard deviation of a reading, in the unit")
    dof: float
    f: Real = Field(description="its square over that of the baseline")
    p: Real = Field(description="chance of more (F test)")


class DeviationPart(ResultModel):
    """A coefficient of a run: off the centre, u of that, and one over the other; the same of the EWMA."""

    deviation: float
    u: float
    z: float
    ewma: Real
    ewma_u: Real
    ewma_z: Real


class ChartedRun(ResultModel):
    """A run of the check block that is judged."""

    run: str
    when: str = Field(description="ISO 8601")
    accepted: bool
    reasons: list[str] = Field(description="why it is rejected, a clause each")
    t2: float = Field(description="T² of all coefficients")
    p: float = Field(description="chance of as much")
    ewma_t2: Real = Field(description="T² of the EWMA; null for a run that T² rejects")
    ewma_p: Real
    short_term: ShortTermPart
    coefficients: dict[str, DeviationPart]


class VariabilityPart(ResultModel):
    """The variability of a coefficient in the baseline, as standard deviations."""

    noise: float = Field(description="from the noise of readings")
    stated: float = Field(description="u of one run from all that comes anew with it")
    scatter: float = Field(description="between runs")
    f: float = Field(description="(scatter/stated)²")
    p: float = Field(description="chance of more")
    between: float = Field(description="the part of the scatter beyond stated u")
    between_most: float = Field(description="its upper limit of 95 %")


class PooledPart(ResultModel):
    """The short-term standard deviation of a reading, pooled over the baseline."""

    s: float
    dof: float


class ComponentsPart(ResultModel):
    """Short-term and long-term variability in the baseline."""

    coefficients: dict[str, VariabilityPart]
    runs: int
    birge: float = Field(description="Birge ratio of all coefficients: scatter over stated u")
    birge_dof: int
    birge_p: float = Field(description="chance of a ratio so far from 1")
    alike_p: float = Field(description="chance of ratios so different between directions")
    short_term: PooledPart | None


class DriftPart(ResultModel):
    """The drift of a coefficient in accepted runs, a straight line."""

    per_year: float
    u: float
    p: float = Field(description="chance of as much in any of the twelve")


class ChartResult(ResultModel):
    """The control chart of a check block, and whether its last run is in control."""

    block: str
    unit: str = Field(description="of the signals")
    g_m_s2: float = Field(description="the g that scale factors are per")
    simulated: bool
    design: DesignPart
    baseline: list[str] = Field(description="runs that say what the block is")
    reference: str | None = Field(description="the result that is used in their place")
    centre: dict[str, ValuePart] = Field(description="what the block is")
    scale: float = Field(description="by how much stated u is multiplied")
    dof: Real = Field(description="degrees of freedom of that; null where stated u is believed")
    limits: LimitsPart
    runs: list[ChartedRun] = Field(description="runs after the baseline, the oldest first")
    components: ComponentsPart | None
    drift: dict[str, DriftPart] | None = Field(description="what accepted runs show, in a year")
    baseline_alone_p: list[float] | None = Field(description="chance of each baseline run beside the others")
    in_control: bool
    last: str | None = Field(description="the run that is judged last")
    notes: list[str]


@dataclass(frozen=True)
class CheckBlockChart:
    """The control chart of a check block: of which `block`, in which `unit` per `g_m_s2`, and what was left out."""

    chart: ControlChart
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
        """Return what the chart says of its last run."""
        if not self.chart.verdicts:
            first = self.chart.baseline[-1].name
            return f"NO VERDICT yet: {first} is the first, and nothing is there to hold it against"
        last = self.chart.verdicts[-1]
        if last.accepted:
            return f"IN CONTROL: {last.run}"
        return f"OUT OF CONTROL: {last.run}: {'; '.join(last.reasons)}"

    @cached_property
    def result(self) -> ChartResult:
        """The result as `bench chart --json` writes it."""
        chart, design, centre = self.chart, self.chart.design, self.chart.centre
        return ChartResult(
            block=self.block,
            unit=self.unit,
            g_m_s2=self.g_m_s2,
            simulated=self.simulated,
            design=DesignPart.from_object(design, arl_of_each=design.each_arl, limits_from=design.basis),
            baseline=[run.name for run in chart.baseline],
            reference=None if chart.reference is None else chart.reference.name,
            centre=by_coefficient(
                ValuePart, value=centre.value, u=np.sqrt(np.diag(centre.covariance) * centre.scale)
            ),
            scale=float(np.sqrt(centre.scale)),
            dof=centre.dof,
            limits=LimitsPart(
                t2=chart.limit_t2, ewma_t2=chart.limit_ewma, single=chart.limit_single,
                single_ewma=chart.limit_single_ewma,
            ),
            runs=[_run(chart, row) for row in range(len(chart.later))],
            components=_components(chart),
            drift=None if chart.drift is None else by_coefficient(DriftPart, **vars(chart.drift)),
            baseline_alone_p=None if chart.alone is None else chart.alone.tolist(),
            in_control=chart.in_control,
            last=chart.verdicts[-1].run if chart.verdicts else None,
            notes=[*self.notes, *chart.notes],
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench chart --json` writes it."""
        return self.result.to_dict()

    def print_on(self, out: Console) -> None:
        """Print the last runs, the deviations of the last one, and the verdict."""
        result = self.result
        kind = ", SIMULATED" if result.simulated else ""
        what = result.reference or f"a baseline of {_counted(result.baseline)}"
        out.print(
            f"Control chart of the check block {result.block}{kind}: {_counted(result.runs)} against {what}"
        )
        if result.runs:
            out.print(_runs_table(result))
            out.print("")
            out.print(_coefficients_table(result))
            basis = {
                "stated": "stated u",
                "scaled": f"stated u, times {result.scale:.2f} as the baseline shows",
                "scatter": "the scatter of the baseline",
            }[result.design.limits_from]
            out.print(
                f"false alarms: one in {result.design.arl:g} runs, all three statistics together; "
                f"limits from {basis}"
            )
        print_notes(result.notes, out)
        out.print(self.sentence(), style="bold")

    def __repr__(self) -> str:
        """Return what `bench chart` prints."""
        return as_text(self.print_on)


def _run(chart: ControlChart, row: int) -> ChartedRun:
    verdict, run, short, shewhart, ewma = (
        chart.verdicts[row], chart.later[row], chart.short, chart.shewhart, chart.ewma
    )  # fmt: skip
    return ChartedRun.from_object(
        verdict,
        when=verdict.when.isoformat(),
        t2=shewhart.t2[row],
        p=shewhart.p_joint[row],
        ewma_t2=ewma.t2[row],
        ewma_p=ewma.p_joint[row],
        short_term=ShortTermPart(
            s=run.s, dof=run.s_dof, f=None if short is None else short.f[row],
            p=None if short is None else short.p[row],
        ),
        coefficients=by_coefficient(
            DeviationPart, deviation=shewhart.deviation[row], u=shewhart.u[row], z=shewhart.z[row],
            ewma=ewma.deviation[row], ewma_u=ewma.u[row], ewma_z=ewma.z[row],
        ),
    )  # fmt: skip


def _components(chart: ControlChart) -> ComponentsPart | None:
    found, short = chart.components, chart.short
    if found is None:
        return None
    columns: dict[str, Floats] = {name: getattr(found, name) for name in VariabilityPart.model_fields}
    return ComponentsPart.from_object(
        found,
        coefficients=by_coefficient(VariabilityPart, **columns),
        birge=float(np.sqrt(found.birge2)),
        short_term=None if short is None else PooledPart(s=short.pooled, dof=short.pooled_dof),
    )


def _counted(runs: Sequence[object]) -> str:
    return f"{len(runs)} run{'s' * (len(runs) != 1)}"


def _in_u(z: float | None) -> str:
    """Return a deviation in its u, with its sign; a dash where there is none."""
    return "–" if z is None else f"{z:+.1f}".replace("-", MINUS)


def _runs_table(result: ChartResult) -> Table:
    t2, ewma_t2 = f">T² (≤ {result.limits.t2:.1f})", f">EWMA T² (≤ {result.limits.ewma_t2:.1f})"
    shown = table("run", "begun", t2, ewma_t2, ">s / baseline", "verdict")
    for run in result.runs[-LAST_ROWS:]:
        f = run.short_term.f
        shown.add_row(
            run.run, run.when[:16].replace("T", " "), f"{run.t2:.1f}",
            "–" if run.ewma_t2 is None else f"{run.ewma_t2:.1f}", "–" if f is None else f"{f**0.5:.2f}",
            "in control" if run.accepted else "OUT OF CONTROL",
        )  # fmt: skip
    return shown


def _coefficients_table(result: ChartResult) -> Table:
    """The last run by coefficient: how far from the centre, in u, and what repeats of the baseline say of u."""
    last, limits, parts = result.runs[-1], result.limits, result.components
    shown = table(
        last.run, ">off the centre", ">u", f">in u (≤ {limits.single:.1f})",
        f">EWMA in u (≤ {limits.single_ewma:.1f})",        ">scatter / stated u", ">",
    )  # fmt: skip
    for name, own in last.coefficients.items():
        scale = scale_for(own.u, result.unit)
        unit = scale.unit if name.startswith("U0") else scale.per_g
        ratio, more = "–", ""
        if parts is not None:
            variability = parts.coefficients[name]
            ratio = f"{variability.scatter / variability.stated:.2f}"
            # Bonferroni over the coefficients
            p = min(1.0, len(parts.coefficients) * variability.p)
            more = probability(p) if p < 0.01 else ""
        shown.add_row(
            name, f"{fixed(own.deviation / scale.size, 1)} {unit}", f"{own.u / scale.size:.1f} {unit}",
            _in_u(own.z), _in_u(own.ewma_z), ratio, more,
        )  # fmt: skip
    return shown
