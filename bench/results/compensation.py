"""The result of `bench compensate`: polynomials of temperature and a compensation table, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats, u_of
from bench.base.numbers import fixed, places, scale_for
from bench.base.result_model import Matrix, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.result import INVERSE, SourceOfError
from bench.calibration.temperature import (
    CompensationTable,
    PlateauResult,
    TemperatureModel,
    ThermalHysteresis,
    approximation,
)
from bench.calibration.verification import Verification
from bench.model.geometry import COEFFICIENTS
from bench.results import parts
from bench.results.verification import VerdictPart, verdict_line, verdict_members

HYSTERESIS_P: Final = 0.05


class TermPart(parts.ValuePart):
    """A term of a polynomial in temperature, in unit/g/K^power or unit/K^power."""

    power: int


class PolynomialPart(ResultModel):
    """A coefficient as a polynomial in T - T_ref: the temperature minus the reference temperature."""

    degree: int
    terms: list[TermPart]


class DifferencePart(parts.ValuePart):
    """The difference of a coefficient between rising and falling temperature."""

    p_all_looks: float = Field(description="p-value corrected for the number of coefficients compared")


class HysteresisPart(ResultModel):
    """The thermal hysteresis of the coefficients: rising minus falling at the same temperature."""

    rising_minus_falling: dict[str, DifferencePart]
    p: float = Field(description="p-value of all twelve differences together")


class PlateauPart(ResultModel):
    """A temperature plateau, with the coefficients estimated from its readings alone."""

    temperature_c: float
    branch: Literal[-1, 0, 1] = Field(description="1 if the temperature rose, -1 if it fell, 0 if neither")
    readings: int
    coefficients: dict[str, parts.ValuePart] | None
    """coefficients at this temperature; null if its readings alone do not determine them"""


class ThermalNoisePart(ResultModel):
    """The noise as standard deviations: of a reading (unit of the signal) and of a setting of the head."""

    reading: float
    setting_rad: float


class ApproximationPart(ResultModel):
    """The errors of the table as an approximation of the polynomials."""

    interpolation_bias_g: float = Field(description="error of interpolation at 0 g, g")
    interpolation_per_g: float = Field(description="additional error for each g of acceleration, g")
    single_precision_g: float = Field(description="error of single-precision arithmetic up to `up_to_g`, g")
    up_to_g: float
    temperatures_checked: int


class TablePart(ResultModel):
    """The compensation table: N = K⁻¹ and U0 at equally spaced temperatures."""

    first_c: float
    step_k: float
    entries: list[str]
    rows: Matrix
    approximation: ApproximationPart


class VerdictAtPart(VerdictPart):
    """The verdict of the verification at one temperature."""

    temperature_c: float


class CompensateResult(ResultModel):
    """The coefficients as polynomials of temperature, with the compensation table."""

    unit: str
    g_m_s2: float
    reference_c: float
    valid_c: list[float]
    coefficients: dict[str, PolynomialPart]
    order: list[tuple[str, int]] = Field(description="coefficient and power, in the order of `covariance`")
    covariance: Matrix
    covariance_readings: parts.CovarianceOfReadings
    uncertainty_sources: list[parts.UncertaintySourcePart]
    """sources of uncertainty that the readings do not show, for the terms at the reference temperature"""
    hysteresis: HysteresisPart | None
    plateaus: list[PlateauPart]
    noise: ThermalNoisePart
    lack_of_fit: parts.FitPart
    curve: parts.FitPart | None
    """test of the polynomials against separate fits by temperature"""
    readings: parts.ReadingsPart
    notes: list[str]
    table: TablePart
    check: Matrix
    """check vectors: temperature, °C, three signals, and the three accelerations that the table gives, g"""
    python: list[str] = Field(description="three lines of Python that test the file named as their argument")
    verification: list[VerdictAtPart]
    sources: list[str]
    bench: parts.BenchPart
    corrections: parts.Corrections
    simulated: bool


def compensate_result(
    model: TemperatureModel,
    *,
    of_readings: Floats,
    hidden: Sequence[SourceOfError],
    shown: CompensationTable,
    checks: Sequence[tuple[float, Verification]],
    **made_from: Any,
) -> CompensateResult:
    """Return the result of a temperature model.

    `of_readings` is the part of the covariance that comes from the readings. `hidden` are the error sources
    that the readings do not show. `checks` holds pairs of a temperature (°C) and its verification.
    `made_from` has the fields `check` and `python`, and all fields from `sources` on.
    """
    u, count = u_of(model.covariance).reshape(model.values.shape), model.values.shape[1]
    return CompensateResult.from_object(
        model,
        valid_c=[model.minimum_c, model.maximum_c],
        coefficients={
            name: {
                "degree": int(model.degrees[j]),
                "terms": [
                    {"power": d, "value": float(model.values[j, d]), "u": float(u[j, d])}
                    for d in range(count)
                ],
            }
            for j, name in enumerate(COEFFICIENTS)
        },
        order=[(name, d) for name in COEFFICIENTS for d in range(count)],
        covariance_readings=of_readings,
        uncertainty_sources=[parts.uncertainty_source(source) for source in hidden],
        hysteresis=model.hysteresis and _hysteresis(model.hysteresis),
        plateaus=[_plateau(plateau) for plateau in model.plateaus],
        lack_of_fit=model.fitted,
        readings={"used": model.readings, "skipped": model.skipped},
        table=table_part(shown),
        verification=[
            VerdictAtPart.from_object(check, **verdict_members(check), temperature_c=t) for t, check in checks
        ],
        **made_from,
    )


def table_part(shown: CompensationTable) -> TablePart:
    """Return the part of the result on a compensation table."""
    return TablePart.from_object(
        shown, entries=INVERSE, rows=shown.entries.astype(np.float64), approximation=approximation(shown)
    )


def _hysteresis(found: ThermalHysteresis) -> dict[str, Any]:
    differences = parts.by_coefficient(DifferencePart, found, value=found.size, p_all_looks=found.p_each)
    return {"rising_minus_falling": differences, "p": found.p}


def _plateau(plateau: PlateauResult) -> PlateauPart:
    value, u = plateau.value, plateau.u
    coefficients = (
        None if value is None or u is None else parts.by_coefficient(parts.ValuePart, value=value, u=u)
    )
    return PlateauPart.from_object(plateau, coefficients=coefficients)


# --- as text ----------------------------------------------------------------------------------------


def print_compensation(
    model: TemperatureModel, shown: CompensationTable, names: Sequence[str], out: Console
) -> None:
    """Print the polynomials, the hysteresis, the lack of fit, and the errors that the table adds."""
    out.print(
        f"Temperature model of {', '.join(names)}: {model.readings} readings, {model.minimum_c:.1f} to "
        f"{model.maximum_c:.1f} °C, about {model.reference_c:g} °C"
    )
    out.print(f"U = K(T) a + U0(T), a the specific force in g (+1 g on an upward axis), U in {model.unit}")
    out.print(_coefficient_table(model))
    _print_hysteresis(model, out)
    _print_fit(model, out)
    error = shown.error
    out.print(
        f"table: {shown.nodes} temperatures, every {shown.step_k:.3g} K; interpolation adds at most "
        f"{error.bias * 1e6:.2g} µg and {error.per_g * 1e6:.2g} µg for each g, single precision "
        f"{error.single * 1e6:.2g} µg up to {error.reach_g:g} g"
    )
    print_notes(out, model.notes)


def print_checks(checks: Sequence[tuple[float, Verification]], out: Console) -> None:
    """Print the verdict of the verification at each temperature."""
    for t, check in checks:
        out.print(verdict_line(f"verification at {t:.1f} °C", check), style="bold")


def _coefficient_table(model: TemperatureModel) -> Table:
    """Return a table of value and slope at the reference temperature, and the span over temperature."""
    shown = table(
        "coefficient", ">at the reference", ">u", ">per K there", ">u", ">degree", ">over the range", ""
    )
    u = u_of(model.covariance).reshape(model.values.shape)
    swept = model.coefficients(np.linspace(model.minimum_c, model.maximum_c, 101))
    for j, name in enumerate(COEFFICIENTS):
        value, slope = model.values[j, :2]
        digits, slope_digits = places(float(u[j, 0])), places(float(u[j, 1]))
        shown.add_row(
            name,
            fixed(value, digits),
            fixed(u[j, 0], digits),
            fixed(slope, slope_digits),
            fixed(u[j, 1], slope_digits),
            str(model.degrees[j]),
            fixed(float(np.ptp(swept[:, j])), digits),
            parts.coefficient_unit(name, model.unit),
        )
    return shown


def _print_hysteresis(model: TemperatureModel, out: Console) -> None:
    found = model.hysteresis
    if found is None:
        return
    scale = scale_for(float(abs(found.size).max()), model.unit)
    single = [
        f"{name} {size / scale.size:+.2g} ± {u / scale.size:.2g}"
        for name, size, u, p in zip(COEFFICIENTS, found.size, found.u, found.p_each, strict=True)
        if p < HYSTERESIS_P
    ]
    which = (
        f"{', '.join(single)} ({scale.unit}/g, biases in {scale.unit})" if single else "no single coefficient"
    )
    verdict = f"shown: {which}" if found.p < HYSTERESIS_P else "none shown"
    out.print(f"hysteresis, rising minus falling: {verdict} (p = {found.p:.2g} for all twelve)")
    if found.p < HYSTERESIS_P:
        out.print(
            "  the uncertainty includes half of it in both directions, because a user of the table does not "
            "know the direction"
        )


def _print_fit(model: TemperatureModel, out: Console) -> None:
    out.print(
        parts.fit_in_words(
            model.fitted,
            "THE MODEL DOES NOT FIT the readings",
            untold=f"{parts.REPEATS}: too few data to tell",
        )
    )
    if model.curve is not None:
        what = "polynomials against coefficients free at each temperature"
        contradicted = (
            "THE CURVES ARE NOT THESE POLYNOMIALS: hysteresis that varies with temperature, a lag, or a "
            "degree that is too low"
        )
        out.print(parts.fit_in_words(model.curve, contradicted, what, "polynomials: too few data to tell"))
