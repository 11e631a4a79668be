"""The result of a calibration: coefficients with covariance, and everything needed to judge them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from bench.base.arrays import Floats, HasCovariance, rms, u_of
from bench.base.computing import CalibrationError as CalibrationError  # noqa: PLC0414 - known by this name, too
from bench.base.languages import message
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.table import Readings
from bench.stats.repeats_likelihood import LEAST_DOF


class FaultyReadings(CalibrationError):
    """Raised if the readings, not the procedure, are the reason why there is no calibration."""


class SpoiledFit(FaultyReadings):
    """The error of a fit that a few wrong readings may have spoiled; `args` are the problem and advice."""

    def __str__(self) -> str:
        """Return the sentence."""
        return "; ".join(map(str, self.args))


class DeviatingReadings(SpoiledFit):
    """A `SpoiledFit` that names the readings that deviate strongly from the fit."""


@dataclass(frozen=True)
class SourceOfError:
    """An error source that the readings do not show.

    `covariance` (12, 12) is its part of the covariance of the coefficients. `size` is its standard uncertainty in
    words; `origin` says where this comes from; `prior` marks an uncertainty that nobody stated for this bench.
    `cancels` marks an error that cancels if the same meters read the block later. `of_block` (12, q) is set for an
    error of the block itself; column k is the change of the coefficients if the error's k-th independent component
    equals its standard uncertainty.
    """

    name: str
    symbol: str
    size: str
    origin: str
    prior: bool
    dof: float
    covariance: Floats
    cancels: bool = False
    of_block: Floats | None = None


BY_CONVENTION: Final = ("Kyx", "Kzx", "Kzy")
"""Coefficients that free positions alone do not determine: they are zero by convention."""

NOT_DETERMINED: Final = message("by convention, not determined")
"""What takes the place of the uncertainty of a number that is zero by convention."""

COVERAGE_FACTOR: Final = 2.0
"""Coverage factor k of U = k u."""

LACK_OF_FIT_P: Final = 0.01
"""P-value of the misfit below which a model does not fit the readings."""

NOT_ACCEPTED_P: Final = 1e-4
"""P-value below which no calibration is accepted: u widens with the misfit, but the cause is unknown."""

HARDLY_BETTER = 0.95
"""An estimate whose u exceeds this fraction of its prior u was not improved by the data."""


@dataclass(frozen=True)
class Estimate:
    """A fitted value with its standard uncertainty `u`, both in `unit`; `prior_u` is u before the fit."""

    value: float
    u: float
    unit: str
    prior_u: float = float("inf")

    @property
    def told_by_data(self) -> bool:
        """Whether the data reduced the uncertainty noticeably below that of the prior."""
        return self.u < HARDLY_BETTER * self.prior_u


@dataclass(frozen=True)
class NoisePrior:
    """The prior of the noise, and a test of the residuals against it.

    The standard deviations are `reading` (unit of the signal) and `setting_rad`; each variance has a scaled inverse
    chi-square distribution with `dof` degrees of freedom. The residuals have `readings_dof` degrees of freedom.
    `ratio` is the scatter of the residuals divided by the prior noise, `p` the two-sided p-value of this ratio
    (both NaN without degrees of freedom). `stated` is true for a prior from the bench file, false for one from
    other runs.
    """

    reading: float
    setting_rad: float
    dof: float
    readings_dof: float
    ratio: float
    p: float
    stated: bool

    @property
    def source(self) -> str:
        """The origin of noise that was estimated with this prior, in words."""
        where = "the bench file" if self.stated else "other runs"
        return f"residuals and {where}" if self.readings_dof > 0 else where


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the noise that is independent from reading to reading.

    `reading` (unit of the signal) acts on each channel of each reading. `setting_rad` acts on each setting of the
    head, common to its three channels; `setting_limits_rad` contain it with about 95 %. `dof` are the degrees of
    freedom of the estimate, counted in single signals; infinite if the noise was given. `source` says where the
    noise comes from. If the channels differ, `channels` are the standard deviations in x, y and z, `channel_dof`
    their degrees of freedom, and `reading` is their root mean square. `p_equal` is the p-value of the hypothesis
    that the channels have equal noise (NaN if not tested). `prior` is the prior used, or None. If the residuals
    needed no prior, `stated` is their test against the noise that the bench file states, or None.
    """

    reading: float
    setting_rad: float
    dof: float
    source: str
    setting_limits_rad: tuple[float, float] | None = None
    channels: tuple[float, float, float] | None = None
    channel_dof: tuple[float, float, float] | None = None
    p_equal: float = float("nan")
    prior: NoisePrior | None = None
    stated: NoisePrior | None = None

    @property
    def by_channel(self) -> Floats:
        """Standard deviations of the noise in x, y and z, shape (3,), equal if the channels do not differ."""
        return np.full(3, self.reading) if self.channels is None else np.array(self.channels)

    @property
    def reading_dof(self) -> float:
        """Degrees of freedom of the reading noise, counted in single signals.

        Two of three signals determine the reading noise and the third the setting error; if the setting error is
        zero, all three determine the noise. If the channels differ, the result is the mean of their degrees of
        freedom.
        """
        if self.channel_dof is not None:
            return float(np.mean(self.channel_dof))
        return 2 * self.dof / 3 if self.setting_rad > 0 else self.dof

    def widened(self) -> Noise:
        """Return the noise as it enters an uncertainty: widened for the degrees of freedom of the estimate.

        A standard deviation s, estimated with nu degrees of freedom, leads to a scaled t distribution, whose
        standard deviation is s sqrt(nu/(nu - 2)) (JCGM 101:2008, 6.4.9.4).
        """
        if np.isinf(self.dof):
            return self
        factor = widening(self.reading_dof)
        wider = replace(self, reading=factor * self.reading, setting_rad=factor * self.setting_rad)
        if self.channels is None or self.channel_dof is None:
            return wider
        x, y, z = (widening(nu) * size for nu, size in zip(self.channel_dof, self.channels, strict=True))
        return replace(wider, channels=(x, y, z), reading=rms(np.array([x, y, z])))


def widening(dof: float) -> float:
    """Return the factor sqrt(nu/(nu - 2)) that widens an estimated standard deviation.

    nu is `dof`, or `LEAST_DOF` if that is larger. Infinite degrees of freedom give 1.
    """
    nu = max(dof, LEAST_DOF)
    return 1.0 if np.isinf(nu) else float(np.sqrt(nu / (nu - 2)))


@dataclass(frozen=True)
class LackOfFit:
    """Test of a fit: the root mean square of its residuals, and the misfit beyond the scatter of repeats.

    `chi2` with `dof` degrees of freedom is this misfit in units of the scatter, `p` its p-value (F test); NaN
    without enough repeats. If the noise was given, the whole misfit is tested against it. For the closed form,
    `chi2` and `p` are those of the least-squares fit to the same readings: they judge the model, not the estimator.
    `rounding` is the rms residual that rounding leaves in noise-free readings; such a small `rms` is accepted.
    """

    rms: float
    chi2: float
    dof: int
    p: float
    rounding: float = 0.0

    @property
    def shown(self) -> bool:
        """Whether the lack of fit is significant; False if there is no test of it."""
        return self.p < LACK_OF_FIT_P

    def accepted(self, *, strict: bool = False) -> bool:
        """Return whether commands accept the coefficients, although the fit may have a lack of fit.

        They refuse if p < `NOT_ACCEPTED_P` (`strict`: `LACK_OF_FIT_P`), unless `rms` is at most `rounding`.
        """
        return self.rms <= self.rounding or not (self.shown if strict else self.p < NOT_ACCEPTED_P)

    def diagnose(self, source: str) -> tuple[str, ...]:
        """Return a sentence with the command that finds the cause; nothing if the fit is accepted.

        `source` is the name of the readings, as typed at a shell.
        """
        if self.accepted():
            return ()
        return (
            message(
                f"not accepted: the readings contradict the model (p < {NOT_ACCEPTED_P:g}); "
                f"'bench diagnose {source}' finds the mistake or the effect"
            ),
        )


@dataclass(frozen=True)
class Outlier:
    """A signal that contradicts the model and the other readings; it remains in the record.

    `row` counts the rows of the table from 1. `channel` is x, y, z, "head" for a wrong setting of the head,
    or "modulus" for a free position. `size` is the estimated error in `unit`, `sigma` this error divided by
    its u, and `weight` the weight that the signal keeps in the fit.
    """

    row: int
    series: int
    installation: str
    pass_number: int
    point: int
    channel: str
    size: float
    unit: str
    sigma: float
    weight: float = 0.0

    def text(self) -> str:
        """Return the outlier in words."""
        visit = "" if self.series == 1 else f"series {self.series}, "
        size = f"{self.size:+.3g} {self.unit}"
        return (
            f"row {self.row} ({visit}installation {self.installation}, pass {self.pass_number}, point "
            f"{self.point}), {self.channel}: off by {size}, {abs(self.sigma):.3g} sigma"
        )


@dataclass(frozen=True)
class Triangular:
    """The nine numbers of a = T S (U - b), a in m/s^2, with standard uncertainties.

    `T` (3, 3) is unit upper triangular. `scale` (3,) is the diagonal of S, in m/s^2 per unit of the signal;
    `bias` (3,) is b, in the unit of the signal.
    """

    bias: Floats
    scale: Floats
    T: Floats
    u_bias: Floats
    u_scale: Floats
    u_skew: Floats


@dataclass(frozen=True)
class Component:
    """A variance component: an error that several readings share.

    `size` is its standard deviation in `unit`: that of the signal, rad for an angle, or 1 for a gain. `what`
    is the kind ("setting", "pass", "visit" for a stay at a point, …), `channels` the channels concerned,
    `dof` the degrees of freedom of `size`. `p` is the p-value, adjusted for all candidate components; 0 for
    "rounding", which is computed from the last digit.
    """

    what: str
    channels: str
    size: float
    unit: str
    dof: float
    p: float


@dataclass(frozen=True)
class BiasWander:
    """Estimated drift of the biases about their means over a run of `hours`.

    `size` (3,) is its rms, in the unit of the signal. `course` (n, 3) has the estimated deviation of the biases at
    each reading; `per_hour` (3,) is the slope of a straight line through it.
    """

    size: Floats
    course: Floats
    per_hour: Floats
    hours: float


@dataclass(frozen=True)
class Calibration(HasCovariance):
    """The result of a calibration: the twelve coefficients, their covariance, residuals and notes.

    `covariance` (12, 12), in the order of `COEFFICIENTS`, is the combined covariance; it includes the errors
    `sources` that no reading shows. `covariance_readings` is the part due to the readings and the stated stand
    errors. K is in unit/g with g = `g_m_s2`, biases are in unit. `gravity_u`, the relative u of gravity, is in
    neither covariance: K is per local g. `dof` (12,) are effective degrees of freedom.

    `stand` holds the estimated stand angles ("alpha1[1]"), `effects` the fitted parameters of effects. `fitted` are
    the oriented readings used. `residuals` (n, 3) are measured minus fitted signals, with stand angles and effects
    at their estimates. `free` are the readings used by their modulus only, `modulus_error` (m,) their |a| - 1, g.
    `outliers` have no weight in the estimate.

    `gain` (12, N, 3) is the linear map from the N rows of the whole table to the coefficients. `slope` (N, 3) is
    du/dphi, zero for rows that are not oriented. `shared` are the variance components that readings share. `drift`
    is a significant drift of the biases, or None; `wander` (3,) is as in `SharedErrorFit`. `birge` is the factor
    that widened u for a lack of fit, `p_tails` the p-value of heavy tails.

    `triangular` is set for free positions alone; `signs` says whether the signs of their scale factors come from
    the "bench file" or are all "positive". `assume` returns the sentences of `assumed`. `unseen` returns changes
    (12, d) of the coefficients, of relative size 1, that the readings do not show: only limits of the stand confine
    them. `notes` are sentences for the user.
    """

    estimator: str
    unit: str
    g_m_s2: float
    block: Block
    covariance: Floats
    covariance_readings: Floats
    gain: Floats
    slope: Floats
    noise: Noise
    lack_of_fit: LackOfFit
    fitted: Readings
    residuals: Floats
    skipped: int
    model: str
    stand: Mapping[str, Estimate] = field(default_factory=dict)
    effects: Mapping[str, Estimate] = field(default_factory=dict)
    assume: Callable[[], tuple[str, ...]] = tuple
    unseen: Callable[[], Floats] = lambda: np.zeros((12, 0))
    free: Readings | None = None
    modulus_error: Floats = field(default_factory=lambda: np.zeros(0))
    outliers: tuple[Outlier, ...] = ()
    notes: tuple[str, ...] = ()
    triangular: Triangular | None = None
    signs: str = ""
    angles: str = "read back"
    shared: tuple[Component, ...] = ()
    drift: BiasWander | None = None
    wander: Floats | None = None
    birge: float = 1.0
    p_tails: float = float("nan")
    sources: tuple[SourceOfError, ...] = ()
    dof: Floats = field(default_factory=lambda: np.full(12, np.inf))
    gravity_u: float = 0.0

    @property
    def zero_by_convention(self) -> tuple[str, ...]:
        """Names of the coefficients that are zero by convention; empty unless free positions are used alone."""
        return BY_CONVENTION if self.triangular is not None else ()

    def determined(self, u: Floats) -> Floats:
        """Return uncertainties `u` (12,) with NaN for the coefficients that are zero by convention."""
        return np.where(np.isin(COEFFICIENTS, self.zero_by_convention), np.nan, u)

    @property
    def u_readings(self) -> Floats:
        """Standard uncertainties (12,) from these readings and the stated stand errors alone."""
        return u_of(self.covariance_readings)

    @property
    def U(self) -> Floats:  # noqa: N802 - the symbol of the field
        """Expanded uncertainties k u (12,) with k = `COVERAGE_FACTOR`; u is widened for finite dof."""
        return COVERAGE_FACTOR * self.u

    @property
    def covariance_same_meters(self) -> Floats:
        """Combined covariance (12, 12) without the errors that cancel in later readings with the same meters."""
        return self.covariance - sum((s.covariance for s in self.sources if s.cancels), np.zeros((12, 12)))

    @property
    def block_terms(self) -> Floats:
        """Changes of the coefficients by the errors of the block (nonlinearities K2 and K3), shape (12, q).

        Column k is the change if the k-th independent error equals its standard uncertainty.
        """
        parts = [s.of_block for s in self.sources if s.of_block is not None]
        return np.concatenate([np.zeros((12, 0)), *parts], axis=1)

    @cached_property
    def assumed(self) -> tuple[str, ...]:
        """Sentences on assumptions that these data cannot test, each with the effect of a wrong assumption."""
        return self.assume()

    @property
    def used(self) -> int:
        """Number of readings in the fit, oriented and free."""
        return len(self.fitted) + len(self.modulus_error)

    @property
    def temperatures_c(self) -> Floats:
        """Known temperatures of the block at the readings in the fit, oriented and free, °C."""
        tables = [self.fitted, *([] if self.free is None else [self.free])]
        known = np.concatenate([table.temperature_c for table in tables])
        return np.asarray(known[np.isfinite(known)])

    @property
    def modulus_rms_g(self) -> float:
        """Root mean square of |a| - 1 over the free readings that are not outliers, g; NaN if there are none."""
        if self.free is None:
            return float("nan")
        out = {(o.series, o.installation, o.pass_number, o.point) for o in self.outliers}
        of = self.free
        columns = (of.series, of.installation, of.pass_number, of.point)
        places = zip(*(column.tolist() for column in columns), strict=True)
        kept = np.array([place not in out for place in places])
        return rms(self.modulus_error[kept])


# --- what is derived from the coefficients --------------------------------------------------------


INVERSE: Final = (
    "Nxx", "Nxy", "Nxz", "Nyx", "Nyy", "Nyz", "Nzx", "Nzy", "Nzz", "U0x", "U0y", "U0z",
)  # fmt: skip
"""Names of the twelve numbers of a = N (U - U0), in the order of every vector and table."""

MISALIGNMENTS: Final = {
    "alpha_yx": ("Kxy", "Kxx", 1.0),
    "alpha_zx": ("Kxz", "Kxx", -1.0),
    "alpha_xy": ("Kyx", "Kyy", -1.0),
    "alpha_zy": ("Kyz", "Kyy", 1.0),
    "alpha_xz": ("Kzx", "Kzz", 1.0),
    "alpha_yz": ("Kzy", "Kzz", -1.0),
}
"""Misalignment angles by name: their K_ij, their K_ii and the sign (-1)^n.

Source: the paper, K_ij = (-1)^n K_ii alpha_ji, n = 2 if j follows i in x -> y -> z -> x, else 1. So alpha_ji is the
right-hand turn of the input axis of channel i about the third axis, in the plane of i and j.
"""


@dataclass(frozen=True)
class Derived(HasCovariance):
    """Numbers computed from the coefficients: their `names` (m), `values` (m,) and `covariance` (m, m).

    `jacobian` (m, 12) are the derivatives of the values by `COEFFICIENTS`; the default is the identity.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    jacobian: Floats = field(default_factory=lambda: np.eye(len(COEFFICIENTS)))


def inverse(block: Block, covariance: Floats) -> Derived:
    """Return the twelve numbers of a = N (U - U0), `INVERSE`, from a block and its covariance (12, 12).

    N is in g per unit of the signal, U0 in that unit. Raises `numpy.linalg.LinAlgError` when K is singular.
    """
    N = np.asarray(np.linalg.inv(block.K), dtype=np.float64)
    slopes = inverse_jacobian(N)
    values = np.concatenate([N.ravel(), block.U0]) + 0.0  # no zero is negative
    return Derived(INVERSE, values, through(slopes, covariance), slopes)


def inverse_jacobian(N: Floats) -> Floats:
    """Return the derivatives (12, 12) of `INVERSE` by `COEFFICIENTS`.

    They are dN_ij/dK_kl = -N_ik N_lj and dU0_i/dU0_i = 1; all others are 0.
    """
    jacobian = np.eye(len(COEFFICIENTS))
    jacobian[:9, :9] = -np.kron(N, N.T)
    return jacobian


def misalignments(block: Block, covariance: Floats) -> Derived:
    """Return the six angles `MISALIGNMENTS`, rad, from a block and its covariance (12, 12)."""
    vector = block.vector
    values, rows = np.zeros(len(MISALIGNMENTS)), np.zeros((len(MISALIGNMENTS), len(COEFFICIENTS)))
    for row, (cross, own, sign) in enumerate(MISALIGNMENTS.values()):
        ij, ii = COEFFICIENTS.index(cross), COEFFICIENTS.index(own)
        values[row] = sign * vector[ij] / vector[ii]
        rows[row, ij] = sign / vector[ii]
        rows[row, ii] = -values[row] / vector[ii]
    return Derived(tuple(MISALIGNMENTS), values + 0.0, through(rows, covariance), rows)


def through(jacobian: Floats, covariance: Floats) -> Floats:
    """Return the covariance (m, m) of linear combinations: J C J^T for `jacobian` J (m, n), exactly symmetric."""
    found = jacobian @ covariance @ jacobian.T
    return np.asarray(0.5 * (found + found.T))
