"""chart: the control charts of a check block, and whether its last run is accepted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.numbers import MINUS, fixed, probability, scale_for
from bench.cli import printing
from bench.cli.options import RUNS, BenchOption, JsonOption, RunsOption, app

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.history.control_chart import ControlChart
    from bench.services.check_block import CheckBlockChart

LAST_ROWS = 12


@app.command(epilog="Example: bench chart runs --bench my-bench.yaml --page chart.html")
def chart(
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RUN…|DIR", help="Runs of the check block, or a folder of runs in which they are."
        ),
    ] = None,
    bench: BenchOption = None,
    baseline: Annotated[
        int | None, typer.Option(min=1, help="How many runs in control say what the block is.")
    ] = None,
    arl: Annotated[float | None, typer.Option(help="Mean number of runs between false alarms.")] = None,
    smoothing: Annotated[float | None, typer.Option(help="λ of the EWMA.")] = None,
    limits: Annotated[
        str | None, typer.Option(help="What limits are from: stated, scaled or scatter.")
    ] = None,
    real: Annotated[
        bool | None,
        typer.Option(
            "--real/--simulated", help="Which runs of a folder, where it has both (default: the latest's)."
        ),
    ] = None,
    json: JsonOption = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Write the charts as one HTML page.")
    ] = None,
    runs: RunsOption = RUNS,
) -> int:
    """Control charts of the check block (Shewhart, EWMA); exit status 1 unless its last run is in control."""
    from bench.services.check_block import chart_of, with_options
    from bench.services.check_runs import charted_runs

    printing.check_target(json)
    taken = charted_runs(sources or [str(runs)], runs, bench, real=real)
    section = with_options(taken.section, baseline=baseline, arl=arl, smoothing=smoothing, limits=limits)
    found = chart_of(taken.runs, section, of_bench=taken.bench_file, folder=runs)
    out = printing.console(json=json)
    print_chart(found, out)
    if page is not None:
        from bench.base.files import write_whole
        from bench.results.control_chart import ChartOfBlock, render_chart

        of = ChartOfBlock(
            found.chart, found.block, found.unit, found.simulated, found.notes, found.sentence()
        )
        write_whole(page, render_chart(of))
        printing.written("page", page, out)
    printing.write_json([found.to_dict()], json)
    return 0 if found.accepted else 1


def print_chart(found: CheckBlockChart, out: Console) -> None:
    """Print the last runs, their deviations, and the verdict."""
    own = found.chart
    kind = ", SIMULATED" if found.simulated else ""
    what = own.reference.name if own.reference is not None else f"a baseline of {_runs(len(own.baseline))}"
    out.print(f"Control chart of the check block {found.block}{kind}: {_runs(len(own.later))} against {what}")
    if own.verdicts:
        out.print(_runs_table(own))
        out.print("")
        out.print(_coefficients_table(found))
        factor = float(own.centre.scale) ** 0.5
        basis = {
            "stated": "stated u",
            "scaled": f"stated u, times {factor:.2f} as the baseline shows",
            "scatter": "the scatter of the baseline",
        }[own.design.basis]
        out.print(
            f"false alarms: one in {own.design.arl:g} runs, all three statistics together; limits from {basis}"
        )
    printing.notes_on(out, (*found.notes, *own.notes))
    out.print(found.sentence(), style="bold")


def _runs(count: int) -> str:
    return f"{count} run{'s' * (count != 1)}"


def _in_u(z: float) -> str:
    """Return a deviation in its u, with its sign; a dash where there is none."""
    return "–" if math.isnan(z) else f"{z:+.1f}".replace("-", MINUS)


def _runs_table(chart: ControlChart) -> Table:
    t2, ewma_t2 = f">T² (≤ {chart.limit_t2:.1f})", f">EWMA T² (≤ {chart.limit_ewma:.1f})"
    shown = printing.table("run", "begun", t2, ewma_t2, ">s / baseline", "verdict")
    rows = range(len(chart.later))[-LAST_ROWS:]
    for row in rows:
        verdict = chart.verdicts[row]
        ewma = chart.ewma.t2[row]
        s = "–" if chart.short is None else f"{chart.short.f[row] ** 0.5:.2f}"
        shown.add_row(
            verdict.run,
            f"{verdict.when:%Y-%m-%d %H:%M}",
            f"{chart.shewhart.t2[row]:.1f}",
            "–" if math.isnan(ewma) else f"{ewma:.1f}",
            s,
            "in control" if verdict.accepted else "OUT OF CONTROL",
        )
    return shown


def _coefficients_table(found: CheckBlockChart) -> Table:
    """The last run by coefficient: how far from the centre, in u, and what repeats of the baseline say of u."""
    from bench.model.geometry import COEFFICIENTS

    chart = found.chart
    shewhart, ewma = chart.shewhart, chart.ewma
    shown = printing.table(
        f"{chart.verdicts[-1].run}", ">off the centre", ">u", f">in u (≤ {chart.limit_single:.1f})",
        f">EWMA in u (≤ {chart.limit_single_ewma:.1f})", ">scatter / stated u", ">",
    )  # fmt: skip
    for k, name in enumerate(COEFFICIENTS):
        scale = scale_for(float(shewhart.u[-1, k]), found.unit)
        unit = scale.unit if name.startswith("U0") else scale.per_g
        parts = chart.components
        ratio = "–" if parts is None else f"{parts.scatter[k] / parts.stated[k]:.2f}"
        more = parts is not None and parts.more_than_stated[k] < 0.01
        shown.add_row(
            name,
            f"{fixed(float(shewhart.deviation[-1, k]) / scale.size, 1)} {unit}",
            f"{float(shewhart.u[-1, k]) / scale.size:.1f} {unit}",
            _in_u(float(shewhart.z[-1, k])),
            _in_u(float(ewma.z[-1, k])),
            ratio,
            probability(float(parts.more_than_stated[k])) if more and parts is not None else "",
        )
    return shown
