"""Commands on temperature, stability and history: compensate, stability, compare."""

from __future__ import annotations

from typing import Annotated

import typer

from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    app,
)


@app.command(epilog="Example: bench compensate unit-17-over-temperature --reference 23")
def compensate(
    sources: Sources,
    reference: Annotated[
        float, typer.Option(metavar="DEGC", help="Temperature about which the polynomials stand.")
    ] = 23.0,
    degree: Annotated[
        str, typer.Option(metavar="auto|N", help="Degree for all, or each coefficient's by the data.")
    ] = "auto",
    step: Annotated[
        float | None, typer.Option(metavar="K", help="Step of the table (default: as fine as u asks for).")
    ] = None,
    bench: BenchOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Polynomials that do not fit (p < 0.01) are not accepted.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Coefficients as polynomials in temperature; tables (C, CSV, JSON) for a computer on board."""
    from bench.cli import compensate as command
    from bench.cli.source import Request

    request = Request(sources, runs, bench, None, g, out, skip_bad_rows)
    return command.compensate(request, reference, degree, step, json, strict=strict)


@app.command(epilog="Example: bench stability static.csv --size 20e-6 --bench my-bench.yaml")
def stability(
    record: Annotated[
        str, typer.Argument(metavar="FILE", help="Static record (CSV: time_s,ux_v,uy_v,uz_v), or a run.")
    ],
    size: Annotated[
        float | None,
        typer.Option(help="Noise that a reading may have, unit of the signals (default: where it flattens)."),
    ] = None,
    integration: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="How long the meter integrated for each sample (default: all the time)."
        ),
    ] = None,
    bench: BenchOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Allan deviation and noise terms of a block at rest, and the averaging that a reading deserves."""
    from bench.cli import stability as command

    return command.stability(command.Request(record, runs, bench, size, integration, out), json)


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
    from bench.cli import compare as command
    from bench.cli.source import Request

    request = Request(sources, runs, bench, None, g, out, skip_bad_rows)
    return command.compare_calibrations(request, date or [], json, strict=strict)
