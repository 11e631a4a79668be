"""Results as text in the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.analysis.calibration import Calibration, Noise, Verification
from bench.analysis.calibration.estimators import find_estimator
from bench.analysis.calibration.verification import COVERAGE_FACTOR, GUARDED
from bench.base.numbers import fixed, places, scale_for
from bench.cli.source import Source
from bench.model.block import COEFFICIENTS


def console(*, json: str | None = None) -> Console:
    """Return the console for results; wide enough that no table is cut when the output is a file.

    Where `json` goes to standard output ("-"), what is written for a person goes to standard error.
    """
    aside = json == "-"
    out = Console(highlight=False, soft_wrap=True, markup=False, stderr=aside)
    if out.is_terminal:
        return out
    return Console(highlight=False, soft_wrap=True, markup=False, stderr=aside, width=120)


def calibration(
    source: Source,
    result: Calibration,
    doubts: tuple[str, ...],
    file: Path | None,
    out: Console | None = None,
) -> None:
    """Print the coefficients, the noise and the fit; `doubts` say why the block may not be the one announced."""
    out = out or console()
    readings = f"{len(result.fitted)} readings"
    if result.free is not None:
        readings += f", {len(result.free)} by their modulus"
    if result.skipped:
        readings += f", {result.skipped} bad rows skipped"
    out.print(
        f"Calibration of {source.name}: {result.estimator}, model {result.model}, {readings}, "
        f"local g = {result.g_m_s2:.6g} m/s²"
    )
    out.print(f"U = K a + U0, a the specific force in g (+1 g on an upward axis), U in {result.unit}")
    out.print(coefficient_table(result))
    fit = result.lack_of_fit
    noise = result.noise
    scale = scale_for(noise.reading, result.unit)
    setting = f", setting of the head {np.degrees(noise.setting_rad) * 3600:.2g} arcsec{_limits(noise)}"
    out.print(
        f"noise (1 sigma, from {noise.source}): reading {noise.reading / scale.size:.3g} {scale.unit}"
        + (setting if len(result.fitted) else "")
    )
    if np.isfinite(fit.p):
        verdict = "none shown at 1 %" if fit.p >= 0.01 else "THE MODEL DOES NOT FIT the readings"
        out.print(
            f"lack of fit against the repeats: chi2 {fit.chi2:.1f} for {fit.dof}, p = {fit.p:.2g}: {verdict}"
        )
    else:
        out.print("lack of fit: too few repeats to tell")
    for name, value in result.effects.items():
        out.print(f"effect {name} = {value.value:.4g} ± {value.u:.2g} {value.unit}")
    if find_estimator(result.estimator).drops_outliers and not result.outliers:
        out.print("outliers: none found")
    for outlier in result.outliers:
        out.print(f"outlier: {outlier.text()}; it has no weight")
    if result.free is not None:
        without = ", without the outliers" if result.outliers else ""
        rms_ug = result.modulus_rms_g * 1e6
        out.print(f"modulus of the free readings: {rms_ug:.3g} µg root mean square from 1 g{without}")
    for note in (*doubts, *result.notes, *source.readings.notes, *source.readings.skipped):
        out.print(f"note: {note}")
    for sentence in result.assumed:
        out.print(f"assumed: {sentence}")
    if file is not None:
        written("result", file, out)


def coefficient_table(result: Calibration) -> Table:
    """Return the coefficients with u and U (k = 2), rounded to two digits of u."""
    table = Table(box=None, pad_edge=False)
    for heading, side in (
        ("coefficient", "left"),
        ("value", "right"),
        ("u", "right"),
        ("U (k=2)", "right"),
        ("", "left"),
    ):
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for name, value, u in zip(COEFFICIENTS, result.block.vector, result.u, strict=True):
        if value == 0.0 and u == 0.0:
            table.add_row(name, "0", "", "", "by convention")
            continue
        digits = places(float(u))
        unit = result.unit if name.startswith("U0") else f"{result.unit}/g"
        table.add_row(name, fixed(value, digits), fixed(u, digits), fixed(2 * u, digits), unit)
    return table


def _limits(noise: Noise) -> str:
    """Between which values the setting error lies, where the repeats tell."""
    if noise.setting_limits_rad is None:
        return ""
    low, high = (np.degrees(limit) * 3600 for limit in noise.setting_limits_rad)
    return f" (95 %: {low:.2g} to {high:.2g})"


def verification(source: Source, result: Verification, file: Path | None, out: Console | None = None) -> None:
    """Print Δg at each verification point and the verdict."""
    out = out or console()
    table = Table(box=None, pad_edge=False)
    guarded = ["accepted up to"] if result.rule == GUARDED else []
    for heading in ("verification point", "angle", "Δg", "u", *guarded, ""):
        table.add_column(heading, justify="left" if heading in {"verification point", ""} else "right")
    for p in result.points:
        limit = f"{p.accepted_up_to * 1e6:.1f} µg" if p.accepted_up_to > 0 else "nothing"
        table.add_row(
            f"pass {p.pass_number} point {p.point}",
            f"{p.angle_deg:.4f}°",
            f"{p.delta_g * 1e6:+.1f} µg",
            f"{p.u * 1e6:.1f} µg",
            *([limit] if guarded else []),
            "within" if p.passed else "in the guard band" if abs(p.delta_g) <= result.limit_g else "OUTSIDE",
        )
    out.print(table)
    for note in (*source.readings.notes, *source.readings.skipped):
        out.print(f"note: {note}")
    if file is not None:
        written("result", file, out)
    verdict(source.name, result, out)


def verdict(name: str, result: Verification, out: Console | None = None) -> None:
    """Print the verdict in one line."""
    worst = max(result.points, key=lambda p: abs(p.delta_g))
    missing = f"; {result.missing} verification points are missing" if result.missing else ""
    rule = result.rule + (
        f" (U, k = {COVERAGE_FACTOR:g}, taken off the limit)" if result.rule == GUARDED else ""
    )
    (out or console()).print(
        f"{name}: {'PASSED' if result.passed else 'FAILED'}: worst |Δg| = {abs(worst.delta_g) * 1e6:.1f} µg "
        f"± {worst.u * 1e6:.1f} µg (u), limit {result.limit_g * 1e6:.0f} µg, rule: {rule}{missing}",
        style="bold",
    )


def written(what: str, file: Path, out: Console | None = None) -> None:
    """Say where a file was written."""
    (out or console()).print(f"{what}: {file}")
