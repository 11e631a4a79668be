"""What a baseline says of later runs of a check block: Shewhart and EWMA statistics that know their own u.

All of a run that comes anew with each measurement is its stated covariance; what the baseline adds is how
large that is in truth. Later values are predicted, not compared with a mean that passes for exact: the
uncertainty of the centre is in every statistic, as it is in the EWMA, which forgets it never. So the
probabilities are exact for a normal process, however few runs the baseline has (Student's t, Snedecor's F;
Hotelling's T² where scatter alone counts).

Sources: NIST/SEMATECH e-Handbook, 2.2.2.1 and 2.3.5.2 (charts of a check standard); H. Hotelling, "Multivariate
quality control" (1947); C. A. Lowry, W. H. Woodall, C. W. Champ and S. E. Rigdon, "A multivariate exponentially
weighted moving average control chart", Technometrics 34 (1992), 46-53, equation 3.2 (the covariance of the EWMA at
each value); N. D. Tracy, J. C. Young and R. L. Mason, "Multivariate control charts for individual observations",
J. Quality Technology 24 (1992), 88-95 (T² of a new value); R. T. Birge, Phys. Rev. 40 (1932), 207 (the ratio).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from scipy import signal, special

from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats

Basis = Literal["stated", "scaled", "scatter"]
BASES: Final = ("stated", "scaled", "scatter")
"""The u of a run as stated; the same times one factor that the baseline shows; the scatter of the baseline
alone."""


@dataclass(frozen=True)
class Centre:
    """What a baseline of m runs says: `value` (…, p) with `covariance` (p, p), and how large u is in truth.

    `scale` (…,) is by how much the stated covariance is to be multiplied: 1 where it is believed, else the square
    of the Birge ratio. `scatter` (…, p, p) is the sample covariance where that alone counts, None else. `dof` are
    the degrees of freedom of either, infinite where u is believed. Leading axes are charts side by side.
    """

    value: Floats
    covariance: Floats
    scale: Floats
    dof: float
    runs: int
    scatter: Floats | None = None

    @property
    def dimensions(self) -> int:
        """Number of coefficients, p."""
        return int(self.value.shape[-1])

    def p_single(self, z: Floats) -> Floats:
        """Return two-sided probabilities of deviations `z` of one coefficient, in its own u."""
        if np.isinf(self.dof):
            return np.asarray(special.erfc(np.abs(z) / np.sqrt(2.0)))
        return np.asarray(2.0 * special.stdtr(self.dof, -np.abs(z)))

    def p_joint(self, t2: Floats) -> Floats:
        """Return the probabilities of as much in all coefficients together."""
        p = self.dimensions
        if np.isinf(self.dof):
            return np.asarray(special.chdtrc(p, t2))
        if self.scatter is None:
            return np.asarray(special.fdtrc(p, self.dof, t2 / p))
        left = self.dof - p + 1.0
        return np.asarray(special.fdtrc(p, left, t2 * left / (p * self.dof)))

    def single_limit(self, probability: float) -> float:
        """Return the deviation, in u of one coefficient, that has a two-sided probability."""
        if np.isinf(self.dof):
            return float(-special.ndtri(0.5 * probability))
        return float(-special.stdtrit(self.dof, 0.5 * probability))

    def joint_limit(self, probability: float) -> float:
        """Return the joint statistic that has a probability."""
        p = self.dimensions
        if np.isinf(self.dof):
            return float(special.chdtri(p, probability))
        if self.scatter is None:
            return float(p * special.fdtri(p, self.dof, 1.0 - probability))
        left = self.dof - p + 1.0
        return float(p * self.dof / left * special.fdtri(p, left, 1.0 - probability))


@dataclass(frozen=True)
class Judged:
    """Deviations from the centre (…, n, p) with their `u`, `z` = deviation/u with its probability `p`.

    `t2` (…, n) is the joint statistic of all coefficients, `p_joint` its probability.
    """

    deviation: Floats
    u: Floats
    z: Floats
    p: Floats
    t2: Floats
    p_joint: Floats


def least_runs(basis: Basis, dimensions: int) -> int:
    """Return how many runs a baseline must have at least: with scatter alone, more than there are coefficients."""
    return {"stated": 1, "scaled": 3, "scatter": dimensions + 2}[basis]


def centre_of(values: Floats, covariances: Floats, basis: Basis) -> Centre:
    """Return what runs (…, m, p) with covariances (m, p, p) say of the block and of u.

    Raises `CalibrationError` where they are fewer than the basis needs.
    """
    runs, p = values.shape[-2:]
    if runs < (least := least_runs(basis, p)):
        raise CalibrationError(
            f"limits from '{basis}' need a baseline of {least} runs for {p} coefficients, and there are {runs}; "
            "measure the check block more often, or let the limits be from 'stated'"
        )
    if basis == "scatter":
        mean = values.mean(axis=-2)
        left = values - mean[..., None, :]
        sample = np.swapaxes(left, -1, -2) @ left / (runs - 1)
        one = np.ones(values.shape[:-2])
        return Centre(mean, np.zeros((p, p)), one, runs - 1.0, runs, sample)
    weights = np.linalg.inv(covariances)
    covariance = np.linalg.inv(weights.sum(axis=0))
    mean = np.einsum("...mp,mpq->...q", values, weights) @ covariance
    left = values - mean[..., None, :]
    if basis == "stated":
        return Centre(mean, covariance, np.ones(values.shape[:-2]), np.inf, runs)
    dof = p * (runs - 1.0)
    scale = np.einsum("...mp,mpq,...mq->...", left, weights, left) / dof
    return Centre(mean, covariance, scale, dof, runs)


def judge(
    centre: Centre,
    values: Floats,
    covariances: Floats,
    smoothing: float = 1.0,
    shared: Floats | None = None,
    *,
    settled: bool = False,
) -> Judged:
    """Judge runs (…, n, p), in their order, with covariances (n, p, p) against a centre.

    With `smoothing` below 1 it is their EWMA, Z_t = smoothing r_t + (1 - smoothing) Z_{t-1} of the deviations r
    from the centre, Z_0 = 0. `shared` (n, p, q) is what errors of unit u, the same in all runs, add to each of
    them. `settled` takes the variance at which the EWMA ends up from the first value on, as published tables do.
    """
    weight = 1.0 - smoothing
    deviation = _filtered(values - centre.value[..., None, :], smoothing, weight, -2)
    count = np.arange(1, values.shape[-2] + 1)
    of_centre = np.ones(len(count)) if settled else 1.0 - weight**count
    ended = smoothing / (2.0 - smoothing)
    if centre.scatter is not None:
        of_values = np.full(len(count), ended) if settled else ended * (1.0 - weight ** (2 * count))
        total = of_values + of_centre**2 / centre.runs
        covariance = total[:, None, None] * centre.scatter[..., None, :, :]
    else:
        random = ended * covariances if settled else _filtered(covariances, smoothing**2, weight**2, 0)
        random = random + of_centre[:, None, None] ** 2 * centre.covariance
        covariance = random
    scale = centre.scale[..., None]
    if shared is not None:
        # these errors are as they are stated, whatever the baseline says of those that come anew
        common = _filtered(shared, smoothing, weight, 0)
        covariance = scale[..., None, None] * covariance + common @ np.swapaxes(common, -1, -2)
        scale = np.ones_like(scale)
    unscaled = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    weights = np.linalg.inv(covariance / (unscaled[..., :, None] * unscaled[..., None, :]))
    u = unscaled * np.sqrt(scale)[..., None]
    z = deviation / u
    t2 = np.sum((z[..., None, :] @ weights)[..., 0, :] * z, axis=-1)
    return Judged(deviation, u, z, centre.p_single(z), t2, centre.p_joint(t2))


def without_one(values: Floats, covariances: Floats, basis: Basis) -> Floats | None:
    """Return how probable each run (m, p) of a baseline is beside the others, (m,); None where these are too
    few."""
    runs, p = values.shape
    if runs - 1 < least_runs(basis, p) or runs < 2:
        return None
    found = []
    for k in range(runs):
        rest = np.arange(runs) != k
        centre = centre_of(values[rest], covariances[rest], basis)
        found.append(float(judge(centre, values[[k]], covariances[[k]]).p_joint[0]))
    return np.array(found)


def _filtered(values: Floats, gain: float, weight: float, axis: int) -> Floats:
    """Return y_t = gain x_t + weight y_{t-1} along an axis."""
    filtered: Any = signal.lfilter([gain], [1.0, -weight], values, axis=axis)
    return np.asarray(filtered)
