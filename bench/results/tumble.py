"""The result of `bench tumble`: each accelerometer by the terms of IEEE Std 1293, as JSON and as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import ARCSEC
from bench.base.numbers import fixed, places, probability
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.budget.whole import OF_BLOCK
from bench.calibration.tumble import HOMES, K, TumbleView, parameter_of
from bench.results.parts import (
    BenchPart,
    Corrections,
    CovarianceOfReadings,
    FitPart,
    UnitPart,
    ValuePart,
    fit_in_words,
)

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
    """K0 (bias), K1 (scale factor), the two misalignment angles with the sign of the paper, and the requested
    nonlinear terms that are determined
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


# --- as text ----------------------------------------------------------------------------------------


def print_tumble(view: TumbleView, name: str, on: Console) -> None:
    """Print the terms of each accelerometer, what the orientations determine, and the lack of fit."""
    on.print(f"Tumble of {name}: {len(view.fitted)} readings, local g = {view.g_m_s2:.6g} m/s²")
    on.print(
        "E/K1 = K0 + a_i + cross-axis terms + K2 a_i² + K3 a_i³ + Koq a_i |a_i| + …, a in g, E in "
        + view.unit
    )
    on.print(_table(view))
    for own in view.judged:
        on.print(own.sentence())
    for first, second, r in _close(view):
        on.print(
            f"{first} and {second} are correlated (r = {r:.3f}): their sum is known far better than each"
        )
    on.print(fit_in_words(view.lack_of_fit, "THESE TERMS DO NOT FIT the readings"))
    if view.above is not None:
        agree = "agree with" if view.above_agrees else "CONTRADICT"
        on.print(
            f"{view.above.points} points up to {view.above.largest_g:.3g} g {agree} the readings at 1 g: "
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
                said = (
                    "not fitted, but included in u," if view.combined and term in OF_BLOCK else "assumed zero"
                )
                unit = _micro(parameter_of(term).unit.replace("ug", "g"))
                others = ", ".join(f"{name} by {fixed(by, 2, sign=True)}" for name, by in moved.items())
                yield f"{said} in channel {channel}: 1 {unit} of {term} moves {others}"
