"""Repeats of quantities against their stated uncertainty: how far they scatter, and how u must be widened.

Three terms can widen u. `restart` is an error that is drawn again for each repeat; `drift` is a random walk from
one repeat to the next; `scale` multiplies every u by one factor (Birge ratio). The term chosen is the one with
which a repeat left out is best predicted from the remaining repeats.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from scipy import optimize, special

from bench.base.arrays import Floats

TOO_SMALL: Final = 1.5
"""u counts as too small if the scatter of repeats left out exceeds this multiple of u."""
LEAST: Final = 3
"""Least number of repeats for a test that leaves out each repeat in turn."""
LEVEL: Final = 0.95
NORMAL: Final = float(special.ndtri(0.5 + LEVEL / 2.0))
FINE: Final = 1e-4
COARSE: Final = 1e5
"""Range of trial sizes of a term, in units of the median stated u."""

PLAIN: Final = 3.0
"""`drift` or `scale` replaces the simplest term, `restart`, only if it raises ln p by more than this."""

TermName = Literal["restart", "drift", "scale"]


class Ratio(NamedTuple):
    """The scatter of repeats about predictions from the other repeats, divided by the u of the predictions.

    `low` and `high` are the ends of a 95 % interval that treats the repeats, not single values, as independent.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Term:
    """A term that widens u, for each of c kinds of quantity.

    `size` (c,) is the standard deviation of the term; for "scale" it is in multiples of u. `u` (g, r, c) is
    the widened uncertainty for g groups and r repeats.
    """

    name: TermName
    size: Floats
    u: Floats


@dataclass(frozen=True)
class Repeats:
    """The scatter of values between repeats, compared with their u.

    `scatter` is the scatter about the means of all repeats. For `held_before` and `held_after`, each repeat is left
    out and predicted from the remaining repeats: `held_before` uses the stated u, `held_after` the u that `term`
    widens. `term` and `held_after` are None if the stated u is large enough. All three are None for fewer than
    three repeats.
    """

    scatter: float
    held_before: Ratio | None
    held_after: Ratio | None
    term: Term | None

    @property
    def too_small(self) -> bool:
        """Whether `held_before` is above `TOO_SMALL` and its 95 % interval is above 1."""
        held = self.held_before
        return held is not None and held.value > TOO_SMALL and held.low > 1.0


def compare_repeats(value: Floats, u: Floats) -> Repeats:
    """Compare values (g, r, c) of g groups in r repeats with their stated u; NaN where a repeat is missing.

    Each group has a separate mean; each of the c kinds of quantity has a term of a separate size.
    """
    many = np.maximum(np.sum(np.isfinite(value), axis=1, keepdims=True), 1)
    off = value - np.nansum(value, axis=1, keepdims=True) / many
    with np.errstate(invalid="ignore"):
        ratio = np.where(many > 1, off / u * np.sqrt(many / np.maximum(many - 1, 1)), np.nan)
    scatter = float(np.sqrt(np.nanmean(ratio**2)))
    if value.shape[1] < LEAST:
        return Repeats(scatter, None, None, None)
    before = _ratio(_held_out(value, u, None)[0])
    plain = Repeats(scatter, before, None, None)
    if not plain.too_small:
        return plain
    names: tuple[TermName, ...] = ("restart", "drift", "scale")
    tried = {name: _held_out(value, u, name) for name in names}
    best = max(names, key=lambda name: tried[name][1] + PLAIN * (name == "restart"))
    return Repeats(scatter, before, _ratio(tried[best][0]), _term(value, u, best))


def _ratio(squares: Floats) -> Ratio:
    """Return the pooled ratio from squared errors divided by their variances (g, r, c).

    The interval allows for errors that all values of one repeat share.
    """
    each = np.nanmean(squares, axis=(0, 2))
    each = each[np.isfinite(each)]
    mean, variance = float(each.mean()), float(each.var(ddof=1)) / len(each)
    freedom = min(2.0 * mean**2 / max(variance, 1e-300), float(len(each)))
    tail = (1.0 - LEVEL) / 2.0
    low, high = (freedom / special.chdtri(freedom, p) for p in (tail, 1.0 - tail))
    return Ratio(float(np.sqrt(mean)), float(np.sqrt(mean * low)), float(np.sqrt(mean * high)))


def _term(value: Floats, u: Floats, name: TermName) -> Term:
    wider = _widening(value.shape[1] - 1)
    size = np.array([_size(value[:, :, c], u[:, :, c], name) for c in range(value.shape[2])])
    own = size * wider * (u if name == "scale" else np.ones_like(u))
    return Term(name, size * wider, np.hypot(u, own))


def _widening(freedom: float) -> float:
    """Return the 95 % quantile of Student's t with `freedom` degrees of freedom, divided by the normal quantile."""
    return float(special.stdtrit(freedom, 0.5 + LEVEL / 2.0)) / NORMAL


def _kernel(u: Floats, name: TermName | None) -> Floats:
    """Return the covariances (g, r, r) that a term of `size` 1 adds; zero for a missing repeat."""
    groups, repeats = u.shape
    there = np.isfinite(u)
    match name:
        case None:
            return np.zeros((groups, repeats, repeats))
        case "drift":
            walk = np.minimum.outer(np.arange(repeats), np.arange(repeats)) + 1.0
            return np.where(there[:, :, None] & there[:, None, :], walk, 0.0)
        case _:
            own = np.where(there, u**2 if name == "scale" else 1.0, 0.0)
            return np.asarray(own[:, :, None] * np.eye(repeats))


def _known(value: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Return values (g, r) and stated covariances (g, r, r).

    The u of a missing repeat is so large that the repeat has no weight.
    """
    there = np.isfinite(value)
    wide = np.where(there, u, 1e6 * np.nanmax(u))
    return np.where(there, value, 0.0), np.asarray((wide**2)[:, :, None] * np.eye(value.shape[1]))


def _size(value: Floats, u: Floats, name: TermName) -> float:
    """Return the size at which a term maximises the restricted likelihood of values (g, r)."""
    known, stated = _known(value, u)
    kernel = _kernel(u, name)

    def deviance(log_size: float) -> float:
        inverse = np.linalg.inv(stated + np.exp(2.0 * log_size) * kernel)
        weight = inverse.sum(axis=(1, 2))
        mean = np.einsum("gij,gj->g", inverse, known) / weight
        off = known - mean[:, None]
        chi2 = np.einsum("gi,gij,gj->g", off, inverse, off)
        return float(np.sum(chi2 + np.log(weight) - np.linalg.slogdet(inverse)[1]))

    unit = 1.0 if name == "scale" else float(np.nanmedian(u))
    bounds = (float(np.log(FINE * unit)), float(np.log(COARSE * unit)))
    found = optimize.minimize_scalar(deviance, bounds=bounds, method="bounded")
    return float(np.exp(found.x))


def _held_out(value: Floats, u: Floats, name: TermName | None) -> tuple[Floats, float]:
    """Predict each repeat from the remaining repeats; return the squared errors, and ln p.

    The squared errors (g, r, c) are divided by their variances; they are NaN without a prediction. p is the joint
    probability density of the repeats.
    """
    squares, log_p = np.full(value.shape, np.nan), 0.0
    repeats = value.shape[1]
    wider = _widening(repeats - 2) ** 2
    for c in range(value.shape[2]):
        known, stated = _known(value[:, :, c], u[:, :, c])
        kernel = _kernel(u[:, :, c], name)
        for k in range(repeats):
            rest = np.delete(np.arange(repeats), k)
            size = 0.0 if name is None else _size(value[:, rest, c], u[:, rest, c], name)
            covariance = stated + size**2 * kernel
            inverse = np.linalg.inv(covariance[:, rest][:, :, rest])
            weight = inverse.sum(axis=(1, 2))
            mean = np.einsum("gij,gj->g", inverse, known[:, rest]) / weight
            gain = np.einsum("gj,gji->gi", covariance[:, k][:, rest], inverse)
            error = known[:, k] - mean - np.sum(gain * (known[:, rest] - mean[:, None]), axis=1)
            spread = covariance[:, k, k] - np.sum(gain * covariance[:, rest, k], axis=1)
            spread = spread + (1.0 - gain.sum(axis=1)) ** 2 / weight
            own = stated[:, k, k]
            spread = own + (spread - own) * (wider if name else 1.0)
            there = np.isfinite(value[:, k, c]) & (np.isfinite(value[:, rest, c]).sum(axis=1) > 1)
            squares[there, k, c] = (error**2 / spread)[there]
            log_p -= 0.5 * float(np.sum(np.log(spread[there]) + squares[there, k, c]))
    return squares, log_p
