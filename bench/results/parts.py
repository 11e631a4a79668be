"""Parts that several results share; the nine numbers that do not depend on the mounting, as text and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import numpy as np
from pydantic import Field
from rich.table import Table

from bench.base.arrays import CHANNELS, Floats, u_of
from bench.base.languages import message
from bench.base.numbers import fixed, places, scale_for, uncertainty
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import table
from bench.calibration.intrinsic import (
    JOINT_LEVEL,
    Intrinsic,
    JointFactor,
    intrinsic_of,
    intrinsic_unit,
    joint_factor,
)
from bench.calibration.result import COVERAGE_FACTOR, Calibration, LackOfFit, SourceOfError
from bench.model.geometry import COEFFICIENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Part = TypeVar("Part", bound=ResultModel)


def by_name(names: Sequence[str], part: type[Part], of: object = None, /, **columns: Any) -> dict[str, Part]:
    """Return a `part` (a model class) for each of m names.

    Each of the `columns` has the values (m,) of one member, or one value for all names. Members without a
    column are taken from the attributes (m,) of the object `of`.
    """
    columns |= {
        name: getattr(of, name) for name in part.model_fields if name not in columns and hasattr(of, name)
    }
    whole = [value if isinstance(value, Iterable) else [value] * len(names) for value in columns.values()]
    rows = zip(names, zip(*whole, strict=True), strict=True)
    return {name: part(**dict(zip(columns, row, strict=True))) for name, row in rows}


by_coefficient: Final = partial(by_name, COEFFICIENTS)
"""`by_name` for the twelve coefficients."""


REPEATS: Final = message("lack of fit against the repeats")
TOO_FEW: Final = message("lack of fit: too few repeats to tell")


def fit_in_words(fit: LackOfFit, contradicted: str, what: str = REPEATS, untold: str = TOO_FEW) -> str:
    """Return the outcome of a test for lack of fit as text: its numbers and, if it is significant, `contradicted`.

    `what` names the test. If there are too few repeats for a test, the text is `untold`.
    """
    if not math.isfinite(fit.p):
        return untold
    verdict = contradicted if fit.shown else message("none shown at 1 %")
    return message(f"{what}: chi2 {fit.chi2:.1f} for {fit.dof}, p = {fit.p:.2g}: {verdict}")


# --- sources of a result ------------------------------------------------------------------------------


class BenchPart(ResultModel):
    """The bench file that was used, and the reason for its choice."""

    name: str = Field(description="name that the bench file states")
    file: str = Field(description="path of the bench file")
    why: str = Field(description="why this bench file was used")
    sha256: str

    @property
    def words(self) -> str:
        """The name of the bench, and the reason for the choice of its file."""
        return f"{self.name}, {self.why}"


class CorrectionPart(ResultModel):
    """The certificate of an instrument, and whether the readings were corrected by it."""

    instrument: str = Field(description="name of the instrument in the bench file")
    certificate: str = Field(description="number of the certificate")
    laboratory: str
    date: str = Field(description="date of the calibration, such as 2026-03-02")
    valid_until: str | None
    expired: bool = Field(description="whether the certificate had expired on the day of the readings")
    serial: str | None = Field(description="serial number that the certificate states")
    serial_answered: str | None
    """serial number that the instrument stated; empty if it states none, null if not recorded"""
    correction: str = Field(description="value that is added to what the instrument shows; empty if none")
    applied: bool = Field(description="whether the readings were corrected by the certificate")
    why_not: str = Field(description="why the readings were not corrected; empty if they were")


Corrections = Annotated[
    list[CorrectionPart],
    Field(description="certificates of the instruments and their corrections; empty if there are none"),
]


class UnitPart(ResultModel):
    """The unit under test: a block."""

    type: str = Field(description="type of the block")
    serial: str = Field(description="serial number of the block")


class RecordPart(ResultModel):
    """What identifies a run's record: the number of events, and the hash of the last event."""

    events: int
    head: str = Field(description="SHA-256 of the last line, which depends on all lines before it")


class FailedPart(ResultModel):
    """A source that could not be evaluated; in a list of results, this takes the place of its result."""

    source: str = Field(description="source as named on the command line")
    problem: str = Field(description="why it could not be evaluated, a sentence")


# --- estimates --------------------------------------------------------------------------------------


class ValuePart(ResultModel):
    """A value with its standard uncertainty."""

    value: float = Field(description="the estimate")
    u: float = Field(description="standard uncertainty of the value")


class EstimatePart(ValuePart):
    """An estimate of a parameter, and whether the readings improved on its prior."""

    unit: str
    told_by_data: bool = Field(description="whether the readings reduced its prior uncertainty")


class CoefficientPart(ResultModel):
    """One of the twelve coefficients, in unit/g or, for a bias, in the unit of the signals.

    All uncertainties are null for a coefficient that is zero by convention and not determined.
    """

    value: float = Field(description="the estimate")
    u: Real = Field(description="combined standard uncertainty of the value")
    u_readings: Real = Field(description="part of u from the readings and the stated errors of the stand")
    U: Real = Field(description="expanded uncertainty, k u")
    k: float
    dof: Real = Field(description="effective degrees of freedom, by which u is widened; null: infinite")


class FitPart(ResultModel):
    """A test for lack of fit against the repeats."""

    rms: Real = Field(description="root mean square of the residuals, unit of the signal")
    chi2: Real
    dof: int
    p: Real = Field(description="probability of a chi-square at least as large")


class ReadingsPart(ResultModel):
    """The numbers of readings used and skipped."""

    used: int = Field(description="number of readings in the fit")
    skipped: int = Field(description="number of invalid rows skipped")


class ChannelsPart(ResultModel):
    """A value for each channel."""

    x: float
    y: float
    z: float


CovarianceOfReadings = Annotated[
    Matrix, Field(description="covariance from the readings and the stated errors of the stand")
]


class UncertaintySourcePart(ResultModel):
    """A source of uncertainty that does not show in the readings."""

    name: str = Field(description="name of the error, as in `bench budget`")
    symbol: str
    size: str = Field(description="standard uncertainty in words")
    origin: str = Field(description="where the size comes from")
    prior: bool = Field(description="true for a plausible size that the bench file does not state")
    dof: Real = Field(description="degrees of freedom; null: infinite")
    u: dict[str, float] = Field(description="contribution to the standard uncertainty of each coefficient")
    cancels_with_the_same_meters: bool


def uncertainty_source(source: SourceOfError) -> UncertaintySourcePart:
    """Return the part of the result on an error source that the readings do not show."""
    u = named(u_of(source.covariance))
    return UncertaintySourcePart.from_object(source, u=u, cancels_with_the_same_meters=source.cancels)


def named(values: Floats) -> dict[str, float]:
    """Return values (12,) as a dictionary by coefficient name."""
    return dict(zip(COEFFICIENTS, values.tolist(), strict=True))


def by_channel(values: Floats) -> dict[str, float]:
    """Return values (3,) as a dictionary by channel name."""
    return dict(zip(CHANNELS, values.tolist(), strict=True))


def coefficient_unit(name: str, unit: str) -> str:
    """Return the unit of a coefficient for signals in `unit`: "V/g" for "Kxx", "V" for "U0x"."""
    return unit if name.startswith("U0") else f"{unit}/g"


# --- the nine numbers that do not depend on the mounting -------------------------------------------------


_POINTS: Final = 90


class IntrinsicValuePart(CoefficientPart):
    """One of the nine numbers; `u` is the combined standard uncertainty."""

    unit: str = Field(description="unit of the signal per g, deg, or g")


class IntrinsicPart(ResultModel):
    """The nine numbers that do not depend on the mounting: sensitivities, angles between the sensing axes, offsets.

    S_i = ‖row i of K‖, cos θ_ij = row_i·row_j/(S_i S_j), b_i = U0_i/S_i. b_i has the sign of the signal: where K_ii
    is negative, the bias of a, K0 of `bench tumble`, is −b_i.
    """

    values: dict[str, IntrinsicValuePart]
    """`Sx`, `Sy`, `Sz`, `theta_xy`, `theta_xz`, `theta_yz`, `bx`, `by`, `bz`"""
    order: list[str] = Field(description="names of the nine in the order of `covariance`")
    covariance: Matrix = Field(description="combined covariance, 9 × 9, in the units of the values")
    covariance_readings: CovarianceOfReadings
    held_by_limits: list[str]
    """numbers that follow from the limits of the bench file because these readings do not determine them"""
    mounting: str = Field(description="what the mounting can change, a sentence")


class JointPart(ResultModel):
    """The joint coverage factor k: an ellipsoid of half-widths k u holds all true values jointly (95 %)."""

    count: int = Field(description="number of values with an uncertainty")
    k: float = Field(description="joint coverage factor: √(p F(p, dof)), or √χ²(p) for infinite dof")
    dof: float | None = Field(description="smallest effective degrees of freedom; null: infinite")
    level: float = Field(description="coverage probability")


def intrinsic_part(own: Intrinsic) -> IntrinsicPart:
    """Return the nine intrinsic numbers as the part `intrinsic` of the result."""
    units = [intrinsic_unit(name, own.unit) for name in own.names]
    values = by_name(own.names, IntrinsicValuePart, own, value=own.values, k=COVERAGE_FACTOR, unit=units)
    return IntrinsicPart.from_object(own, values=values, order=own.names, held_by_limits=own.held)


def joint_part(u: Floats, dof: Floats) -> JointPart:
    """Return the part on the joint coverage factor that `joint_of` returns."""
    found = joint_of(u, dof)
    return JointPart.from_object(found, dof=found.dof if np.isfinite(found.dof) else None)


def joint_of(u: Floats, dof: Floats, level: float = JOINT_LEVEL) -> JointFactor:
    """Return the joint coverage factor of numbers with `u` (m,) above 0, for their smallest `dof` (m,)."""
    known = u > 0
    return joint_factor(int(np.sum(known)), float(np.min(dof[known], initial=np.inf)), level)


def joint_members(found: Calibration) -> dict[str, Any]:
    """Return the members `intrinsic` and `joint` of the result of a calibration."""
    own = intrinsic_of(found)
    joint = {"twelve": joint_part(found.u, found.dof)}
    if own is None:
        return {"intrinsic": None, "joint": joint}
    return {"intrinsic": intrinsic_part(own), "joint": {**joint, "nine": joint_part(own.u, own.dof)}}


# --- as text and pictures -----------------------------------------------------------------------------


def shown_rows(own: Intrinsic) -> list[list[str]]:
    """Return the cells for each number: name, value, unit of value, u from the readings, u, U, unit of these u."""
    rows = []
    for name, value, *sizes in zip(own.names, own.values, own.u_readings, own.u, own.U, strict=True):
        unit = intrinsic_unit(name, own.unit)
        factor, small = small_unit(name, float(sizes[1]), own.unit)
        of_value = [name, fixed(float(value), places(float(sizes[1]))), "°" if unit == "deg" else unit]
        rows.append([*of_value, *(uncertainty(float(size) / factor) for size in sizes), small])
    return rows


def small_unit(name: str, u: float, unit: str) -> tuple[float, str]:
    """Return the printed unit for differences of about `u` in the number `name`: its size and its symbol.

    The size is in `unit`/g for a sensitivity, in degrees for an angle, in g for an offset.
    """
    if name.startswith("theta"):
        return 1.0 / 3600.0, "″"
    scale = scale_for(u, unit if name.startswith("S") else "g")
    return scale.size, scale.per_g if name.startswith("S") else scale.unit


def intrinsic_table(own: Intrinsic) -> Table:
    """Return a table of the nine intrinsic numbers with u, U (k = 2) and the u from the readings alone."""
    shown = table("mounting-free", ">value", "", ">u", ">U (k=2)", ">u, readings", "")
    for name, value, unit, of_readings, u, U, small in shown_rows(own):
        shown.add_row(name, value, unit, u, U, of_readings, small)
    return shown


def sign_in_words(found: Calibration) -> str:
    """Return a sentence on the sign of b in channels with a negative scale factor; empty if there are none."""
    negative = [channel for channel, own in zip(CHANNELS, np.diag(found.block.K), strict=True) if own < 0]
    where = ", ".join(negative)
    return where and message(
        f"b has the sign of the signal: where the scale factor is negative ({where}), the bias of a is −b"
    )


def joint_in_words(found: Calibration, own: Intrinsic | None) -> str:
    """Return the joint coverage factors in a sentence."""
    sizes = [(found.u, found.dof), *([] if own is None else [(own.u, own.dof)])]
    said = [
        message(f"k = {joint.k:.3f} for all {joint.count}")
        for joint in (joint_of(u, dof) for u, dof in sizes)
    ]
    return message(f"jointly at 95 %: {', '.join(dict.fromkeys(said))} (ellipsoid)")


def ellipses(own: Intrinsic) -> str:
    """Return plots of the joint 95 % ellipsoid of the nine numbers, projected on pairs; dashed: their U (k = 2)."""
    from bench.results.plots import BLUE, GREY, svg_figure, symbol

    joint, turn = joint_of(own.u, own.dof), np.linspace(0.0, 2.0 * np.pi, _POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)])

    def draw(figure: Figure) -> None:
        grid = figure.subplots(3, 3)
        for row, first in enumerate((0, 3, 6)):
            for column, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
                pair = [first + i, first + j]
                scales = [small_unit(own.names[at], float(own.u[at]), own.unit) for at in pair]
                size = np.array([scale for scale, _ in scales])
                root = np.linalg.cholesky(own.covariance[np.ix_(pair, pair)]) / size[:, None]
                outline, U = joint.k * root @ circle, own.U[pair] / size
                axes = grid[row, column]
                axes.plot(outline[0], outline[1], color=BLUE)
                axes.plot(
                    U[0] * np.array([-1, 1, 1, -1, -1]), U[1] * np.array([-1, -1, 1, 1, -1]),
                    color=GREY, linestyle="--", linewidth=0.8,
                )  # fmt: skip
                axes.set_xlabel(f"{symbol(own.names[pair[0]])} / {scales[0][1]}")
                axes.set_ylabel(f"{symbol(own.names[pair[1]])} / {scales[1][1]}")

    return svg_figure(
        "ellipses", (7.4, 6.4), draw, message("The joint 95 % ellipsoid of the nine, as shadows on pairs")
    )
