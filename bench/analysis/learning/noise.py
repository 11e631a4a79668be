"""What runs share of their noise, and how far that of one run may be from that of the others.

The sizes are those of all repeats together; the spread between runs is by moments of their logarithms.
Source of the latter: R. DerSimonian, N. Laird, Controlled Clinical Trials 7 (1986) 177.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.calibration.known import KnownNoise
from bench.analysis.calibration.repeats_likelihood import freedom_of
from bench.analysis.learning.body import RunFit
from bench.base.arrays import Floats


def scatter_of(runs: Sequence[RunFit], variances: Floats) -> tuple[Floats, Floats]:
    """Return the mean square of each run's repeats in terms of noise (4,), and its degrees of freedom, (runs,)."""
    ratio, dof = [], []
    for run in runs:
        slope = run.scatter.slope
        own = np.diag(variances[:3]) + variances[3] * slope[:, :, None] * slope[:, None, :]
        chi2 = float(np.einsum("gij,gji->", np.linalg.inv(own), run.scatter.matrix))
        dof.append(3.0 * run.scatter.settings)
        ratio.append(chi2 / dof[-1])
    return np.array(ratio), np.array(dof)


def between_runs(ratio: Floats, dof: Floats) -> tuple[float, float, float]:
    """Return the mean logarithm of mean squares (n,), the variance between runs, and that of the mean.

    The logarithm of a mean square with nu degrees of freedom has the variance psi'(nu/2) of itself.
    """
    x = np.log(ratio) - special.digamma(dof / 2) + np.log(dof / 2)
    own = special.polygamma(1, dof / 2)
    weight = 1.0 / own
    mean = float(weight @ x / weight.sum())
    excess = float(weight @ (x - mean) ** 2) - (len(x) - 1)
    scale = float(weight.sum() - (weight @ weight) / weight.sum())
    spread2 = max(excess / scale, 0.0) if scale > 0 else 0.0
    weight = 1.0 / (own + spread2)
    mean = float(weight @ x / weight.sum())
    return mean, spread2, float(1.0 / weight.sum())


def known_noise(runs: Sequence[RunFit], variances: Floats) -> tuple[KnownNoise, Floats]:
    """Return the noise as what is known of that of a further run, and the degrees of freedom (4,) of the sizes.

    The degrees of freedom of the former hold how far runs differ, and how well that is known.
    """
    told = [run for run in runs if run.scatter.settings]
    freedom = np.concatenate([run.scatter.freedom for run in told])
    slope = np.concatenate([run.scatter.slope for run in told])
    pooled = _pooled_dof(freedom, slope, variances)
    each = np.array([_own(run, variances) for run in told])
    spread2 = np.ones(4)
    for j in range(3):
        usable = each[:, 1, j] > 1.0
        if np.sum(usable) > 1:
            ratio, own = np.maximum(each[usable, 0, j], 1e-6), each[usable, 1, j]
            # what so few runs leave open of the spread comes on top
            left = np.sqrt(2.0 / len(ratio)) * float(np.mean(special.polygamma(1, own / 2)))
            spread2[j] = between_runs(ratio, own)[1] + left
    # a run alone hardly tells of its setting error: it is the head's and the operator's, as constant as the meters
    spread2[3] = np.mean(spread2[:3])
    dof = 2.0 / (2.0 / np.maximum(pooled, 1e-15) + spread2)
    sizes = np.sqrt(variances)
    return KnownNoise(sizes[:3], dof[:3], float(sizes[3]), float(dof[3])), pooled


LEAST_SHOWN: Final = 0.01
"""A setting error that shows as less of the noise's variance has the u of one that shows as much."""


def _pooled_dof(freedom: Floats, slope: Floats, variances: Floats) -> Floats:
    """Return 2 v^2/u(v)^2 of the variances (4,); of a setting error near nothing u stays what the repeats leave."""
    shown = float(np.mean(np.sum(slope**2, axis=1)))
    least = LEAST_SHOWN * float(np.mean(variances[:3])) / shown if shown > 0 else 0.0
    inside = variances.copy()
    inside[3] = max(variances[3], least)
    dof = np.array(freedom_of(freedom, slope[None], inside[None])[0])
    if inside[3] > 0:
        dof[3] *= (variances[3] / inside[3]) ** 2
    return dof


def _own(run: RunFit, variances: Floats) -> tuple[Floats, Floats]:
    """Return the variances of a run in terms of those of all (4,), and their degrees of freedom (4,)."""
    own = run.noise()
    if own is None:
        return np.ones(4), np.zeros(4)
    dof = freedom_of(run.scatter.freedom, run.scatter.slope[None], variances[None])[0]
    return own / np.maximum(variances, 1e-300), dof
