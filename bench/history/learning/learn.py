"""What the runs of one bench tell of it: the course from runs to sizes, contradictions first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.calibration.known import KnownStand
from bench.calibration.result import CalibrationError
from bench.history.learning.body import SEEN, Body, Layout, RunFit, body_of, known_noise, pooled_noise
from bench.history.learning.likelihood import Beliefs, Shared, agreed, at, fitted, maximise
from bench.history.learning.result import Learned, Variance

LEAST_RUNS: Final = 2
SHOWN: Final = 0.1
"""What a run must tell of an angle, in terms of what was stated of it, to show it at all."""
ALIKE: Final = 0.9
"""Cosine beyond which two angles show alike."""
HELD_CENTRE: Final = 0.5
HELD_SPREAD: Final = 1 / np.sqrt(12.0)
"""The part of a stated variance that comes with a remount, where nothing tells it: any from 0 to 1, alike."""
MEANS_OF_HELD: Final = 1.0 / HELD_CENTRE
"""Precision of the mean of such an angle: both parts together are what was stated."""
HALF_ITSELF: Final = 0.5
"""A variance is not told that is known to no better part of itself, nor better than what was stated."""


def learn(
    runs: Sequence[RunFit],
    stand_u: Mapping[str, float],
    *,
    by_installation: bool = False,
    waves: bool = True,
) -> Learned:
    """Return what runs of one bench share. `stand_u` are the stated u of the stand's angles, rad.

    With `by_installation` each installation has mean angles of its own, as where each has a bracket; else the
    mean is the stand's. `waves` looks for the head's eccentricity and ellipticity. Raises `CalibrationError`
    where the runs are too few, of several units of the signal, or hold too few repeats.
    """
    if len(runs) < LEAST_RUNS:
        raise CalibrationError(f"{len(runs)} run tells nothing of what runs share; give {LEAST_RUNS} or more")
    if len({run.unit for run in runs}) > 1:
        raise CalibrationError("these runs have signals in different units; learn from those of one unit")
    kept = list(runs)
    layout = Layout.of(kept, stand_u, by_installation=by_installation, waves=waves)
    noise = pooled_noise(kept, min(run.floor for run in kept))
    body = body_of(kept, noise, layout)
    free = Beliefs(np.ones(len(layout.means)), *np.full((2, len(layout.kinds) + 3), np.nan))
    beliefs, reasons = told_by_runs(body, layout, free)
    found = agreed(kept, body, noise, beliefs, layout)
    if found.contradicting:
        beliefs, reasons = told_by_runs(found.body, layout, free)
    shared = maximise(found.body, beliefs)
    return _learned(
        found.runs, layout, shared, beliefs, reasons, found.noise, found.contradicting, most=found.most
    )


def told_by_runs(body: Body, layout: Layout, free: Beliefs) -> tuple[Beliefs, dict[str, str]]:
    """Return the beliefs with those variances held that the runs do not tell, and why, by kind.

    Of several that only show together the ones of the smallest stated size are held, so that the others are told.
    """
    beliefs, reasons = free, {}
    for j, kind in enumerate(layout.kinds):
        if not _shown(body, j):
            beliefs, reasons[kind] = _holding(beliefs, layout, j), "no reading of these runs shows it"
    while True:
        theta = fitted(body, beliefs)
        untold = _untold(body, theta, beliefs, layout)
        if not untold:
            return beliefs, reasons
        j, why = min(untold.items(), key=lambda one: layout.stated[one[0]])
        beliefs, reasons[layout.kinds[j]] = _holding(beliefs, layout, j), why


def _holding(beliefs: Beliefs, layout: Layout, j: int) -> Beliefs:
    """Return the beliefs with the variance of a kind held, and its mean what is left of the stated size."""
    centre, spread = beliefs.centre.copy(), beliefs.spread.copy()
    centre[j], spread[j] = HELD_CENTRE, HELD_SPREAD
    own = np.array([name == layout.kinds[j] for name, _ in layout.means])
    return Beliefs(np.where(own, MEANS_OF_HELD, beliefs.precision), centre, spread)


def _shown(body: Body, j: int) -> bool:
    """Whether any run tells more of an angle than was stated of it."""
    own = np.diagonal(body.gram[:, : body.columns, : body.columns], axis1=1, axis2=2)[body.random == j]
    return bool(np.max(own, initial=0.0) > SHOWN)


def _untold(body: Body, theta: Floats, beliefs: Beliefs, layout: Layout) -> dict[int, str]:
    """Return the kinds whose variance the runs do not tell, with what it shows together with."""
    information = at(body, theta, beliefs).information
    k = len(layout.kinds)
    size = np.maximum(np.sqrt(np.diag(information)), 1e-6)
    scaled = information / np.outer(size, size) + 1e-9 * np.eye(len(size))
    covariance = np.linalg.inv(scaled) / np.outer(size, size)
    found = {}
    for j in range(k):
        u = np.sqrt(covariance[j, j])
        if beliefs.held[j] or u <= max(HELD_SPREAD, HALF_ITSELF * theta[j]):
            continue
        found[j] = _why(body, j, layout)
    return found


def _why(body: Body, j: int, layout: Layout) -> str:
    """Say what an angle shows together with, if with any."""
    together = set()
    for gram, random in zip(body.gram, body.random, strict=True):
        own = np.flatnonzero(random == j)
        for kind in range(len(layout.kinds)):
            for i, other in product(own, np.flatnonzero(random == kind)):
                size = np.sqrt(gram[i, i] * gram[other, other])
                if kind != j and size > SEEN and abs(gram[i, other]) > ALIKE * size:
                    together.add(layout.kinds[kind])
    if together:
        return f"in these runs it shows only together with {' and '.join(sorted(together))}"
    return "these runs are too few, or too noisy, to show it"


# --- from variances to sizes --------------------------------------------------------------------------


def _learned(
    runs: list[RunFit], layout: Layout, shared: Shared, beliefs: Beliefs, reasons: dict[str, str], noise: Floats,
    contradicting: tuple[object, ...], *, most: bool,
) -> Learned:  # fmt: skip
    body = body_of(runs, noise, layout)
    theta, spread = shared.theta, variances_of(shared)
    names = [*layout.kinds, *(f"drift[{channel}]" for channel in CHANNELS)]
    unit = np.concatenate([layout.stated, np.full(3, layout.walk)])
    variances = tuple(
        Variance(name, float(size), float(u), float(one), bool(held))
        for name, size, u, one, held in zip(
            names, theta, np.sqrt(np.diag(spread)), unit, beliefs.held, strict=True
        )
    )
    means = shared.at.means
    m = len(layout.means)
    scale = np.array(
        [layout.stated[layout.kinds.index(name)] for name, _ in layout.means] + [1.0] * body.waves
    )
    known, noise_dof = known_noise(runs, noise)
    dof = means_dof(body, theta, beliefs, spread)
    covariance = shared.at.covariance * np.outer(scale, scale)
    remount = {v.name: v.u_next for v in variances[: len(layout.kinds)]}
    wider = np.array([max(nu, 4.0) / (max(nu, 4.0) - 2.0) for nu in dof[:m]])
    known_stand = KnownStand(
        layout.means, means[:m] * scale[:m],
        covariance[:m, :m] * np.sqrt(np.outer(wider, wider)), remount, known,
    )  # fmt: skip
    return Learned(
        runs=tuple(run.name for run in runs),
        unit=runs[0].unit,
        keys=layout.means,
        means=means * scale,
        covariance=covariance,
        means_dof=dof,
        stated=scale[:m] / np.sqrt(beliefs.precision),
        waves=body.waves,
        variances=variances,
        variances_covariance=spread * np.outer(unit**2, unit**2),
        noise=np.sqrt(noise),
        noise_dof=noise_dof,
        known=known_stand,
        not_told=reasons,
        contradicting=contradicting,  # type: ignore[arg-type]
        too_many_contradict=most,
    )


def variances_of(shared: Shared) -> Floats:
    """Return the covariance (k, k) of the variances; one at its lower end hangs together with no other."""
    k = len(shared.theta)
    inside = np.flatnonzero(shared.theta > 1e-6)
    spread = np.zeros((k, k))
    own = shared.information[np.ix_(inside, inside)]
    if len(inside):
        size = np.sqrt(np.maximum(np.diag(own), 1e-12))
        spread[np.ix_(inside, inside)] = np.linalg.pinv(
            own / np.outer(size, size), hermitian=True
        ) / np.outer(size, size)
    for j in set(range(k)) - set(inside.tolist()):
        spread[j, j] = 1.0 / max(abs(shared.information[j, j]), 1e-12)
    return spread


def means_dof(body: Body, theta: Floats, beliefs: Beliefs, spread: Floats) -> Floats:
    """Return degrees of freedom (m + waves,) of the variances of the means, by Satterthwaite's approximation.

    2 c^2 / (g^T W g), c the variance of a mean, g its slope by the variances, W (k, k) their covariance. Source:
    F. E. Satterthwaite, Biometrics Bull. 2 (1946) 110; A. H. Fai, P. L. Cornelius, J. Stat. Comput. Simul. 54
    (1996) 363.
    """
    here = np.diag(at(body, theta, beliefs).covariance)
    slopes = np.zeros((len(here), len(theta)))
    for j in range(len(theta)):
        step = 0.01 * max(theta[j], 1e-3)
        moved = theta.copy()
        moved[j] += step
        slopes[:, j] = (np.diag(at(body, moved, beliefs).covariance) - here) / step
    taken = np.einsum("mk,kl,ml->m", slopes, spread, slopes)
    return np.asarray(2.0 * here**2 / np.maximum(taken, 1e-300))
