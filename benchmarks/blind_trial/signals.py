"""Signals of the trial: geometry, the paper's block (equation 11), voltmeter; visibility of effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import ARCSEC, Floats
from benchmarks.blind_trial.stand import Run, Truth, make_run, specific_force

K: Final = np.array(
    [
        [-2.177087, -0.018243, 0.025027],
        [0.026542, -2.139892, 0.032755],
        [0.006754, 0.006026, -2.144367],
    ]
)
U0: Final = np.array([0.071469, -0.196485, -0.411789])
STAND_SIGMA: Final = np.array([5 / 3, 5 / 3, 30.0]) * ARCSEC
"""α1, α2, α3 of a mounting: the paper's limits taken as three standard deviations."""
SETTING_SIGMA: Final = 10 / 3 * ARCSEC


def signals(
    run: Run,
    truths: Sequence[Truth] = (),
    stand: Floats | None = None,
    setting: Floats | float = 0.0,
    true_angle: Floats | None = None,
) -> Floats:
    """Return noise-free readings (n, 3), V.

    `stand` (mountings, 3) holds α1, α2, α3, and `setting` α4 for the rows, all in rad; `true_angle` (n,) is the
    true head angle if it differs from the scale's.
    """
    errors = np.zeros((int(run.mount.max()) + 1, 3)) if stand is None else stand
    tilt, zero, skew = errors[run.mount].T
    angle = (run.head_angle if true_angle is None else true_angle) + zero + setting
    added: dict[str, Floats | float] = {
        "angle": angle, "tilt": tilt, "skew": skew, "roll": 0.0, "gravity": 1.0,
    }  # fmt: skip
    for truth in truths:
        if truth.shift is not None:
            for key, value in truth.shift(run, truth.amplitude).items():
                added[key] = added[key] + value
    force = added["gravity"] * specific_force(
        _mounted(run), np.asarray(added["angle"]), added["tilt"], added["skew"], added["roll"]
    )
    volts = force @ K.T + U0
    for truth in truths:
        if truth.stage == "block" and truth.act is not None:
            volts = volts + np.diag(K) * truth.act(run, force, truth.amplitude)
    volts = np.where(run.measured[:, None], volts, run.input_v[:, None])
    for truth in truths:
        if truth.stage == "voltmeter" and truth.act is not None:
            volts = volts + truth.act(run, volts, truth.amplitude)
    return volts


def _mounted(run: Run) -> NDArray[np.str_]:
    """Return the labels of the rows; rows of an input check get "1", because their angle does not matter."""
    return np.where(run.measured, run.labels, "1")


def signature(run: Run, truth: Truth) -> Floats:
    """Return the change of the readings by an effect on a stand without errors, (n, 3), V."""
    return signals(run, [truth]) - signals(run)


@dataclass(frozen=True)
class Visibility:
    """The part of signatures that coefficients and stand errors cannot absorb, in units of the noise.

    `rows` (n,) are the rows used, `whitener` (rows, 3, 3) turns their noise into unit noise. `taken` (3·rows +
    nuisances, q) is an orthonormal basis of the changes that the 12 coefficients and the stand errors absorb.
    """

    rows: NDArray[np.bool_]
    whitener: Floats
    taken: Floats

    def left(self, change: Floats) -> Floats:
        """Return the whitened, projected signature (3·rows + nuisances,) of a change (n, 3) in V."""
        v = np.zeros(len(self.taken))
        white = np.einsum("nij,nj->ni", self.whitener, change[self.rows]).ravel()
        v[: len(white)] = white
        return v - self.taken @ (self.taken.T @ v)

    def rho(self, change: Floats) -> float:
        """Return ρ of a change (n, 3) in V: the signal-to-noise ratio of the best possible test."""
        return float(np.linalg.norm(self.left(change)))


@lru_cache
def visibility(design: str, noise_v: float, setting: float, *, verification: bool = False) -> Visibility:
    """Compute the visibility in a design for a reading noise (V) and a setting noise (rad), each 1 σ.

    With `verification`, the rows V are used too, but only their modulus of the specific force, because the
    orientation of the block is not known well enough there.
    """
    rows, whitener, top, priors = explained(design, noise_v, setting, verification=verification)
    taken, _ = np.linalg.qr(np.vstack([top, priors]))
    return Visibility(rows, whitener, taken)


@lru_cache
def explained(
    design: str, noise_v: float, setting: float, *, verification: bool = False
) -> tuple[NDArray[np.bool_], Floats, Floats, Floats]:
    """Return the rows used, their whiteners (rows, 3, 3), and the whitened columns of the fit.

    The columns are (3·rows, q) for the coefficients and the stand errors, and (stand errors, q) for the priors.
    """
    run = make_run(design)
    rows = run.measured if verification else run.fitted
    by_angle = _slope(lambda h: signals(run, setting=h))[rows]
    covariance = noise_v**2 * np.eye(3) + setting**2 * by_angle[:, :, None] * by_angle[:, None, :]
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    force = specific_force(_mounted(run), run.head_angle)[rows]
    turned = ~run.fitted[rows]
    by_modulus = force @ np.linalg.inv(K)
    by_modulus /= np.linalg.norm(by_modulus, axis=1, keepdims=True)
    whitener[turned] = 0.0
    whitener[turned, 0] = by_modulus[turned] / noise_v
    with_one = np.column_stack([force, np.ones(len(force))])
    coefficients = [np.einsum("i,n->ni", np.eye(3)[i], column) for i in range(3) for column in with_one.T]
    mounts = np.unique(run.mount[rows])
    nuisances = [
        _stand_slope(run, int(m), kind)[rows] * STAND_SIGMA[kind] for m in mounts for kind in range(3)
    ]
    columns = np.stack([*coefficients, *nuisances], axis=-1)
    top = np.einsum("nij,njq->niq", whitener, columns).reshape(-1, columns.shape[-1])
    # the prior of a stand error is an additional observation: zero, in units of its standard deviation
    priors = np.hstack([np.zeros((len(nuisances), 12)), np.eye(len(nuisances))])
    return rows, whitener, top, priors


def _slope(of: Callable[[float], Floats], step: float = 1e-5) -> Floats:
    """Return the derivative of the readings by an angle, V/rad, from central differences."""
    return (of(step) - of(-step)) / (2 * step)


def _stand_slope(run: Run, mount: int, kind: int) -> Floats:
    def moved(h: float) -> Floats:
        stand = np.zeros((int(run.mount.max()) + 1, 3))
        stand[mount, kind] = h
        return signals(run, stand=stand)

    return _slope(moved)


def scaled_to(truth: Truth, run: Run, rho: float, seen: Visibility, most: float = np.inf) -> Truth | None:
    """Return the effect with the amplitude that gives it ρ; None if this amplitude is above `most`."""
    for _ in range(30):
        got = seen.rho(signature(run, truth))
        if got * most < rho * truth.amplitude:
            return None
        truth = truth.scaled(truth.amplitude * rho / got)
        if abs(got - rho) < 1e-10 * rho:
            return truth
    return None
