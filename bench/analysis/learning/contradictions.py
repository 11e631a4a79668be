"""Which runs contradict the others: each is held against what all others tell, without it.

Three questions of each run: are its angles of the stand such as the others' mountings have them; does it leave more
than theirs beyond the scatter of its repeats (an effect of its own does that: K2 of one block, a drift in one run);
is its scatter another. All looks count, by Holm's rule.
Source: S. Holm, Scand. J. Stat. 6 (1979) 65.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.learning.body import SEEN, Body, RunFit, body_of, pooled_noise
from bench.analysis.learning.likelihood import Beliefs, Weighed, at, fitted
from bench.analysis.learning.noise import between_runs, scatter_of
from bench.base.arrays import Floats

NAMED_P: Final = 0.01
"""A run is named where chance alone would name any run of so many less often than this."""
LOOKED_AT_P: Final = 0.1
"""Variances are estimated anew without a run only where it is that odd by those of all."""
MOST_PART: Final = 1 / 3
"""No more of the runs are left out: where more contradict, it is the bench that is not one."""
ANGLES: Final = "its angles of the stand"
FIT: Final = "what it leaves beyond the scatter of its repeats"
SCATTER: Final = "the scatter of its repeats"


@dataclass(frozen=True)
class Contradiction:
    """A run that contradicts the others: in `what`, `size` times what is expected, `p` with all looks counted."""

    run: str
    what: str
    size: float
    p: float

    @property
    def sentence(self) -> str:
        """Say it in words."""
        return f"{self.run} contradicts the others: {self.what} is {self.size:.3g} times what they lead to expect"

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {"run": self.run, "what": self.what, "size": self.size, "p": self.p, "sentence": self.sentence}


def odd_runs(runs: list[RunFit], body: Body, theta: Floats, beliefs: Beliefs) -> list[Contradiction]:
    """Return for every run and question how odd it is, p with all looks counted, the oddest first."""
    found = [*_angles(body, theta, beliefs), *_fit(body, at(body, theta, beliefs).means)]
    found += _scatter(runs)
    return _holm(found)


def _holm(found: list[Contradiction]) -> list[Contradiction]:
    ordered = sorted(found, key=lambda one: one.p)
    p, adjusted = 0.0, []
    for k, one in enumerate(ordered):
        p = max(p, min(1.0, (len(ordered) - k) * one.p))
        adjusted.append(Contradiction(one.run, one.what, one.size, p))
    return adjusted


def _angles(body: Body, theta: Floats, beliefs: Beliefs) -> list[Contradiction]:
    found = []
    weighed = Weighed.of(body, theta, len(beliefs.precision))
    for r, name in enumerate(body.names):
        size, p = _angle_test(body, r, theta, *weighed.means(beliefs, without=r))
        if p < LOOKED_AT_P:
            # an odd run makes its own scatter look usual
            others = body.without([r])
            anew = fitted(others, beliefs, theta)
            size, p = _angle_test(
                body, r, anew, *Weighed.of(others, anew, len(beliefs.precision)).means(beliefs)
            )
        if np.isfinite(size):
            found.append(Contradiction(name, ANGLES, size, p))
    return found


def _angle_test(body: Body, r: int, theta: Floats, means: Floats, covariance: Floats) -> tuple[float, float]:
    """Return chi-square over its freedom, and p, of what a run tells of its angles by what the others predict."""
    c = body.columns
    own = np.flatnonzero(body.mean[r] >= 0)
    by_means = body.by_mean(len(means) - body.waves)[r][own, c:-1]
    sized = np.append(theta, 0.0)[body.random[r]]
    S = body.gram[r, :c, :c]
    left = body.gram[r, own, -1] - by_means @ means
    spread = S[np.ix_(own, own)] + (S[own] * sized) @ S[own].T + by_means @ covariance @ by_means.T
    size, axes = np.linalg.eigh(S[np.ix_(own, own)])
    axes = axes[:, size > SEEN]
    freedom = axes.shape[1]
    if not freedom:
        return float("nan"), 1.0
    z = axes.T @ left
    chi2 = float(z @ np.linalg.solve(axes.T @ spread @ axes, z))
    return chi2 / freedom, float(special.fdtrc(freedom, max(len(body.names) - 1, 1), chi2 / freedom))


def _fit(body: Body, means: Floats) -> list[Contradiction]:
    """Return how much each run leaves beyond its repeats, by the others, the head's waves taken off."""
    waves = means[len(means) - body.waves :]
    c = body.columns
    H = slice(c, c + body.waves)
    chi2 = np.empty(len(body.names))
    for r, gram in enumerate(body.gram):
        angles = np.flatnonzero(body.mean[r] >= 0)
        left = gram[angles, -1] - gram[angles, H] @ waves
        size, axes = np.linalg.eigh(gram[np.ix_(angles, angles)])
        seen = size > SEEN
        explained = np.sum((axes[:, seen].T @ left) ** 2 / size[seen])
        off = -2.0 * waves @ gram[H, -1] + waves @ gram[H, H] @ waves
        chi2[r] = max(float(body.chi2[r] + off - explained), 1e-3)
    return _held_against(body.names, chi2 / body.dof, body.dof, FIT, upper=True)


def _scatter(runs: list[RunFit]) -> list[Contradiction]:
    told = [run for run in runs if run.scatter.settings]
    if len(told) < 2:
        return []
    ratio, dof = scatter_of(told, pooled_noise(told, min(run.floor for run in told)))
    return _held_against(tuple(run.name for run in told), ratio, dof, SCATTER, upper=False)


def _held_against(
    names: tuple[str, ...], ratio: Floats, dof: Floats, what: str, *, upper: bool
) -> list[Contradiction]:
    """Return how odd each of several mean squares with degrees of freedom is, by the others as they differ."""
    usable = np.flatnonzero(dof > 0)
    found = []
    for r in usable:
        others = usable[usable != r]
        if not len(others):
            continue
        mean, spread2, told = between_runs(ratio[others], dof[others])
        x = float(np.log(ratio[r]) - special.digamma(dof[r] / 2) + np.log(dof[r] / 2))
        u = np.sqrt(special.polygamma(1, dof[r] / 2) + spread2 + told)
        t = (x - mean) / float(u)
        # a spread that was estimated is known to the degrees of freedom of the others
        above = special.ndtr(-t) if spread2 == 0.0 else special.stdtr(max(len(others) - 1, 1), -t)
        p = float(above if upper else 2 * min(above, 1 - above))
        found.append(Contradiction(names[r], what, float(np.exp(x - mean)), p))
    return found


@dataclass(frozen=True)
class Agreed:
    """Runs that agree, with their noise (4,) and their sums; those that do not, the oddest first."""

    runs: list[RunFit]
    body: Body
    noise: Floats
    contradicting: tuple[Contradiction, ...]
    most: bool


def agreed(runs: list[RunFit], body: Body, noise: Floats, beliefs: Beliefs, layout: Any) -> Agreed:
    """Leave out runs that contradict the others, the oddest first, one at a time."""
    named: list[Contradiction] = []
    kept = list(runs)
    most = int(len(runs) * MOST_PART)
    theta = fitted(body, beliefs)
    while len(kept) > 2:
        oddest = odd_runs(kept, body, theta, beliefs)[0]
        if oddest.p >= NAMED_P:
            return Agreed(kept, body, noise, tuple(named), most=False)
        if len(named) >= most:
            return Agreed(kept, body, noise, (*named, oddest), most=True)
        named.append(oddest)
        kept = [run for run in kept if run.name != oddest.run]
        noise = pooled_noise(kept, min(run.floor for run in kept))
        body = body_of(kept, noise, layout)
        theta = fitted(body, beliefs, theta)
    return Agreed(kept, body, noise, tuple(named), most=False)
