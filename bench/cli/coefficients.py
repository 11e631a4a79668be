"""coefficients: what a navigation computer takes from a calibration, in the forms that others read."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    ModelOption,
    OutOption,
    RunsOption,
    SkipOption,
    app,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import Console
    from rich.table import Table

    from bench.base.arrays import Floats
    from bench.exchange.result import BlockResult, Row
    from bench.services.compensation import Given


@app.command(epilog="Example: bench coefficients unit-17 --as c --as px4")
def coefficients(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="SOURCE…", help="Results of calibrate --json, runs or readings files."),
    ],
    forms: Annotated[
        list[str] | None,
        typer.Option(
            "--as",
            metavar="FORM",
            help="json, csv, c, excel, kalibr, px4, ardupilot, or all; may be said several times (default: json).",
        ),
    ] = None,
    nominal: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Scale factors, unit/g (9.80665 m/s²), by which kalibr, px4 and ardupilot have the signals in "
            "m/s² (default: the block's, rounded).",
        ),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """What a computer takes: N = K⁻¹, misalignments; as JSON, CSV, C, Excel, for Kalibr, PX4, ArduPilot."""
    from bench.services.coefficients import forms_of, nominal_of
    from bench.services.compensation import results_of
    from bench.services.source import Request

    printing.check_target(json)
    asked = forms_of(forms or ["json"])
    given = results_of(Request(sources, runs, bench, model, g, out, skip_bad_rows))
    factors = nominal_of(nominal, [one.result for one in given])
    on = printing.console(json=json)
    for one in given:
        if one.source is not None:
            printing.bench_file(one.source.taken, json, one.source.name if len(given) > 1 else "")
        _print(one.result, on)
        _write(one, asked, factors, on, asked_for=out is not None or bool(forms))
    printing.write_json([one.result.to_json() for one in given], json)
    return 0


def _write(given: Given, forms: list[str], nominal: Floats | None, on: Console, *, asked_for: bool) -> None:
    """Write each form, and say what it loses."""
    from bench.exchange.forms import FORMS

    for name in forms:
        form = FORMS[name]
        file = given.file(form.suffix)
        if not printing.write_beside(file, form.write(given.result, nominal), asked=asked_for):
            continue
        printing.written(form.words, file, on)
        for line in form.loses(given.result, nominal) if form.loses else ():
            on.print(f"  {line}")


def _print(result: BlockResult, on: Console) -> None:
    for line in result.head():
        on.print(line, style="bold" if line.startswith("SIMULATED") else None)
    on.print("a = N (U - U0), a the specific force in g of the place")
    on.print(_table(result.inverse_rows, result.k))
    on.print("misalignment angles of the input axes, K_ij = (-1)^n K_ii alpha_ji, n = 2 where j follows i")
    on.print(_table(result.misalignment_rows, result.k, 3600 * math.degrees(1.0), "arcsec"))


def _table(rows: Iterable[Row], k: float, times: float = 1.0, unit: str = "") -> Table:
    """Return the rows with u and U, rounded to two digits of u."""
    from bench.base.numbers import fixed, places

    shown = printing.table("", ">value", ">u", f">U (k={k:g})", "")
    for row in rows:
        digits = places(times * row.u)
        cells = (fixed(times * size, digits) for size in (row.value, row.u, row.U))
        shown.add_row(row.name, *cells, unit or row.unit)
    return shown
