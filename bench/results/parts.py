"""Parts that several results share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Annotated, Any, Final, TypeVar

from pydantic import Field

from bench.base.arrays import CHANNELS, Floats, u_of
from bench.base.languages import message
from bench.base.result_model import Matrix, Real, ResultModel
from bench.calibration.result import LackOfFit, SourceOfError
from bench.model.geometry import COEFFICIENTS

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
