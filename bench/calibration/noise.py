"""The noise of the readings, estimated from repeats rather than assumed.

A reading is the model plus a setting error, which acts on its three channels along d = du/dphi, plus independent
noise of each channel. The covariance of a reading is diag(sigma_x^2, sigma_y^2, sigma_z^2) + sigma_phi^2 d d^T. The
estimates of the four standard deviations maximise the restricted likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import Floats, Ints, least_squares, quadratic_forms, rms, unit_vectors
from bench.calibration.result import CalibrationError, Noise, NoisePrior
from bench.model.conditions import Conditions
from bench.stats.repeats_likelihood import LEAST_DOF, believed_sizes

CONTRADICTS_P: Final = 0.01
"""P-value below which a run's noise contradicts the known noise, and the run's own noise is used."""

LEAST_SIGNALS: Final = 1.5 * LEAST_DOF
"""Residual signals that give `LEAST_DOF`: two of three determine the reading noise, the third the setting."""


@dataclass(frozen=True)
class KnownNoise:
    """Prior knowledge of the noise: standard deviations, each with degrees of freedom.

    `channels` (3,) are the standard deviations of the reading noise in x, y and z, in the unit of the signal;
    `setting_rad` is that of the head's setting error, rad. Each variance has a scaled inverse chi-square
    distribution: it counts like repeats with as many degrees of freedom. If the prior comes from other runs,
    its degrees of freedom allow for variation of the noise between runs. A prior that the bench file states
    (`stated`) counts only where the readings have too few degrees of freedom.
    """

    channels: Floats
    channel_dof: Floats
    setting_rad: float
    setting_dof: float
    stated: bool = False

    @classmethod
    def of_bench(cls, sizes: Mapping[str, float]) -> KnownNoise | None:
        """Return the noise from stated standard deviations by name; None without "voltmeter_error"."""
        reading, setting = sizes.get("voltmeter_error", 0.0), sizes.get("setting_error", 0.0)
        if not reading > 0.0:
            return None
        return cls(np.full(3, reading), np.full(3, LEAST_DOF), setting, LEAST_DOF, stated=True)

    def beside(self, signals: float) -> KnownNoise | None:
        """Return the prior to combine with the residuals of `signals` signals; None if the residuals suffice.

        A prior from the bench file has only the degrees of freedom that the residuals lack. A prior from other runs
        is returned unchanged.
        """
        if not self.stated:
            return self
        lacking = LEAST_DOF * (1.0 - max(signals, 0.0) / LEAST_SIGNALS)
        if lacking <= 0.0:
            return None
        return replace(self, channel_dof=np.full(3, lacking), setting_dof=lacking)

    @property
    def dof(self) -> float:
        """Degrees of freedom of the reading noise, counted as in `Noise.reading_dof`."""
        return float(np.mean(self.channel_dof))

    def given(self) -> Noise:
        """Return these standard deviations as the noise of future readings, exactly known (infinite dof)."""
        x, y, z = self.channels.tolist()
        return Noise(rms(self.channels), self.setting_rad, np.inf, "given", channels=(x, y, z))

    def times(self, part: float) -> KnownNoise:
        """Return the prior with its standard deviations multiplied by `part`."""
        return replace(self, channels=part * self.channels, setting_rad=part * self.setting_rad)

    def joined(self, own: Noise) -> Noise:
        """Return the noise `own` of a run combined with this prior, or `own` alone.

        It is `own` alone if the two contradict each other, or if `own` was given. A prior from the bench file is
        also left out if `own` has enough degrees of freedom.
        """
        if np.isinf(own.dof) or self.beside(own.dof) is None:
            return own
        dof = np.asarray(own.channel_dof) if own.channel_dof is not None else np.full(3, own.reading_dof)
        if self.contradicts(own.by_channel, dof):
            return own
        whole = dof + self.channel_dof
        channels = np.sqrt((dof * own.by_channel**2 + self.channel_dof * self.channels**2) / whole)
        setting = self._setting(own)
        x, y, z = channels.tolist()
        nx, ny, nz = whole.tolist()
        return replace(
            own, reading=rms(channels), setting_rad=setting, dof=1.5 * float(np.mean(whole)),
            channels=(x, y, z), channel_dof=(nx, ny, nz),
        )  # fmt: skip

    def contradicts(self, sizes: Floats, dof: Floats) -> bool:
        """Return whether a run's noise contradicts the known noise of the channels, by F tests.

        `sizes` (3,) are the run's standard deviations in x, y and z, `dof` (3,) their degrees of freedom.
        """
        ratio = np.square(sizes / self.channels)
        above = special.fdtrc(dof, self.channel_dof, ratio)
        chance = 2.0 * np.minimum(above, 1.0 - above)
        return bool(np.min(chance) < CONTRADICTS_P / 3)

    def _setting(self, own: Noise) -> float:
        """Return the setting error, rad, from the weighted mean of the variances of the run and of this prior."""
        known = self.setting_rad**2
        if own.setting_limits_rad is None or not np.isfinite(own.setting_limits_rad[1]):
            return self.setting_rad
        u_own = (own.setting_limits_rad[1] ** 2 - own.setting_rad**2) / 2
        u_known = known * np.sqrt(2.0 / self.setting_dof)
        if not u_own > 0 or not u_known > 0:
            return own.setting_rad
        weights = np.array([u_own, u_known]) ** -2.0
        return float(np.sqrt(weights @ np.array([own.setting_rad**2, known]) / weights.sum()))


@dataclass(frozen=True)
class KnownStand:
    """Prior knowledge of the stand's angles from other runs, for the whole stand or by installation.

    `keys` (k,) are pairs of a name in `STAND_ANGLES` and an installation ("" for all). `mean` (k,), rad, are mean
    angles and `covariance` (k, k), rad^2, is their covariance. `remount` maps a name to the standard deviation of
    single mountings about the mean, rad. `noise` is prior knowledge of the noise, or None.
    """

    keys: tuple[tuple[str, str], ...]
    mean: Floats
    covariance: Floats
    remount: Mapping[str, float]
    noise: KnownNoise | None = None

    def place(self, name: str, installation: str) -> int | None:
        """Return the index in `keys` of an angle's mean in an installation; None without such a mean."""
        for key in ((name, ""), (name, installation)):
            if key in self.keys:
                return self.keys.index(key)
        return None

    def prior(
        self, unknowns: Sequence[tuple[str, str]], stated_u: Floats, shared: Floats
    ) -> tuple[Floats, Floats]:
        """Return prior means (q,), rad, and covariance (q, q), rad^2, of the angles `unknowns`.

        Each angle is given as (name, installation). An angle without a known mean has mean zero and the standard
        uncertainty in `stated_u` (q,). `shared` (q, q) is the correlation of what single mountings add.
        """
        places = [self.place(name, installation) for name, installation in unknowns]
        known = np.array([place is not None for place in places], dtype=bool)
        at = np.array([place or 0 for place in places], dtype=np.int64)
        mean = np.where(known, self.mean[at], 0.0)
        both = np.outer(known, known)
        covariance = np.where(both, self.covariance[np.ix_(at, at)], 0.0)
        own = [
            self.remount[name] if k else u for (name, _), k, u in zip(unknowns, known, stated_u, strict=True)
        ]
        return mean, covariance + shared * np.outer(own, own)


ONE_TEMPERATURE_K: Final = 1.0
"""Largest difference between temperatures, K, that counts as one temperature: the width of a chamber's band."""
METERS_DRIFT: Final = timedelta(days=90)
"""Time in which a meter may drift through its full limits: data sheets state 90-day limits."""
ONE_SITTING: Final = timedelta(days=1)
"""Time within which a meter does not drift: data sheets state separate limits for 24 hours."""


def drifted(
    first: tuple[Sequence[str], datetime | None], later: tuple[Sequence[str], datetime | None]
) -> float:
    """Return how far meters may have drifted between two uses, as a fraction (0 to 1) of their limits.

    A use is given by the identities of its meters and by its time. The fraction is 0 within `ONE_SITTING`, as
    the meters' errors then cancel, and later the time between the uses divided by `METERS_DRIFT`, at most 1.
    For different or unnamed meters, or an unknown time, it is 1.
    """
    (meters, when), (other, then) = first, later
    if not meters or tuple(meters) != tuple(other) or when is None or then is None:
        return 1.0
    apart = abs(then - when)
    return 0.0 if apart <= ONE_SITTING else min(apart / METERS_DRIFT, 1.0)


# --- the noise of readings ------------------------------------------------------------------------


LEAST_REPEATS: Final = 12
"""Least number of repeats (readings minus groups) whose scatter serves as estimate of the noise."""


SAME_SCATTER: Final = 1e-3


@dataclass(frozen=True)
class RepeatScatter:
    """Scatter within groups of repeats.

    `matrix` (groups, 3, 3), unit^2, is the sum of the outer products of each group's deviations from its mean.
    `freedom` (groups,) is the number of readings in each group minus one. `slope` (groups, 3), unit/rad, is the
    mean du/dphi of each group.
    """

    matrix: Floats
    freedom: Ints
    slope: Floats

    @property
    def settings(self) -> int:
        """Degrees of freedom of all repeats, counted in settings of the head (three signals each)."""
        return int(self.freedom.sum())

    def chi_square(self, variances: Floats) -> float:
        """Return the chi-square of the scatter for noise variances (4,) of x, y, z and of the setting (rad^2)."""
        along = variances[3] * self.slope[:, :, None] * self.slope[:, None, :]
        return float(np.einsum("gij,gji->", np.linalg.inv(np.diag(variances[:3]) + along), self.matrix))

    def is_close_to(self, other: RepeatScatter) -> bool:
        """Return whether another scatter of the same groups equals this one to 0.1 %, with the same noise."""
        return all(
            float(np.abs(a - b).sum()) <= SAME_SCATTER * float(np.abs(b).sum())
            for a, b in ((self.matrix, other.matrix), (self.slope, other.slope))
        )


@dataclass(frozen=True)
class SharedRounding:
    """The rounding error that readings of equal signals share.

    `groups` (n,) has equal numbers for readings of equal signals; `variance` (3,) is that of the error in x,
    y and z.
    """

    groups: Ints
    variance: Floats

    def relief(self, residuals: Floats, slope: Floats, noise: Noise) -> float:
        """Return the decrease of the chi-square of `residuals` (n, 3) when the shared error is counted as noise."""
        fall, size = 0.0, noise.by_channel**2
        for group in np.unique(self.groups):
            rows = np.flatnonzero(self.groups == group)
            angle = noise.setting_rad * slope[rows]
            alone = linalg.block_diag(*(np.diag(size) + angle[:, :, None] * angle[:, None, :]))
            whole = alone + np.kron(np.ones((len(rows), len(rows))), np.diag(self.variance))
            left = residuals[rows].ravel()
            fall += float(left @ (np.linalg.solve(alone, left) - np.linalg.solve(whole, left)))
        return fall


def rounding_variance(noise: Floats, floor: float) -> Floats:
    """Return the variance (k,) of the rounding error that repeats share, for k standard deviations of noise.

    `noise` (k,) includes rounding. `floor` is the standard deviation of rounding: the last digit divided by root
    12. The mean of many repeats keeps the harmonics of the rounding error that the noise does not smooth away (B.
    Widrow and I. Kollar, Quantization Noise, 2008, chapter 4). The result falls from floor^2 without noise to zero
    for noise above half a digit.
    """
    step2 = 12.0 * floor**2
    own = np.maximum(np.square(noise) - floor**2, 0.0)
    order2 = np.arange(1.0, 200.0) ** 2
    left = np.exp(-4.0 * np.pi**2 * np.outer(own / step2, order2)) / order2
    return np.asarray(step2 / (2.0 * np.pi**2) * left.sum(axis=1))


def repeat_groups(conditions: Conditions) -> Ints:
    """Return a number per reading (n,), equal for repeats: equal mounting, point, direction of approach."""
    points = int(conditions.point.max(initial=0)) + 1
    key = (conditions.mount * points + conditions.point) * 3 + conditions.direction
    return np.asarray(np.unique(key, return_inverse=True)[1])


def scatter_of_repeats(residuals: Floats, slope: Floats, groups: Ints) -> RepeatScatter:
    """Return the scatter of residuals (n, 3) about their group means; `slope` (n, 3) is du/dphi.

    Residuals are used, not readings, because the angle read back differs slightly between repeats.
    """
    count = np.bincount(groups)
    deviation = residuals - (_group_sum(residuals, groups) / count[:, None])[groups]
    products = (deviation[:, :, None] * deviation[:, None, :]).reshape(-1, 9)
    repeated = count > 1
    return RepeatScatter(
        matrix=_group_sum(products, groups)[repeated].reshape(-1, 3, 3),
        freedom=(count - 1)[repeated],
        slope=(_group_sum(slope, groups) / count[:, None])[repeated],
    )


def _group_sum(values: Floats, groups: Ints) -> Floats:
    return np.stack([np.bincount(groups, column).astype(np.float64) for column in values.T], axis=1)


def noise_from_repeats(scatter: RepeatScatter, floor: float, *, one_size: bool = False) -> Noise:
    """Return the noise from repeats by restricted maximum likelihood.

    The channels get separate standard deviations if they differ significantly, unless `one_size`. `floor` (unit of
    the signal) is the lower limit of the noise, which follows from the last digit of a reading.
    """
    found = believed_sizes(
        scatter.matrix[None], scatter.freedom, scatter.slope[None], floor, one_size=one_size
    )
    channels, setting = np.sqrt(found.variances[0, :3]), float(np.sqrt(found.variances[0, 3]))
    slope2 = float(np.mean(np.sum(scatter.slope**2, axis=1)))
    reading = rms(channels)
    noise = Noise(
        reading,
        setting,
        3.0 * scatter.settings,
        "repeats",
        setting_limits(reading, setting, slope2, scatter.settings),
        p_equal=float(found.p_equal[0]),
    )
    if found.alike[0]:
        return noise
    return replace(noise, channels=_three(channels), channel_dof=_three(found.dof[0]))


def _three(values: Floats) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


class RepeatedNoise:
    """The noise from repeats during an iterative fit, re-estimated only if the scatter of repeats changes.

    The scatter hardly depends on the estimates of the fit, because repeats have nearly equal angles.
    """

    def __init__(self, floor: float, groups: Ints, *, one_size: bool = False) -> None:
        self._floor = floor
        self._one_size = one_size
        self._groups = groups
        self._known: tuple[RepeatScatter, Noise] | None = None

    def sizes(self, residuals: Floats, slope: Floats) -> Noise | None:
        """Return the noise for residuals (n, 3) and du/dphi (n, 3); None if the repeats are too few."""
        if not len(residuals):
            return None
        scatter = scatter_of_repeats(residuals, slope, self._groups)
        if scatter.settings < LEAST_REPEATS:
            return None
        if self._known is None or not scatter.is_close_to(self._known[0]):
            self._known = scatter, noise_from_repeats(scatter, self._floor, one_size=self._one_size)
        return self._known[1]


LEAST_SETTING: Final = 1e-3
"""Lower limit of the setting error as a fraction of the reading noise, both in the unit of the signal."""


def setting_limits(reading: float, setting_rad: float, slope2: float, freedom: float) -> tuple[float, float]:
    """Return the limits, rad, that contain the standard deviation of the setting error with about 95 %.

    `reading` is the reading noise, `slope2` the mean of |d|^2 with d = du/dphi. The variance along d, reading^2 +
    setting_rad^2 |d|^2, has the relative standard uncertainty sqrt(2/`freedom`).
    """
    if slope2 <= 0.0:
        return 0.0, float("inf")
    u = np.sqrt(2.0 / max(freedom, 1.0)) * (reading**2 / slope2 + setting_rad**2)
    low, high = setting_rad**2 - 2 * u, setting_rad**2 + 2 * u
    return float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))


OF_RESIDUALS: Final = "residuals"
LEAST_PART: Final = 1e-4
"""Lower limit of the reading noise, as a fraction of the residuals from which it is estimated: rounding."""
MOST_PART: Final = 10.0


@dataclass(frozen=True)
class LikelihoodResiduals:
    """Linearised residuals, for the restricted likelihood of reading noise and setting error.

    `columns` (n, 3, p + 1) are the derivatives by the p unknowns, then the residuals. Unknowns from index `fixed`
    on are random effects, scaled to unit prior standard deviation. `slope` (n, 3) is du/dphi. `free` (m, p + 1) has
    the same columns for m moduli, in the unit of the signal; moduli have reading noise only.
    """

    columns: Floats
    slope: Floats
    free: Floats
    fixed: int

    @property
    def count(self) -> int:
        """The number of residuals: three signals for each oriented reading, and one for each modulus."""
        return 3 * len(self.columns) + len(self.free)

    @property
    def unknowns(self) -> int:
        """Number of coefficients and random effects, p."""
        return int(self.columns.shape[2]) - 1

    @cached_property
    def steepness(self) -> float:
        """Root mean square of |du/dphi| over the readings, unit/rad."""
        return max(rms(self._along[1]), 1e-300) if len(self.slope) else 1.0

    def spread(self, unknowns: int) -> float:
        """Return the residual standard deviation of a least-squares fit with the first `unknowns` columns."""
        rows = np.vstack([self.columns.reshape(-1, self.unknowns + 1), self.free])
        _, left = least_squares(rows[:, :unknowns], rows[:, -1])
        return float(np.sqrt(left @ left / max(self.count - unknowns, 1)))

    @cached_property
    def _gram(self) -> Floats:
        return np.asarray(
            np.einsum("nip,niq->pq", self.columns, self.columns) + self.free.T @ self.free, dtype=np.float64
        )

    @cached_property
    def _along(self) -> tuple[Floats, Floats]:
        unit, length = unit_vectors(self.slope)
        return np.einsum("nip,ni->np", self.columns, unit), length

    def likelihood(self, log_sizes: Floats) -> tuple[float, Floats, float]:
        """Return -2 ln L, its derivatives by `log_sizes` (2,), and the weighted sum of squares y^T P y.

        `log_sizes` are the logarithms of the standard deviations of reading noise and setting error.
        """
        along, length = self._along
        p = self.unknowns
        reading, setting = np.exp(2 * log_sizes)
        part = setting * length**2
        weight = part / (reading * (reading + part))
        whitened = self._gram / reading - (along * weight[:, None]).T @ along
        normal = whitened[:p, :p] + np.diag((np.arange(p) >= self.fixed).astype(np.float64))
        scale = 1 / np.sqrt(np.diag(normal))
        lower = np.linalg.inv(np.linalg.cholesky(normal * np.outer(scale, scale))) * scale
        inverse = lower.T @ lower
        solution = inverse @ whitened[:p, p]
        log_det = self.count * np.log(reading) + np.sum(np.log1p(part / reading))
        log_det -= 2 * np.sum(np.log(np.diag(lower)))
        # the derivative of log det + misfit is the trace of this matrix times the derivative of the Gram matrix
        ends = np.append(-solution, 1.0)
        trace = np.outer(ends, ends)
        trace[:p, :p] += inverse
        each = quadratic_forms(along, trace)
        by_reading = self.count - np.sum(part / (reading + part)) - np.sum(self._gram * trace) / reading
        by_reading += np.sum(each * weight * (2 * reading + part) / (reading + part))
        by_setting = np.sum(part / (reading + part)) - np.sum(each * part / (reading + part) ** 2)
        misfit = whitened[p, p] - solution @ whitened[:p, p]
        return float(log_det + misfit), 2 * np.array([by_reading, by_setting]), float(misfit)


def noise_from_residuals(of: LikelihoodResiduals, floor: float, known: KnownNoise | None = None) -> Noise:
    """Return reading noise and setting error by restricted maximum likelihood from residuals.

    The function is for readings without enough repeats. A `known` prior from the bench file adds the degrees
    of freedom that the residuals lack; if the residuals suffice, they are only tested against it. A prior
    from other runs counts in full, but is left out if enough residuals contradict it.
    """
    signals = max(of.count - of.unknowns, 0)
    beside = None if known is None else known.beside(signals)
    if known is not None and beside is None:
        return replace(_most_likely(of, floor, None), stated=_prior(of, known, floor))
    prior = None if beside is None else _prior(of, beside, floor)
    if prior is None or (not prior.stated and signals >= LEAST_SIGNALS and prior.p < CONTRADICTS_P):
        return _most_likely(of, floor, None)
    return _most_likely(of, floor, prior)


def require_told(noise: Noise) -> None:
    """Raise `CalibrationError` for noise from residuals with too few degrees of freedom and no prior.

    The uncertainties would then be arbitrary.
    """
    if noise.source == OF_RESIDUALS and noise.prior is None and noise.reading_dof < LEAST_DOF:
        raise CalibrationError(
            "so few readings do not show their noise; measure more points or passes, or state "
            "voltmeter_error in the bench file for signals in V"
        )


def _prior(of: LikelihoodResiduals, known: KnownNoise, floor: float) -> NoisePrior:
    """Return the prior, with its test by the residual sum of squares y^T P y.

    The test is chi-square for stated sizes, F for sizes from other runs.
    """
    reading, freedom = max(rms(known.channels), floor), of.count - of.fixed
    prior = NoisePrior(reading, known.setting_rad, known.dof, freedom, np.nan, np.nan, known.stated)
    if freedom <= 0:
        return prior
    sizes = [reading, max(known.setting_rad, LEAST_SETTING * reading / of.steepness)]
    ratio = of.likelihood(np.log(sizes))[2] / freedom
    if known.stated:
        above = float(special.chdtrc(freedom, freedom * ratio))
    else:
        above = float(special.fdtrc(freedom, known.dof, ratio))
    return replace(prior, ratio=float(np.sqrt(ratio)), p=2.0 * min(above, 1.0 - above))


def _most_likely(of: LikelihoodResiduals, floor: float, prior: NoisePrior | None) -> Noise:
    signals, own = of.count - of.unknowns, of.spread(of.unknowns)
    guess = max(own, floor)
    setting, most, weight = 0.3 * guess / of.steepness, MOST_PART * guess, 0.0
    if prior is not None:
        guess, setting, weight = prior.reading, prior.setting_rad or setting, prior.dof
        most = MOST_PART * max(guess, of.spread(of.fixed))
    source = OF_RESIDUALS if prior is None else prior.source
    if not len(of.columns):
        dof = max(signals, 0) + weight or 1.0
        whole = float(np.sqrt((max(signals, 0) * own**2 + weight * guess**2) / dof))
        return Noise(max(whole, floor), 0.0, dof, source, prior=prior)
    stated = np.array([guess, 0.0 if prior is None else prior.setting_rad])

    def minus_two_log_posterior(log_sizes: Floats) -> tuple[float, Floats]:
        value, slope, _ = of.likelihood(log_sizes)
        # a scaled inverse chi-square of each variance
        ratio = np.square(stated / np.exp(log_sizes))
        return value + weight * float(np.sum(2 * log_sizes + ratio)), slope + 2 * weight * (1 - ratio)

    low = np.log([max(floor, LEAST_PART * guess), LEAST_SETTING * guess / of.steepness])
    high = np.log([most, most / of.steepness])
    start = np.clip(np.log([guess, setting]), low, high)
    from scipy.optimize import minimize

    bounds = list(zip(low.tolist(), high.tolist(), strict=True))
    found = minimize(minus_two_log_posterior, start, method="L-BFGS-B", jac=True, bounds=bounds)
    reading, angle = np.exp(found.x).tolist()
    dof = max(signals, 0) + 1.5 * weight or 1.0
    limits = setting_limits(reading, angle, of.steepness**2, dof / 3)
    return Noise(reading, angle, float(dof), source, limits, prior=prior)


def whiten(columns: Floats, slope: Floats, noise: Noise) -> Floats:
    """Return W times columns (n, 3, p), where W^T W is the inverse of the covariance of each reading.

    W = (I + s s^T)^(-1/2) D^(-1) with D = diag(sigma_x, sigma_y, sigma_z) and s = sigma_phi D^(-1) d, where d
    is the reading's row of `slope` (n, 3), du/dphi in signal units per rad.
    """
    sizes = noise.by_channel
    return without_setting(columns / sizes[:, None], slope / sizes, noise.setting_rad)


def whiten_back(columns: Floats, slope: Floats, noise: Noise) -> Floats:
    """Return W^T times columns (n, 3, p), with W as in `whiten`.

    The product converts a map of whitened readings to a map of raw readings.
    """
    sizes = noise.by_channel
    return np.asarray(without_setting(columns, slope / sizes, noise.setting_rad) / sizes[:, None])


def without_setting(columns: Floats, slope: Floats, setting_rad: float) -> Floats:
    """Return (I + s s^T)^(-1/2) times columns (n, 3, p), with s = `setting_rad` times a row of `slope` (n, 3)."""
    unit, length = unit_vectors(slope)
    shrink = 1.0 - 1.0 / np.hypot(1.0, setting_rad * length)
    along = np.einsum("nip,ni->np", columns, unit) * shrink[:, None]
    return np.asarray(columns - unit[:, :, None] * along[:, None, :])
