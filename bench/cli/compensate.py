"""compensate: from a run over several temperatures to polynomials, and to tables for a computer on board."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.numbers import fixed, places, scale_for
from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    StrictFitOption,
    app,
)
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.calibration import Verification
    from bench.calibration.temperature.model import TemperatureModel
    from bench.calibration.temperature.table import CompensationTable
    from bench.services.source import Source

HYSTERESIS_P = 0.05


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
    strict: StrictFitOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Coefficients as polynomials in temperature; tables (C, CSV, JSON) for a computer on board."""
    from bench.calibration.temperature.estimate import temperature_model
    from bench.calibration.temperature.table import make_table, table_json
    from bench.results.parts import uncertainty_source
    from bench.results.verification import verdict_line, verdict_part
    from bench.services.compensation import sign_model
    from bench.services.source import Request, load_sources

    printing.check_target(json)
    loaded = load_sources(Request(sources, runs, bench, None, g, out, skip_bad_rows))
    on = printing.console(json=json)
    printing.bench_files(loaded, json)
    first, names = loaded[0], [source.name for source in loaded]
    strangers = [source.name for source in loaded if source.g_m_s2 != first.g_m_s2]
    if strangers:
        raise Refused(
            f"{', '.join(strangers)}: another local gravity than in {first.name}; "
            "a temperature model is made on one bench"
        )
    tables = [source.readings for source in loaded]
    shown = temperature_model(tables, first.model, first.stand_u, first.g_m_s2, reference, _degree(degree))
    signed = sign_model(shown, first)
    model = signed.combined
    table = make_table(model, first.bench.unit_under_test.range, step)
    checks = [check for source in loaded for check in _verified(source, signed.same_meters)]
    result = {
        **model.to_json(),
        "covariance_readings": shown.covariance.tolist(),
        "uncertainty_sources": [uncertainty_source(source).to_dict() for source in signed.sources],
        "table": table_json(table),
        "verification": [{"temperature_c": t, **verdict_part(check).to_dict()} for t, check in checks],
        "sources": names,
        "bench": first.taken.to_dict(),
        "corrections": [one for source in loaded for one in source.traced.to_json()],
        "simulated": any(source.simulated for source in loaded),
    }
    files = _write(first, model, table, result)
    _print(model, table, names, on)
    for t, check in checks:
        on.print(verdict_line(f"verification at {t:.1f} °C", check), style="bold")
    for what, file in files.items():
        printing.written(what, file, on)
    printing.write_json([result], json)
    passed = all(check.passed for _, check in checks)
    printing.notes_on(on, model.fitted.diagnose(" ".join(names)))
    tests = [model.fitted, *([model.curve] if model.curve else [])]
    return 0 if passed and all(test.accepted(strict=strict) for test in tests) else 1


def _degree(text: str) -> int | None:
    if text == "auto":
        return None
    if text.isascii() and text.isdecimal() and 1 <= int(text) <= 6:
        return int(text)
    raise Refused(f"--degree {text}: expected 'auto', or a whole number from 1 to 6")


def _verified(source: Source, model: TemperatureModel) -> list[tuple[float, Verification]]:
    """Judge the verification points of a source, each at its own temperature; those within the range only."""
    import numpy as np

    from bench.calibration import verify
    from bench.services.verification import own_judgement

    rows = source.readings.verification()
    known = np.isfinite(rows.temperature_c) & ~model.outside(rows.temperature_c)
    by = own_judgement(source)
    judged = []
    for t in np.unique(rows.temperature_c[known]):
        own = source.readings.select(
            (source.readings.installation == "V") & (source.readings.temperature_c == t)
        )
        noise = model.noise.widened().by_channel
        verdict = verify(
            own,
            model.block(t),
            model.covariance_at(t),
            noise,
            by.limit_g,
            rule=by.rule,
            population=by.population,
        )
        judged.append((float(t), verdict))
    return judged


def _write(
    source: Source, model: TemperatureModel, table: CompensationTable, result: dict[str, Any]
) -> dict[str, Path]:
    from bench.base.files import to_text
    from bench.calibration.temperature.table import c_header, table_csv

    unit = source.bench.unit_under_test
    of = f"{unit.type} {unit.serial}".strip() + f", from {source.name}"
    of += " (simulated instruments)" if source.simulated else ""
    texts = {
        ("result", ".json"): to_text(result),
        ("C header", ".h"): c_header(model, table, of),
        ("table", ".csv"): table_csv(model, table, of),
    }
    asked = source.request.out is not None
    return {
        what: source.output("compensate", suffix)
        for (what, suffix), text in texts.items()
        if printing.write_beside(source.output("compensate", suffix), text, asked=asked)
    }


def _print(model: TemperatureModel, table: CompensationTable, names: list[str], out: Console) -> None:
    out.print(
        f"Temperature model of {', '.join(names)}: {model.readings} readings, {model.minimum_c:.1f} to "
        f"{model.maximum_c:.1f} °C, about {model.reference_c:g} °C"
    )
    out.print(f"U = K(T) a + U0(T), a the specific force in g (+1 g on an upward axis), U in {model.unit}")
    out.print(_coefficient_table(model))
    _print_hysteresis(model, out)
    _print_fit(model, out)
    error = table.error
    out.print(
        f"table: {table.nodes} temperatures, every {table.step_k:.3g} K; interpolation adds at most "
        f"{error.bias * 1e6:.2g} µg and {error.per_g * 1e6:.2g} µg for each g, single precision "
        f"{error.single * 1e6:.2g} µg up to {error.reach_g:g} g"
    )
    printing.notes_on(out, model.notes)


def _coefficient_table(model: TemperatureModel) -> Table:
    """Each coefficient at the reference, its slope there, and how far it goes over the range."""
    import numpy as np

    from bench.model.geometry import COEFFICIENTS

    table = printing.table(
        "coefficient", ">at the reference", ">u", ">per K there", ">u", ">degree", ">over the range", ""
    )
    u = np.sqrt(np.diag(model.covariance)).reshape(model.values.shape)
    swept = model.coefficients(np.linspace(model.minimum_c, model.maximum_c, 101))
    for j, name in enumerate(COEFFICIENTS):
        value, slope = model.values[j, :2]
        digits, slope_digits = places(float(u[j, 0])), places(float(u[j, 1]))
        table.add_row(
            name,
            fixed(value, digits),
            fixed(u[j, 0], digits),
            fixed(slope, slope_digits),
            fixed(u[j, 1], slope_digits),
            str(model.degrees[j]),
            fixed(float(np.ptp(swept[:, j])), digits),
            model.unit if name.startswith("U0") else f"{model.unit}/g",
        )
    return table


def _print_hysteresis(model: TemperatureModel, out: Console) -> None:
    from bench.model.geometry import COEFFICIENTS

    hysteresis = model.hysteresis
    if hysteresis is None:
        return
    scale = scale_for(float(abs(hysteresis.size).max()), model.unit)
    shown = [
        f"{name} {size / scale.size:+.2g} ± {u / scale.size:.2g}"
        for name, size, u, p in zip(
            COEFFICIENTS, hysteresis.size, hysteresis.u, hysteresis.p_each, strict=True
        )
        if p < HYSTERESIS_P
    ]
    which = (
        f"{', '.join(shown)} ({scale.unit}/g, biases in {scale.unit})" if shown else "no single coefficient"
    )
    verdict = f"shown: {which}" if hysteresis.p < HYSTERESIS_P else "none shown"
    out.print(f"hysteresis, rising minus falling: p = {hysteresis.p:.2g} for all twelve: {verdict}")
    if hysteresis.p < HYSTERESIS_P:
        out.print(
            "  half of it either way is in the uncertainty: a reader of the table does not know the side"
        )


def _print_fit(model: TemperatureModel, out: Console) -> None:
    for what, test in (("lack of fit against the repeats", model.fitted), ("polynomials", model.curve)):
        if test is None:
            continue
        if not math.isfinite(test.p):
            out.print(f"{what}: too little to tell")
            continue
        contradicted = (
            "THE MODEL DOES NOT FIT the readings"
            if test is model.fitted
            else "THE CURVES ARE NOT THESE POLYNOMIALS: hysteresis that is not the same at all temperatures, a "
            "lag, or too few degrees"
        )
        verdict = contradicted if test.shown else "none shown at 1 %"
        against = "" if test is model.fitted else " against coefficients free at each temperature"
        out.print(f"{what}{against}: chi2 {test.chi2:.1f} for {test.dof}, p = {test.p:.2g}: {verdict}")
