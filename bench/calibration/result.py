"""What a calibration returns: coefficients with covariance, and everything needed to judge them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from bench.base.arrays import Floats, HasCovariance, rms, u_of
from bench.base.computing import CalibrationError as CalibrationError  # noqa: PLC0414 - known by this name, too
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.table import Readings
from bench.stats.repeats_likelihood import LEAST_DOF


@dataclass(frozen=True)
class SourceOfError:
    """An error source that the readings do not show, with its `covariance` (12, 12) of the coefficients.

    `size` is its size in words, `origin` the source of this size; `prior` marks one not stated for this
    bench. `cancels` marks an error that is equal wherever the same meters read the block. `of_block` (12, q)
    is for an error of the block itself: the change of the coefficients by each draw of size u.
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


COVERAGE_FACTOR: Final = 2.0
"""Coverage factor k of U = k u."""

LACK_OF_FIT_P: Final = 0.01
"""Least p-value of the misfit with which a model fits the readings."""

NOT_ACCEPTED_P: Final = 1e-4
"""P-value below which no calibration is accepted: u widens with the misfit, but the cause is unknown."""

HARDLY_BETTER = 0.95
"""Ratio of u after the data to u before them, from which the data have not improved an estimate."""


@dataclass(frozen=True)
class Estimate:
    """A value with its standard uncertainty, both in `unit`; `prior_u` is its u before the data."""

    value: float
    u: float
    unit: str
    prior_u: float = float("inf")

    @property
    def told_by_data(self) -> bool:
        """Whether the data reduced the uncertainty noticeably."""
        return self.u < HARDLY_BETTER * self.prior_u


@dataclass(frozen=True)
class NoisePrior:
    """Prior sizes of the noise, which count beside the readings.

    Each variance has a scaled inverse chi-square distribution about its size: `reading` (unit of the signal) and
    `setting_rad`, 1 sigma, with `dof` degrees of freedom. `readings_dof` are those of the residuals;
    `ratio` is their scatter over the stated noise, with the two-sided probability `p` of being so far from
    1 (NaN where they leave no degree of freedom). Sizes that are not `stated` are those of other runs.
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
        """Source, in words, of noise sizes estimated with this prior."""
        where = "the bench file" if self.stated else "other runs"
        return f"residuals and {where}" if self.readings_dof > 0 else where


@dataclass(frozen=True)
class Noise:
    """Sizes of the noise that is independent at each reading, 1 sigma.

    `reading` (unit of the signal) is fresh in each channel of each reading, `setting_rad` in each setting
    of the head and common to its three channels. `dof` are the degrees of freedom of the estimate (counted
    in single signals), infinite when given. `source` says where the sizes come from. `setting_limits_rad` are
    the values between which the setting error lies with about 95 %: repeats often tell little of it.
    `channels` are the sizes in x, y, z where they are not of one size, with degrees of freedom `channel_dof`;
    `reading` is their root mean square. `p_equal` is the probability of such a difference where all three are of
    one size (NaN where not tested). `prior` is what was stated and counts beside too few readings, else None.
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

    @property
    def by_channel(self) -> Floats:
        """Sizes in x, y and z, shape (3,): `reading` where they were not told apart."""
        return np.full(3, self.reading) if self.channels is None else np.array(self.channels)

    @property
    def reading_dof(self) -> float:
        """Degrees of freedom of the reading noise: two of three signals show it, the third the setting.

        Without a known setting all three show it; channels with sizes of their own have the mean of theirs.
        """
        if self.channel_dof is not None:
            return float(np.mean(self.channel_dof))
        return 2 * self.dof / 3 if self.setting_rad > 0 else self.dof

    def widened(self) -> Noise:
        """Return the sizes as they enter an uncertainty: larger where they are estimates themselves.

        An estimate s with nu degrees of freedom stands for a scaled t distribution, whose standard deviation
        is s sqrt(nu/(nu - 2)) (JCGM 101:2008, 6.4.9.4).
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
    """Return sqrt(nu/(nu - 2)), the factor that widens a size with nu (at least `LEAST_DOF`) dof."""
    nu = max(dof, LEAST_DOF)
    return 1.0 if np.isinf(nu) else float(np.sqrt(nu / (nu - 2)))


@dataclass(frozen=True)
class LackOfFit:
    """Residuals of the fit: their root mean square, and the part that repeats cannot explain.

    `chi2` with `dof` is the misfit beyond the scatter of repeats, in units of that scatter; `p` is
    the probability of a larger one (F test against the scatter). NaN where there are not enough repeats.
    Where the noise was given, all that is left is compared with it. The closed form has `chi2` and `p` of
    the least squares on the same readings: they judge the model, not the estimator. `rounding` is the
    residual from the rounding of readings without noise, which no model can explain.
    """

    rms: float
    chi2: float
    dof: int
    p: float
    rounding: float = 0.0

    @property
    def shown(self) -> bool:
        """Whether a lack of fit is shown; what cannot be judged shows none."""
        return self.p < LACK_OF_FIT_P

    def accepted(self, *, strict: bool = False) -> bool:
        """Return whether commands accept the coefficients; with `strict` no lack of fit may be shown."""
        return self.rms <= self.rounding or not (self.shown if strict else self.p < NOT_ACCEPTED_P)

    def diagnose(self, source: str) -> tuple[str, ...]:
        """Return hints at the cause if the fit is not accepted; nothing if it is."""
        if self.accepted():
            return ()
        return (
            f"not accepted: the readings contradict the model (p < {NOT_ACCEPTED_P:g}); 'bench diagnose {source}' "
            "finds which mistake or which effect it is",
        )


@dataclass(frozen=True)
class Outlier:
    """A signal that the model and the other readings contradict; it keeps its place in the record.

    `row` counts the rows of the table from 1; `channel` is x, y, z, "head" for a setting that was off by
    `size`, or "modulus" for a free position. `sigma` is the size over its standard uncertainty, `weight` what
    is left of the signal's weight in the fit.
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

    `T` (3, 3) is unit upper triangular, `scale` (3,) the diagonal of S in m/s^2 per unit, `bias` (3,) in the
    unit of the signal.
    """

    bias: Floats
    scale: Floats
    T: Floats
    u_bias: Floats
    u_scale: Floats
    u_skew: Floats


@dataclass(frozen=True)
class Component:
    """A variance that readings share; `size` is its standard deviation in the unit of the signal, rad of an angle.

    `what` says what shares it, `channels` in which; `dof` are its degrees of freedom, and `p` is the probability
    that chance alone asks for any component as much.
    """

    what: str
    channels: str
    size: float
    unit: str
    dof: float
    p: float


@dataclass(frozen=True)
class BiasWander:
    """How far the biases wander about their mean over the run: `size` (3,) rms in the unit, over `hours`.

    `course` (n, 3) is the estimate at each reading, `per_hour` (3,) the slope of its best line.
    """

    size: Floats
    course: Floats
    per_hour: Floats
    hours: float


@dataclass(frozen=True)
class Calibration(HasCovariance):
    """The result of a calibration: the twelve coefficients, their covariance, residuals and notes.

    `covariance` (12, 12) in the order of `COEFFICIENTS` is the combined one, as far as `sources` go, and
    `covariance_readings` the part of these readings and of the stand as it is stated; K in unit/g with
    g = `g_m_s2`, biases in unit.
    `stand` holds the estimated stand angles ("alpha1[1]"), `effects` the fitted parameters of effects.
    `fitted` are the readings used, `residuals` (n, 3) measured minus fitted with the stand's angles and the
    effects at their estimates. `free` are the readings that joined by their modulus, `modulus_error` (m,)
    |a| - 1 of each in g. `outliers` have no weight in the estimate; `notes` says what a reader should know.
    `gain` (12, N, 3) is the map from the signals of the whole table to the coefficients, `slope`
    (N, 3) du/dphi of them, zero for rows that are not oriented. `shared` are variances
    that readings share, `drift` how the biases wander, `wander` (3,) how far they may, rms, `birge` by how much u
    was widened where the model does not fit, `p_tails` the probability of such tails in Gaussian noise. `sources`
    are the errors in the covariance that no reading shows; `gravity_u`, relative, is in none of these: K is per
    local g. `dof` (12,) are effective degrees of freedom.
    `triangular` is there for free positions alone. `assume` gives the sentences of `assumed`.
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
    free: Readings | None = None
    modulus_error: Floats = field(default_factory=lambda: np.zeros(0))
    outliers: tuple[Outlier, ...] = ()
    notes: tuple[str, ...] = ()
    triangular: Triangular | None = None
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
    def u_readings(self) -> Floats:
        """Standard uncertainties that these readings and the stand as it is stated give, shape (12,)."""
        return u_of(self.covariance_readings)

    @property
    def U(self) -> Floats:  # noqa: N802 - the symbol of the field
        """Expanded uncertainties k u with k = `COVERAGE_FACTOR`, shape (12,): u is widened for finite freedom."""
        return COVERAGE_FACTOR * self.u

    @property
    def covariance_same_meters(self) -> Floats:
        """Combined covariance (12, 12) without the errors that cancel when the same meters read the block."""
        return self.covariance - sum((s.covariance for s in self.sources if s.cancels), np.zeros((12, 12)))

    @property
    def block_terms(self) -> Floats:
        """Changes (12, q) of the coefficients by K2 and K3 of the block, each of size u."""
        parts = [s.of_block for s in self.sources if s.of_block is not None]
        return np.concatenate([np.zeros((12, 0)), *parts], axis=1)

    @cached_property
    def assumed(self) -> tuple[str, ...]:
        """Sentences on the assumptions that these data cannot test, with their cost; cached."""
        return self.assume()

    @property
    def used(self) -> int:
        """Number of readings in the fit, oriented and free."""
        return len(self.fitted) + len(self.modulus_error)

    @property
    def modulus_rms_g(self) -> float:
        """Root mean square of |a| - 1 over the free readings that are no outliers, g; NaN where there are none."""
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
"""The twelve numbers of a = N (U - U0), in the order of every vector and table of them."""

MISALIGNMENTS: Final = {
    "alpha_yx": ("Kxy", "Kxx", 1.0),
    "alpha_zx": ("Kxz", "Kxx", -1.0),
    "alpha_xy": ("Kyx", "Kyy", -1.0),
    "alpha_zy": ("Kyz", "Kyy", 1.0),
    "alpha_xz": ("Kzx", "Kzz", 1.0),
    "alpha_yz": ("Kzy", "Kzz", -1.0),
}
"""Each angle by name: its K_ij, its K_ii and (-1)^n.

Source: the paper, K_ij = (-1)^n K_ii alpha_ji, n = 2 where j follows i in x -> y -> z -> x, else 1. So alpha_ji is
the right-hand turn of the input axis of channel i about the third axis, in the plane of i and j.
"""


@dataclass(frozen=True)
class Derived(HasCovariance):
    """Numbers computed from the coefficients: `values` (m,) and their `covariance` (m, m), by `names`.

    `jacobian` (m, 12) are their derivatives by `COEFFICIENTS`: 1 of these themselves.
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
    return Derived(INVERSE, np.concatenate([N.ravel(), block.U0]), _through(slopes, covariance), slopes)


def inverse_jacobian(N: Floats) -> Floats:
    """Return the derivatives (12, 12) of `INVERSE` by `COEFFICIENTS`: dN_ij/dK_kl = -N_ik N_lj, U0 itself."""
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
    return Derived(tuple(MISALIGNMENTS), values, _through(rows, covariance), rows)


def specific_force_covariance(derived: Derived, signal: Floats, noise: float = 0.0) -> Floats:
    """Return the covariance (n, 3, 3), g^2, of a = N (U - U0) for signals (n, 3).

    It combines the covariance of `derived`, from `inverse`, and independent `noise` in each signal (1 sigma).
    """
    N, U0 = derived.values[:9].reshape(3, 3), derived.values[9:]
    left = signal - U0
    jacobian = np.zeros((len(signal), 3, len(INVERSE)))
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3] = left
    jacobian[:, :, 9:] = -N
    return np.asarray(jacobian @ derived.covariance @ np.moveaxis(jacobian, 1, 2) + noise**2 * N @ N.T)


def _through(jacobian: Floats, covariance: Floats) -> Floats:
    through = jacobian @ covariance @ jacobian.T
    return np.asarray(0.5 * (through + through.T))
