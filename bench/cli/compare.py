"""compare: calibrations of one block over time, from results, runs or readings files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.numbers import fixed, places, probability
from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    OutOption,
    RunsOption,
    SkipOption,
    app,
)
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.history.comparison import Changes, Comparison, Drift, Snapshot
    from bench.services.source import Request


@app.command(epilog="Example: bench compare 2025.json 2026.json unit-17 --strict")
def compare(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="A B…", help="Results of calibrate --json, runs or readings files."),
    ],
    date: Annotated[
        list[str] | None,
        typer.Option(metavar="YYYY-MM-DD", help="Date of each, in their order, where they do not say it."),
    ] = None,
    bench: BenchOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="A change beyond the uncertainty is not accepted.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """What changed between calibrations of one block: E_n, a joint test, drift."""
    from bench.history import comparison
    from bench.services.source import Request

    printing.check_target(json)
    request = Request(sources, runs, bench, None, g, out, skip_bad_rows)
    taken: list[dict[str, str]] = []
    snapshots = [snapshot for name in sources for snapshot in _snapshots(name, request, taken, json)]
    if date:
        snapshots = _dated(snapshots, date)
    result = comparison.compare(snapshots)
    on = printing.console(json=json)
    written = {**result.to_json(), "bench": taken}
    _print(result, on)
    if out is not None:
        _write(out, result, written, on)
    printing.write_json([written], json)
    return 1 if strict and result.changed else 0


def _snapshots(name: str, request: Request, taken: list[dict[str, str]], json: str | None) -> list[Snapshot]:
    """Return the calibration of a run or readings file, or those in a result of `calibrate --json`.

    Which bench file is taken for readings is said, and added to `taken`.
    """
    from bench.history.comparison import Snapshot
    from bench.run.events import MANIFEST
    from bench.services.calibration import calibration_of
    from bench.services.coefficients import date_of, snapshots_in
    from bench.services.source import load_sources

    path = Path(name)
    if path.is_file() and path.suffix.lower() == ".json" and path.name != MANIFEST:
        return snapshots_in(path)
    (source,) = load_sources(replace(request, sources=[name]))
    printing.bench_file(source.taken, json, name)
    taken.append({"source": name, **source.taken.to_dict()})
    result = calibration_of(source).calibration
    return [
        Snapshot(
            name,
            date_of(source.made_at, name),
            source.block_name,
            result.unit,
            result.g_m_s2,
            result.block.vector,
            result.covariance,
            source.simulated,
            result.covariance_same_meters,
            source.meters,
            result.block_terms if result.sources else None,
            result.wander,
        )
    ]


def _dated(snapshots: list[Snapshot], dates: Sequence[str]) -> list[Snapshot]:
    from bench.services.coefficients import date_of

    if len(dates) != len(snapshots):
        raise Refused(
            f"--date: {len(dates)} given for {len(snapshots)} calibrations; give one for each, in their order"
        )
    return [replace(s, when=date_of(date, "--date")) for s, date in zip(snapshots, dates, strict=True)]


def _print(result: Comparison, out: Console) -> None:
    from bench.model.geometry import COEFFICIENTS

    first = result.first
    out.print(f"Against {_named(first)}: {first.unit}/g (biases {first.unit}), g = {first.g_m_s2:.6g} m/s²")
    for changes in result.changes:
        out.print(f"{_named(changes.later)}:")
        out.print(_changes_table(changes))
        out.print(f"all twelve together: chi2 {changes.chi2:.1f} for 12, {probability(changes.p)}")
    if result.drift is not None:
        out.print("drift (weighted straight lines):")
        out.print(_drift_table(result.drift))
        out.print(
            f"what the lines leave: chi2 {result.drift.chi2:.1f} for {result.drift.dof}, "
            f"{probability(result.drift.p)}"
        )
    printing.notes_on(out, result.notes)
    names = sorted(
        {n for c in result.changes for n, is_so in zip(COEFFICIENTS, c.changed, strict=True) if is_so}
    )
    if names:
        verdict = f"CHANGED beyond the uncertainty (5 %, all looks counted): {', '.join(names)}"
    elif result.changed:
        verdict = "CHANGED: no single coefficient, but all of them together"
    else:
        verdict = "nothing changed beyond its uncertainty"
    out.print(f"{verdict}; all calibrations alike: {probability(result.p_constant)}", style="bold")


def _named(snapshot: Snapshot) -> str:
    when = f" ({snapshot.when:%Y-%m-%d})" if snapshot.when else ""
    return f"{snapshot.name}{when}"


def _changes_table(changes: Changes) -> Table:
    from bench.model.geometry import COEFFICIENTS

    table = printing.table("coefficient", ">difference", ">U (k=2)", ">En", ">p, all looks", "")
    rows = zip(
        COEFFICIENTS,
        changes.difference,
        changes.u,
        changes.en,
        changes.p_all_looks,
        changes.changed,
        strict=True,
    )
    for name, difference, u, en, p, changed in rows:
        digits = places(float(2 * u))
        table.add_row(
            name,
            fixed(difference, digits, sign=True),
            fixed(2 * u, digits),
            f"{en:.2f}",
            f"{p:.2g}",
            "CHANGED" if changed else "",
        )
    return table


def _drift_table(drift: Drift) -> Table:
    from bench.model.geometry import COEFFICIENTS

    table = printing.table("coefficient", ">per year", ">U (k=2)", ">p, all looks", "")
    rows = zip(COEFFICIENTS, drift.per_year, drift.u, drift.p_all_looks, drift.shown, strict=True)
    for name, slope, u, p, shown in rows:
        digits = places(float(2 * u))
        table.add_row(
            name, fixed(slope, digits, sign=True), fixed(2 * u, digits), f"{p:.2g}", "DRIFTS" if shown else ""
        )
    return table


def _write(folder: Path, result: Comparison, written: dict[str, Any], out: Console) -> None:
    from bench.base.files import to_text, write_whole
    from bench.results.figures import history_figure

    folder.mkdir(parents=True, exist_ok=True)
    for what, name, text in (
        ("result", "compare.json", to_text(written)),
        ("figure", "compare.svg", history_figure(result)),
    ):
        write_whole(folder / name, text)
        printing.written(what, folder / name, out)
