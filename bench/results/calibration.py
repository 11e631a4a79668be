"""The result of `bench calibrate`: the twelve coefficients with their uncertainty, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from pydantic import ConfigDict, Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import ARCSEC, Floats, rms, u_of
from bench.base.languages import message, translated
from bench.base.numbers import fixed, places, scale_for, uncertainty
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.estimators import find_estimator
from bench.calibration.intrinsic import intrinsic_of
from bench.calibration.result import COVERAGE_FACTOR, NOT_DETERMINED, Calibration, Component, Triangular
from bench.model.geometry import COEFFICIENTS
from bench.results import parts
from bench.results.parts import (
    IntrinsicPart,
    JointPart,
    intrinsic_table,
    joint_in_words,
    joint_members,
    sign_in_words,
)


class ValueMs2Part(ResultModel):
    """A coefficient of K per m/s²."""

    value: float = Field(description="the estimate")
    u: Real = Field(description="standard uncertainty; null if the coefficient is zero by convention")


class PerMs2Part(ResultModel):
    """K per m/s²: K per g divided by `g_m_s2`, with the uncertainty of local gravity included in `u`."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ValueMs2Part]

    unit: str


class WidenedFitPart(parts.FitPart):
    """A test for lack of fit against the repeats, and the factor by which a lack of fit widens u."""

    birge: float = Field(description="factor on u because the model does not fit; 1 if it does")


class NoisePriorPart(ResultModel):
    """The prior of the noise, which is combined with the scatter of the readings."""

    reading_v: float = Field(description="stated standard deviation of a reading, unit of the signal")
    setting_arcsec: float
    dof: float
    """degrees of freedom of the scaled inverse chi-square distribution of each variance"""
    readings_dof: float = Field(description="degrees of freedom of the residuals")
    ratio: Real = Field(description="scatter of the readings divided by the stated noise; null if unknown")
    p: Real = Field(description="two-sided p-value of the ratio if the stated noise is true; null if unknown")
    from_: Literal["bench file", "other runs"] = Field(alias="from")


class DriftPart(ResultModel):
    """The drift of the biases during the run, relative to the mean of each bias."""

    hours: float
    rms: dict[str, float]
    per_hour: dict[str, float]


class NoisePart(parts.ChannelsPart):
    """Standard deviations of a single reading in each channel, and of errors that several readings share."""

    reading_v: float
    """standard deviation of a reading, unit of the signal: root mean square of the three channels"""
    p_equal: Real = Field(description="p-value for equal noise in all channels")
    p_tails: Real = Field(description="p-value for Gaussian noise, by the tails of the residuals")
    shared: list[Component] = Field(description="variance components of errors that several readings share")
    drift: DriftPart | None
    wander: parts.ChannelsPart | None
    """rms wander of each bias about its mean during the run, as found or as the readings permit; null if it
    was not estimated
    """
    setting_arcsec: float = Field(description="standard deviation of a setting of the head, arcsec")
    setting_limits_arcsec: list[Real] | None
    """95 % limits of the standard deviation of a setting, arcsec"""
    dof: Real = Field(description="degrees of freedom of the estimate; null if the noise was given")
    source: str = Field(description="where the values come from")
    prior: NoisePriorPart | None
    """the stated noise that was combined with the scatter of the readings; null if the readings alone
    determine the noise
    """


class OutlierPart(ResultModel):
    """A signal that disagrees with the model as fitted to the other readings."""

    row: int = Field(description="row of the table, from 1")
    series: int
    installation: str
    pass_number: int = Field(alias="pass")
    point: int
    channel: str = Field(description="`x`, `y`, `z`, `head` (a setting) or `modulus` (a free position)")
    size: float = Field(description="estimated error of the signal, in `unit`")
    unit: str
    sigma: float = Field(description="size over its standard uncertainty")
    weight: float = Field(description="weight that the signal keeps in the fit, 0 to 1")


class FreePositionPart(ResultModel):
    """A free position (of unknown orientation) in the fit, with the condition |a| = 1 g."""

    installation: str
    pass_number: int = Field(alias="pass")
    point: int
    delta_g: float = Field(description="|a| − 1, g")


class FreePositionsPart(ResultModel):
    """The free positions in the fit, with the condition |a| = 1 g."""

    used: int
    rms_g: float = Field(description="root mean square of |a| − 1 g over all free positions")
    rms_g_without_outliers: float
    rows: list[FreePositionPart]


class ArrayWithU(ResultModel):
    """A vector or matrix with standard uncertainties."""

    value: list[float] | Matrix
    u: list[float] | Matrix


class TriangularPart(ResultModel):
    """The nine numbers of a = T S (U - b), a in m/s², that free positions alone determine."""

    convention: str
    bias: ArrayWithU
    scale_ms2_per_unit: ArrayWithU
    T: ArrayWithU


class ConventionPart(ResultModel):
    """The convention for coefficients and signs that free positions alone do not determine."""

    zero: list[str] = Field(
        description="coefficients that are zero; their rows of `covariance` are zero, too"
    )
    signs: Literal["bench file", "positive"]
    """signs of the scale factors: those of the nominal ones in the bench file, or all positive"""


class CertificateReadPart(ResultModel):
    """The certificate from which the result was read (`bench certificate read`)."""

    number: str
    laboratory: str
    date: str


class PriorPart(ResultModel):
    """The prior from other units of the same type (`--prior`), and its effect on the result."""

    file: str
    type: str = Field(description="type of the units from which the prior was estimated")
    units: int = Field(description="number of units from which the prior was estimated")
    dof: int = Field(description="degrees of freedom of the prior")
    used: bool = Field(description="false if the prior contradicts the readings and was ignored")
    chi2: float = Field(description="chi-square of the twelve differences between readings and prior")
    p: float = Field(description="p-value of this chi-square")
    pull: dict[str, float]
    """for each coefficient, value from the readings minus prior, divided by the u of the difference"""
    u_without: dict[str, float] = Field(description="for each coefficient, its u without the prior")


class CalibrateResult(ResultModel):
    """The coefficients of U = K a + U0 with their uncertainty.

    For several sources, the output is a list of these; a source that could not be evaluated has a `source-failed`
    object in its place.
    """

    estimator: str = Field(description="name of the estimator")
    unit: str = Field(description="unit of the signals")
    g_m_s2: float = Field(description="local gravity, m/s²")
    per: str = Field(description="unit of acceleration of the coefficients: local g")
    equation: str = Field(default="", description="what the coefficients and their units mean, in a sentence")
    coefficients: dict[str, parts.CoefficientPart]
    """the twelve coefficients `Kxx`, `Kxy`, … `Kzz`, `U0x`, `U0y`, `U0z`, in unit/g and unit"""
    coefficients_per_ms2: PerMs2Part
    intrinsic: IntrinsicPart | None = None
    """the nine numbers that do not depend on the mounting; null if a channel is dead"""
    joint: dict[str, JointPart] = Field(default={})
    """coverage factors for all `twelve` and all `nine` numbers jointly"""
    order: list[str] = Field(description="names of the coefficients in the order of `covariance`")
    covariance: Matrix = Field(description="combined covariance of the coefficients, 12 × 12, in `order`")
    covariance_readings: parts.CovarianceOfReadings
    covariance_same_meters: Matrix
    """covariance without the errors that cancel if the same meters read the block later"""
    block_terms: Matrix
    """change of the coefficients by one standard uncertainty of each of the block's K2 and K3, a row for
    each; the same in every calibration of the block
    """
    gravity_u: float
    """relative standard uncertainty of local gravity; included only in `coefficients_per_ms2`"""
    sources: list[parts.UncertaintySourcePart]
    """sources of uncertainty that no reading shows"""
    stand: dict[str, parts.EstimatePart]
    """angles of the stand estimated from the readings, by name and installation"""
    effects: dict[str, parts.EstimatePart]
    """estimated parameters of the effects of the model file; absent without a model file"""
    temperature_effects: list[str] = Field(default=[])
    """effects of the model that remove the influence of temperature from the coefficients"""
    not_observable: list[str]
    """assumptions that these readings cannot test, and the error if they are wrong"""
    residual: WidenedFitPart
    fits: bool = Field(default=True, description="false if the readings contradict the model")
    noise: NoisePart
    readings: parts.ReadingsPart
    model: str = Field(description="name of the forward model")
    angles: str = Field(description="angles used: `read back` or `nominal`")
    outliers: list[OutlierPart]
    free_positions: FreePositionsPart | None
    triangular: TriangularPart | None
    by_convention: ConventionPart | None = None
    """what free positions alone do not determine; absent for readings with orientation"""
    source: str = Field(description="run or readings file")
    bench: parts.BenchPart | None = None
    """bench file used; null for a result read from a certificate"""
    made_at: str | None = Field(description="time of the readings (ISO 8601), if known")
    temperature_c: Real = None
    """mean temperature of the block in the fitted readings, °C; null if unknown"""
    holds_at_c: Real = None
    """temperature of the block at which the coefficients hold, °C: `temperature_c` or, for those that an effect of
    temperature in the model changes, its reference; null if unknown
    """
    unit_under_test: parts.UnitPart | None
    simulated: bool = Field(description="whether the instruments were simulated")
    meters: list[str] = Field(description="identity and connection of each voltmeter; empty if not recorded")
    corrections: parts.Corrections = Field(default=[])
    record: parts.RecordPart | None = Field(default=None, description="record of the run; absent for a file")
    prior: PriorPart | None = Field(default=None, description="prior from other units; absent if unused")
    certificate: CertificateReadPart | None = None
    """certificate from which the coefficients were read; absent for a calibration"""
    notes: list[str]
    skipped_rows: list[str] = Field(description="invalid rows that were skipped, each with the reason")


EQUATION: Final = (
    "U = K a + U0: rows of K are channels, columns axes of the block, x, y, z, right-handed; a is the specific "
    "force in local g (g_m_s2), +1 on an axis that points up; K in {unit}/g, U0 in {unit}; u: standard uncertainty "
    "(k = 1) with the errors of the readings, the stand and `sources`, as in `covariance`; U = k u"
)


def calibrate_result(found: Calibration, **made_from: Any) -> CalibrateResult:
    """Return a calibration's result; `made_from` has `temperature_effects` and fields from `source` on."""
    return CalibrateResult.from_object(
        found,
        per="g",
        equation=EQUATION.format(unit=found.unit),
        coefficients=parts.by_coefficient(
            parts.CoefficientPart,
            value=found.block.vector,
            u=found.determined(found.u),
            u_readings=found.determined(found.u_readings),
            U=found.determined(found.U),
            k=COVERAGE_FACTOR,
            dof=found.dof,
        ),
        coefficients_per_ms2=_per_ms2(found),
        **joint_members(found),
        order=COEFFICIENTS,
        block_terms=found.block_terms.T,
        sources=[parts.uncertainty_source(source) for source in found.sources],
        not_observable=found.assumed,
        residual=WidenedFitPart.from_object(found.lack_of_fit, birge=found.birge),
        fits=found.lack_of_fit.accepted(),
        noise=_noise(found),
        readings={"used": found.used, "skipped": found.skipped},
        free_positions=_free_positions(found),
        triangular=None if found.triangular is None else _triangular(found.triangular),
        **(
            {"by_convention": {"zero": found.zero_by_convention, "signs": found.signs}} if found.signs else {}
        ),
        **made_from,
    )


def _per_ms2(found: Calibration) -> dict[str, Any]:
    """Return K in unit/(m/s²), calculated from K per g and local g; its u includes those of both."""
    values = found.block.vector[:9]
    u = np.hypot(found.determined(found.u)[:9], values * found.gravity_u) / found.g_m_s2
    rows = parts.by_name(COEFFICIENTS[:9], ValueMs2Part, value=values / found.g_m_s2, u=u)
    return {"unit": f"{found.unit}/(m/s^2)", **rows}


def _noise(found: Calibration) -> NoisePart:
    noise, drift, limits = found.noise, found.drift, found.noise.setting_limits_rad
    prior = noise.prior
    return NoisePart.from_object(
        noise,
        reading_v=noise.reading,
        **parts.by_channel(noise.by_channel),
        p_tails=found.p_tails,
        shared=found.shared,
        drift=drift
        and DriftPart(
            hours=drift.hours, rms=parts.by_channel(drift.size), per_hour=parts.by_channel(drift.per_hour)
        ),
        wander=None if found.wander is None else parts.by_channel(found.wander),
        setting_arcsec=noise.setting_rad / ARCSEC,
        setting_limits_arcsec=None if limits is None else [limit / ARCSEC for limit in limits],
        prior=prior
        and NoisePriorPart.from_object(
            prior,
            reading_v=prior.reading,
            setting_arcsec=prior.setting_rad / ARCSEC,
            from_="bench file" if prior.stated else "other runs",
        ),
    )


def _free_positions(found: Calibration) -> dict[str, Any] | None:
    free = found.free
    if free is None:
        return None
    columns = (free.installation, free.pass_number, free.point, found.modulus_error)
    return {
        "used": len(free),
        "rms_g": rms(found.modulus_error),
        "rms_g_without_outliers": found.modulus_rms_g,
        "rows": [
            {"installation": installation, "pass": number, "point": point, "delta_g": error}
            for installation, number, point, error in zip(*(c.tolist() for c in columns), strict=True)
        ],
    }


def _triangular(found: Triangular) -> dict[str, Any]:
    def with_u(value: Floats, u: Floats) -> dict[str, Any]:
        return {"value": value.tolist(), "u": u.tolist()}

    return {
        "convention": "a = T S (u - b) in m/s^2, T unit upper triangular, S diagonal and positive",
        "bias": with_u(found.bias, found.u_bias),
        "scale_ms2_per_unit": with_u(found.scale, found.u_scale),
        "T": with_u(found.T, found.u_skew),
    }


# --- as text ----------------------------------------------------------------------------------------


def headline(name: str, found: Calibration) -> str:
    """Return a line with the name of the source, the estimator, the model and the number of readings."""
    readings = message(f"{len(found.fitted)} readings")
    if found.free is not None:
        readings = message(f"{len(found.fitted)} readings, {len(found.free)} by their modulus")
    if found.skipped:
        readings = message(f"{readings}, {found.skipped} bad rows skipped")
    return message(
        f"Calibration of {name}: {found.estimator}, model {found.model}, {readings}, "
        f"local g = {found.g_m_s2:.6g} m/s²"
    )


def coefficients_table(found: Calibration) -> Table:
    """Return a table of the coefficients with u, U (k = 2) and the u from the readings alone."""
    shown = table("coefficient", ">value", ">u", ">U (k=2)", ">u, readings", "")
    rows = (found.block.vector, found.u, found.U, found.u_readings)
    for name, *sizes in zip(COEFFICIENTS, *(row.tolist() for row in rows), strict=True):
        u = sizes[1]
        if name in found.zero_by_convention:
            shown.add_row(name, "0", "", "", "", NOT_DETERMINED)
            continue
        shown.add_row(
            name, *(fixed(size, places(u)) for size in sizes), parts.coefficient_unit(name, found.unit)
        )
    return shown


def sources_table(found: Calibration) -> Table:
    """Return a table of the error sources that readings do not show.

    A row names the coefficient in whose u the source has the largest part, and the contribution to this u.
    """
    shown = table("further contributions to u", ">u", "from", ">most", "in")
    for source in found.sources:
        u = u_of(source.covariance)
        if not np.any(u > 0):
            continue
        j = int(np.argmax(u / np.maximum(found.u, 1e-300)))
        name = COEFFICIENTS[j]
        size = scale_for(float(u[j]), found.unit)
        cost = f"{uncertainty(float(u[j]) / size.size)} {parts.coefficient_unit(name, size.unit)}"
        origin = translated(source.origin)
        if source.prior:
            origin = message(f"{origin} (prior)")
        shown.add_row(translated(source.name.replace("_", " ")), source.size, origin, cost, name)
    return shown


def print_calibration(name: str, found: Calibration, notes: Sequence[str], out: Console) -> None:
    """Print the coefficients, noise, fit, outliers, notes and assumptions."""
    out.print(headline(name, found))
    out.print(message(f"U = K a + U0, a the specific force in g (+1 g on an upward axis), U in {found.unit}"))
    out.print(coefficients_table(found))
    own = intrinsic_of(found)
    if own is not None:
        out.print(intrinsic_table(own))
        out.print(own.mounting)
        if sign := sign_in_words(found):
            out.print(sign)
    out.print(joint_in_words(found, own))
    if found.sources:
        out.print(sources_table(found))
    out.print(_noise_in_words(found))
    out.print(fit_in_a_line(found))
    for effect, value in found.effects.items():
        unit = "times" if value.unit == "1" else value.unit
        out.print(f"effect {effect} = {value.value:.4g} ± {value.u:.2g} {unit}")
    if find_estimator(found.estimator).drops_outliers and not found.outliers:
        out.print(message("outliers: none found"))
    for outlier in found.outliers:
        out.print(message(f"outlier: {outlier.text()}; its weight is 0"))
    if found.free is not None:
        rms_ug = found.modulus_rms_g * 1e6
        out.print(
            message(
                f"modulus of the free readings: {rms_ug:.3g} µg root mean square from 1 g"
                f"{', without the outliers' if found.outliers else ''}"
            )
        )
    print_notes(out, notes)
    for sentence in found.assumed:
        out.print(message(f"assumed: {sentence}"))


def _noise_in_words(found: Calibration) -> str:
    noise = found.noise
    scale = scale_for(noise.reading, found.unit)
    reading = message(
        f"noise (1 sigma, from {noise.source}): reading {noise.reading / scale.size:.3g} {scale.unit}"
    )
    if not len(found.fitted):
        return reading
    setting = f"{noise.setting_rad / ARCSEC:.2g} arcsec"
    if noise.setting_limits_rad is not None:
        low, high = (limit / ARCSEC for limit in noise.setting_limits_rad)
        setting += message(f" (95 %: {low:.2g} to {high:.2g})")
    return message(f"{reading}, setting of the head {setting}")


def fit_in_a_line(found: Calibration) -> str:
    """Return a line that states whether the model fits the readings, with the numbers of the test."""
    accepted = found.lack_of_fit.accepted()
    said = message("shown at 1 %") if accepted else message("THE MODEL DOES NOT FIT the readings")
    if found.birge > 1:
        said = message(f"{said}; u is {found.birge:.2g} times that of the noise")
    elif found.shared:
        said = message(f"{said}; u is widened for this misfit")
    return parts.fit_in_words(found.lack_of_fit, said)
