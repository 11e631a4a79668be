"""compensate: from a run over several temperatures to polynomials, and to tables for a computer on board."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.analysis.calibration import Verification, verify
from bench.analysis.temperature.estimate import temperature_model
from bench.analysis.temperature.model import TemperatureModel
from bench.analysis.temperature.table import CompensationTable, make_table
from bench.analysis.temperature.table_files import c_header, table_csv, table_json
from bench.base.numbers import fixed, places, scale_for
from bench.cli import CommandError, printing
from bench.cli.source import Request, Source, check_target, load_sources, to_text, write_beside, write_json
from bench.model.block import COEFFICIENTS

SIDES = {1: "rising", -1: "falling", 0: "first"}
FITS_P = 0.01
HYSTERESIS_P = 0.05


def compensate(
    request: Request,
    reference_c: float,
    degree: str,
    step_k: float | None,
    target: str | None,
    *,
    strict: bool,
) -> int:
    """Carry out `bench compensate`; all sources are one body of readings, of one block on one bench.

    1 when a verification point fails at its temperature; with `strict` also when the polynomials do not fit.
    """
    check_target(target)
    sources = load_sources(request)
    first = sources[0]
    strangers = [source.name for source in sources if source.g_m_s2 != first.g_m_s2]
    if strangers:
        raise CommandError(
            f"{', '.join(strangers)}: another local gravity than in {first.name}; "
            "a temperature model is made on one bench"
        )
    tables = [source.readings for source in sources]
    model = temperature_model(tables, first.model, first.stand_u, first.g_m_s2, reference_c, _degree(degree))
    table = make_table(model, first.bench.unit_under_test.range, step_k)
    checks = [check for source in sources for check in _verified(source, model)]
    result = {
        **model.to_json(),
        "table": table_json(table),
        "verification": [{"temperature_c": t, **check.to_json()} for t, check in checks],
        "sources": [source.name for source in sources],
        "simulated": any(source.simulated for source in sources),
    }
    files = _write(first, model, table, result)
    out = printing.console(json=target)
    _print(model, table, [source.name for source in sources], out)
    for t, check in checks:
        printing.verdict(f"verification at {t:.1f} °C", check, out)
    for what, file in files.items():
        printing.written(what, file, out)
    write_json([result], target)
    passed = all(check.passed for _, check in checks)
    return 0 if passed and (fits(model) or not strict) else 1


def fits(model: TemperatureModel) -> bool:
    """Whether neither the fit nor the curve over temperature is contradicted by the readings."""
    tests = [model.fitted] + ([model.curve] if model.curve else [])
    return not any(test.p < FITS_P for test in tests)


def _degree(text: str) -> int | None:
    if text == "auto":
        return None
    if text.isdecimal() and 1 <= int(text) <= 6:
        return int(text)
    raise CommandError(f"--degree {text}: expected 'auto', or a whole number from 1 to 6")


def _verified(source: Source, model: TemperatureModel) -> list[tuple[float, Verification]]:
    """Judge the verification points of a source, each at its own temperature; those within the range only."""
    rows = source.readings.verification()
    known = np.isfinite(rows.temperature_c) & ~model.outside(rows.temperature_c)
    limit = source.bench.verification_limit_g
    judged = []
    for t in np.unique(rows.temperature_c[known]):
        own = source.readings.select(
            (source.readings.installation == "V") & (source.readings.temperature_c == t)
        )
        noise = model.noise.reading
        judged.append((float(t), verify(own, model.block(t), model.covariance_at(t), noise, limit)))
    return judged


def _write(
    source: Source, model: TemperatureModel, table: CompensationTable, result: dict[str, Any]
) -> dict[str, Path]:
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
        if write_beside(source.output("compensate", suffix), text, asked=asked)
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
    for note in model.notes:
        out.print(f"note: {note}")


def _coefficient_table(model: TemperatureModel) -> Table:
    """Each coefficient at the reference, its slope there, and how far it goes over the range."""
    table = Table(box=None, pad_edge=False)
    for heading in ("coefficient", "at the reference", "u", "per K there", "u", "degree", "over the range"):
        table.add_column(heading, justify="left" if heading == "coefficient" else "right")
    table.add_column("")
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
    hysteresis = model.hysteresis
    if hysteresis is None:
        return
    scale = scale_for(float(np.max(np.abs(hysteresis.size))), model.unit)
    shown = [
        f"{name} {size / scale.size:+.2g} ± {u / scale.size:.2g}"
        for name, size, u, p in zip(
            COEFFICIENTS, hysteresis.size, hysteresis.u, hysteresis.p_each, strict=True
        )
        if p < HYSTERESIS_P
    ]
    told = (
        f"{', '.join(shown)} ({scale.unit}/g, biases in {scale.unit})" if shown else "no single coefficient"
    )
    verdict = f"shown: {told}" if hysteresis.p < HYSTERESIS_P else "none shown"
    out.print(f"hysteresis, rising minus falling: p = {hysteresis.p:.2g} for all twelve: {verdict}")
    if hysteresis.p < HYSTERESIS_P:
        out.print(
            "  half of it either way is in the uncertainty: a reader of the table does not know the side"
        )


def _print_fit(model: TemperatureModel, out: Console) -> None:
    for what, test in (("lack of fit against the repeats", model.fitted), ("polynomials", model.curve)):
        if test is None:
            continue
        if not np.isfinite(test.p):
            out.print(f"{what}: too little to tell")
            continue
        contradicted = (
            "THE MODEL DOES NOT FIT the readings"
            if test is model.fitted
            else "THE CURVES ARE NOT THESE POLYNOMIALS: hysteresis that is not the same at all temperatures, a "
            "lag, or too few degrees"
        )
        verdict = contradicted if test.p < FITS_P else "none shown at 1 %"
        against = "" if test is model.fitted else " against coefficients free at each temperature"
        out.print(f"{what}{against}: chi2 {test.chi2:.1f} for {test.dof}, p = {test.p:.2g}: {verdict}")
