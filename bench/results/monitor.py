"""The result of `bench monitor`: biases, scale factors, angle in short runs over days; JSON, text, chart."""

from __future__ import annotations

from functools import partial

from pydantic import Field
from rich.console import Console

from bench.base.arrays import u_of
from bench.base.languages import HEADING, message, translated
from bench.base.numbers import fixed, places, scale_for
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes, table
from bench.history.control_chart import ControlChart
from bench.results.control_chart import draw_joint, draw_single
from bench.results.parts import ValuePart, by_name
from bench.results.plots import svg_figure


class MonitoredRun(ResultModel):
    """A monitor run (of two or four positions); runs of the baseline have no verdict."""

    run: str
    began: str
    values: dict[str, ValuePart]
    t2: float | None = Field(description="T² of the differences from the baseline")
    accepted: bool | None
    reasons: list[str]


class MonitorResult(ResultModel):
    """A series of monitor runs: the first `baseline` runs set the limits; the later runs are judged."""

    order: list[str]
    """names of the values: bx (g, with the sign of the signal) and Sx (`unit`/g) for each axis that was turned;
    theta_xz (deg) for two axes
    """
    unit: str = Field(description="unit of the signals")
    baseline: int
    limit_t2: float
    runs: list[MonitoredRun]
    in_control: bool
    notes: list[str]


def monitor_result(chart: ControlChart, unit: str) -> MonitorResult:
    """Return the result of a chart of monitor runs with signals in `unit`."""
    verdicts = [None] * len(chart.baseline) + list(chart.verdicts)
    t2 = [None] * len(chart.baseline) + chart.shewhart.t2.tolist()
    runs = [
        MonitoredRun(
            run=run.name, began=run.when.isoformat(),
            values=by_name(run.names, ValuePart, value=run.value, u=u_of(run.covariance)),
            t2=own, accepted=verdict and verdict.accepted, reasons=[] if verdict is None else verdict.reasons,
        )
        for run, verdict, own in zip((*chart.baseline, *chart.later), verdicts, t2, strict=True)
    ]  # fmt: skip
    return MonitorResult(
        order=chart.names, unit=unit, baseline=len(chart.baseline), limit_t2=chart.limit_t2, runs=runs,
        in_control=chart.in_control, notes=chart.notes,
    )  # fmt: skip


def print_monitor(result: MonitorResult, on: Console) -> None:
    """Print the numbers of each run, T² and the verdict."""
    units = {"b": "g", "S": scale_for(0.0, result.unit).per_g, "t": "deg"}
    shown = table("run", *(f">{name} / {units[name[0]]}" for name in result.order), ">T²", "")
    for run in result.runs:
        cells = [fixed(v.value, places(v.u)) for v in run.values.values()]
        word = message("baseline", "heading")
        if run.accepted is not None:
            word = message("in control") if run.accepted else message("OUT OF CONTROL")
        shown.add_row(run.run, *cells, "" if run.t2 is None else f"{run.t2:.1f}", translated(word, HEADING))
    on.print(shown)
    on.print(f"limit of T²: {result.limit_t2:.1f}, from {result.baseline} runs")
    for run in result.runs:
        for reason in run.reasons:
            on.print(f"{run.run}: {reason}")
    print_notes(on, result.notes)


def monitor_figures(chart: ControlChart, unit: str) -> dict[str, str]:
    """Return SVG charts: "joint" (T², EWMA, s), "single" (each number); {} if only the baseline was run."""
    if not chart.later:
        return {}
    return {
        "joint": svg_figure("monitor-joint", (7.4, 5.6), partial(draw_joint, chart, unit), "T², EWMA and s"),
        "single": svg_figure(
            "monitor-single", (7.4, 4.4), partial(draw_single, chart, unit), "each number by run"
        ),
    }
