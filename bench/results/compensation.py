"""Results of `bench tumble` (IEEE Std 1293) and `bench compensate` (coefficients over temperature): JSON, text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import ARCSEC, Floats, u_of
from bench.base.languages import message
from bench.base.numbers import fixed, places, probability, quantity, scale_for
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.budget.whole import OF_BLOCK
from bench.calibration.result import INVERSE, SourceOfError
from bench.calibration.temperature import (
    CompensationTable,
    PlateauResult,
    TemperatureModel,
    ThermalHysteresis,
    approximation,
)
from bench.calibration.tumble import HOMES, K, TumbleView, parameter_of
from bench.calibration.verification import Verification
from bench.model.geometry import COEFFICIENTS
from bench.results import parts
from bench.results.parts import (
    BenchPart,
    Corrections,
    CovarianceOfReadings,
    FitPart,
    UnitPart,
    ValuePart,
    fit_in_words,
)
from bench.results.verification import VerdictPart, verdict_line, verdict_members

CLOSE: Final = 0.95
"""Correlation above which two terms are reported as hard to separate."""


class QuantityPart(ValuePart):
    """An estimated term of an accelerometer.

    `u` is the combined standard uncertainty if the result is `combined`, otherwise the part from the readings.
    """

    U: float = Field(description="expanded uncertainty, k u")
    unit: str
    u_readings: float = Field(description="part of u from the readings and the stated errors of the stand")
    contains: dict[str, float]
    """terms that cannot be separated from this one, with their shares; the estimate is the sum (for K1,
    shares are relative)
    """


class AxisPart(ResultModel):
    """The accelerometer of one channel."""

    quantities: dict[str, QuantityPart]
    """K0 (bias of a, U0/K1), K1 (scale factor K_ii with its sign), the two misalignment angles α_ji (rad), and the
    requested nonlinear terms that are determined. K_ij = K_ii α_ji for ij = xy, yz, zx, else −K_ii α_ji
    """
    rank: int = Field(description="number of `terms` that the orientations determine")
    terms: list[str] = Field(description="requested terms, linear ones first")
    not_separable: dict[str, dict[str, float]]
    """terms that are not estimated, and the change of the others if such a term is 1; empty if no reading
    shows it
    """
    left_out: dict[str, dict[str, float]]
    """terms of the standard's model that are not fitted, and the change of the others if such a term is 1"""


class TumbleNoisePart(ResultModel):
    """The standard deviations of a reading and of a setting of the head, and their source."""

    reading_v: float
    setting_arcsec: float
    dof: Real
    source: str


class AbovePart(ResultModel):
    """Points above 1 g in the fit, and their chi-square when compared with the fit at 1 g alone."""

    points: int
    largest_g: float
    chi2: float
    dof: int
    p: float


class TumbleResult(ResultModel):
    """The accelerometers of a multi-point tumble by the terms of IEEE Std 1293.

    For several sources, the output is a list of these.
    """

    unit: str
    g_m_s2: float
    k: float = Field(description="coverage factor of U")
    model: str
    axes: dict[str, AxisPart] = Field(description="results for each channel")
    order: list[str] = Field(description="channel and name of each quantity, in the order of `covariance`")
    combined: bool = Field(
        description="whether u and `covariance` include every source of the bench that acts on the readings"
    )
    covariance: Matrix = Field(description="covariance of all quantities of the three channels")
    covariance_readings: CovarianceOfReadings
    noise: TumbleNoisePart
    residual: FitPart
    above_1g: AbovePart | None = Field(description="centrifuge points in the fit")
    readings: int
    source: str
    bench: BenchPart
    made_at: str | None
    unit_under_test: UnitPart | None
    simulated: bool
    corrections: Corrections
    notes: list[str] = Field(description="remarks for the reader, and rows that were skipped")


def tumble_result(view: TumbleView, **made_from: Any) -> TumbleResult:
    """Return the result of a tumble; `made_from` has the fields of `TumbleResult` from `source` on."""
    return TumbleResult.from_object(
        view,
        k=K,
        model="E/K1 = K0 + a_i + cross-axis terms + K2 a_i^2 + K3 a_i^3 + Koq a_i |a_i| + ..., a in g",
        axes={
            own.channel: AxisPart.from_object(
                own,
                quantities={q.name: QuantityPart.from_object(q, U=K * q.u) for q in view.axes[own.channel]},
                terms=own.asked,
                not_separable=own.inseparable,
                left_out=view.left_out[own.channel],
            )
            for own in view.judged
        },
        order=view.names,
        noise=TumbleNoisePart.from_object(
            view.noise, reading_v=view.noise.reading, setting_arcsec=view.noise.setting_rad / ARCSEC
        ),
        residual=view.lack_of_fit,
        above_1g=view.above,
        readings=len(view.fitted),
        **made_from,
    )


def print_tumble(view: TumbleView, name: str, on: Console) -> None:
    """Print the terms of each accelerometer, what the orientations determine, and the lack of fit."""
    on.print(f"Tumble of {name}: {len(view.fitted)} readings, local g = {view.g_m_s2:.6g} m/s²")
    on.print(
        f"E/K1 = K0 + a_i + cross-axis terms + K2 a_i² + K3 a_i³ + Koq a_i |a_i| + …, a in g, E in {view.unit}"
    )
    on.print(_table(view))
    for own in view.judged:
        on.print(own.sentence())
    for first, second, r in _close(view):
        on.print(
            message(
                f"{first} and {second} are correlated (r = {r:.3f}): their sum is known far better than each"
            )
        )
    on.print(fit_in_words(view.lack_of_fit, message("THESE TERMS DO NOT FIT the readings")))
    if view.above is not None:
        on.print(
            f"{view.above.points} points up to {view.above.largest_g:.3g} g "
            f"{'agree with' if view.above_agrees else 'CONTRADICT'} the readings at 1 g: "
            f"chi-square {view.above.chi2:.1f} for {view.above.dof} ({probability(view.above.p)})"
        )
    print_notes(on, list(_left_out(view)))


def _table(view: TumbleView) -> Table:
    """Return a table of the terms, rounded to two digits of u; angles are in arcsec, terms in g in µg."""
    shown = table("", "", ">value", ">u", ">U (k=2)", ">u, readings", "")
    for channel, quantities in view.axes.items():
        for q in quantities:
            times, unit = 1.0, q.unit
            if q.unit == "rad":
                times, unit = 1.0 / ARCSEC, "arcsec"
            elif q.name != "K1" and q.unit.split("/")[0] == "g":
                times, unit = 1e6, _micro(q.unit)
            digits = places(times * q.u)
            cells = (fixed(times * size, digits) for size in (q.value, q.u, 2 * q.u, q.u_readings))
            shown.add_row(channel, q.words, *cells, unit)
    return shown


def _micro(unit: str) -> str:
    """Return the printed form of a millionth of a unit in g: "g/g^2" -> "µg/g²"."""
    return unit.replace("g", "µg", 1).replace("^2", "²").replace("^3", "³")


def _close(view: TumbleView) -> Iterator[tuple[str, str, float]]:
    """Yield each pair of nonlinear terms of a channel that are hard to separate, with their correlation."""
    for channel, own in view.axes.items():
        terms = [f"{channel}.{q.name}" for q in own if q.name in HOMES]
        for n, first in enumerate(terms):
            for second in terms[n + 1 :]:
                r = view.correlation(first, second)
                if abs(r) > CLOSE:
                    yield first, second, r


def _left_out(view: TumbleView) -> Iterator[str]:
    """Yield a sentence on each term that was not fitted, and on how far it shifts the other terms."""
    for channel, by_term in view.left_out.items():
        for term, moved in by_term.items():
            if moved:
                in_u = view.combined and term in OF_BLOCK
                unit = _micro(parameter_of(term).unit.replace("ug", "g"))
                others = ", ".join(f"{name} {fixed(by, 2, sign=True)}" for name, by in moved.items())
                yield message(
                    f"{'not fitted, but included in u,' if in_u else 'assumed zero'} in channel {channel}: "
                    f"1 {unit} of {term} changes {others}"
                )


# --- coefficients over temperature --------------------------------------------------------------------

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
    covariance: Matrix = Field(
        description="12 × 12, covariance of the coefficients at any temperature, as the user does not know the "
        "direction: add it to that of the terms; rows in the order of `coefficients`"
    )


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
    accepted: bool = Field(description="whether the fit, the polynomials and all verifications are accepted")
    made_at: str | None = Field(description="time of the first source (ISO 8601), if known")
    unit_under_test: parts.UnitPart | None
    equation: str = Field(description="what the terms and their units mean, in a sentence")
    uncertainty: str = Field(
        description="what u and `covariance` contain, and what they do not, in a sentence"
    )
    per_kelvin_g: float
    """the most that an error of 1 K of a later temperature changes a at 1 g, in g; u does not contain this error"""


EQUATION: Final = (
    "U = K(T) a + U0(T), a the specific force in local g, +1 on an axis that points up; each coefficient is the "
    "sum of value (T - reference_c)^power, T the temperature of the block in deg C; K in {unit}/g, U0 in {unit}, "
    "per K^power"
)
INCLUDED: Final = (
    "u is a standard uncertainty (k = 1) of a term; the covariance of the coefficients at T is J covariance J^T, J "
    "the powers of T - reference_c, plus hysteresis.covariance; it includes the error of the calibration's "
    "temperatures, and excludes that of T (per_kelvin_g) and the noise of U"
)


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
        equation=EQUATION.format(unit=model.unit),
        uncertainty=INCLUDED,
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
    return {"rising_minus_falling": differences, "p": found.p, "covariance": found.scatter}


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
    out.print(
        f"u of a at 1 g: at most {quantity(model.largest_u_g, 'g')}, without the error of the later temperature, "
        f"1 K of which changes a by up to {quantity(model.per_kelvin_g, 'g')}"
    )
    print_notes(out, model.notes)


def print_checks(checks: Sequence[tuple[float, Verification]], out: Console) -> None:
    """Print the verdict of the verification at each temperature."""
    for t, check in checks:
        out.print(verdict_line(message(f"verification at {t:.1f} °C"), check), style="bold")


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
    which = message("no single coefficient")
    if single:
        which = message(f"{', '.join(single)} ({scale.unit}/g, biases in {scale.unit})")
    verdict = message(f"shown: {which}") if found.p < HYSTERESIS_P else message("none shown")
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
            message("THE MODEL DOES NOT FIT the readings"),
            untold=f"{parts.REPEATS}: too few data to tell",
        )
    )
    if model.curve is not None:
        what = message("polynomials against coefficients free at each temperature")
        contradicted = message(
            "THE CURVES ARE NOT THESE POLYNOMIALS: hysteresis that varies with temperature, a lag, or a "
            "degree that is too low"
        )
        out.print(
            parts.fit_in_words(model.curve, contradicted, what, message("polynomials: too few data to tell"))
        )
