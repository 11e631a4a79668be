"""What learned differences between meters leave of their errors: each as large as before, but more alike.

A difference says nothing of the error that meters have in common, so that none becomes better known than the best
one is by its own certificate or its maker's limits; a certificate is never corrected, nor its u changed.
Source of the conditioning: JCGM 102:2011, B.1; K. V. Mardia, J. T. Kent, J. M. Bibby, Multivariate Analysis (1979),
theorem 3.2.4.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.budget.meters import Quantity, Size, is_certified, size_of
from bench.analysis.calibration.same_meters import METERS_DRIFT
from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.files.bench.file import BenchFile
from bench.model import Distribution

CONTRADICTS_P: Final = 0.01
"""Differences that certificates and makers' limits allow that seldom are not taken: one of these is wrong."""


@dataclass(frozen=True)
class Told:
    """Differences as learned, of M meters: `values` (M,) about the mean of each group, `covariance` (M, M)."""

    values: Floats
    covariance: Floats
    group: tuple[int, ...]


@dataclass(frozen=True)
class Together:
    """The errors of the voltmeters of a bench with what was learned: `mean` (n,), `covariance` (n, n)."""

    mean: Floats
    covariance: Floats

    @property
    def u(self) -> float:
        """Root mean square of their standard uncertainties."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))

    @property
    def root(self) -> tuple[tuple[float, ...], ...]:
        """What makes of n independent draws of `u` errors with this covariance."""
        size, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(size, 0.0)) / max(self.u, 1e-300)
        return tuple(tuple(row) for row in root.tolist())


def together(
    told: Told, at: Sequence[int | None], prior_u: Floats, certified: Mask, kept: float
) -> Together | str:
    """Return the errors of n meters, `at` which place of `told` each is (None: not there), or why nothing is taken.

    `prior_u` (n,) is their u by certificate or limits, `certified` (n,) where by a certificate. `kept` from 0 to 1
    is the correlation of a meter's error with what it was when the differences were learned.
    """
    n = len(prior_u)
    places = [place if place is not None else -1 for place in at]
    group = np.array([told.group[place] if place >= 0 else -1 - k for k, place in enumerate(places)])
    basis = _contrasts(group)
    if not basis.shape[1] or np.all(certified):
        return "certificates state all of it" if basis.shape[1] else "no two of these meters were compared"
    values = np.where(np.array(places) >= 0, told.values[places], 0.0)
    own = told.covariance[np.ix_(places, places)]
    difference, spread = basis.T @ values, basis.T @ own @ basis
    prior = np.diag(prior_u**2)
    expected = basis.T @ prior @ basis + spread
    chi2 = float(difference @ np.linalg.solve(expected, difference))
    if special.chdtrc(len(difference), chi2) < CONTRADICTS_P:
        return "they contradict what certificates or makers' limits allow: have the voltmeters calibrated"
    gain = kept * prior @ basis @ np.linalg.inv(expected)
    found = Together(gain @ difference, prior - kept * gain @ basis.T @ prior)
    found = _never_over(found, prior, certified)
    covariance = found.covariance.copy()
    for number in np.unique(group):
        same = group == number
        free = same & ~certified
        # what meters have in common no difference tells, however many limits seem to be averaged
        left = np.sqrt(np.maximum(np.min(prior_u[same]) ** 2 - np.diag(covariance), 0.0)) * free
        covariance += np.outer(left, left)
    if np.any(np.diag(covariance) > (1 + 1e-9) * prior_u**2):
        return "the certificates beside them are worse than the makers' limits"
    return Together(found.mean[:n], covariance)


def _contrasts(group: Ints) -> Floats:
    """Return an orthonormal basis (n, k) of the differences within groups."""
    left = np.eye(len(group))
    for number in np.unique(group):
        own = (group == number).astype(np.float64)
        left -= np.outer(own, own) / own.sum()
    size, vectors = np.linalg.eigh(left)
    return np.asarray(vectors[:, size > 0.5])


def _never_over(found: Together, prior: Floats, certified: Mask) -> Together:
    """Return the errors with those of certified meters as their certificates have them, the others after them."""
    if not np.any(certified):
        return found
    a, rest = np.flatnonzero(certified), np.flatnonzero(~certified)
    own = found.covariance[np.ix_(a, a)]
    by = found.covariance[np.ix_(rest, a)] @ np.linalg.inv(own)
    mean, covariance = np.zeros(len(found.mean)), prior.copy()
    mean[rest] = found.mean[rest] - by @ found.mean[a]
    stated = prior[np.ix_(a, a)]
    covariance[np.ix_(rest, a)] = by @ stated
    covariance[np.ix_(a, rest)] = stated @ by.T
    covariance[np.ix_(rest, rest)] = (
        found.covariance[np.ix_(rest, rest)] - by @ own @ by.T + by @ stated @ by.T
    )
    return Together(mean, covariance)


# --- the voltmeters of a bench --------------------------------------------------------------------------


@dataclass(frozen=True)
class LearnedMeters:
    """What a learned file says of the differences of meters, about `day`: of gains (1) and zeros (V)."""

    meters: tuple[str, ...]
    day: datetime.date
    gain: Told
    zero: Told


@dataclass(frozen=True)
class OfMeters:
    """A quantity of a bench's voltmeters as a source of error: its size in words, and how they hang together."""

    size: Size
    together: Together


@dataclass(frozen=True)
class KnownMeters:
    """What a bench's voltmeters are with what was learned, by the name of the source of error.

    `gain` and `offset_v` (x, y, z) are to be added to readings: U (1 + gain) + offset.
    """

    quantities: Mapping[str, OfMeters]
    gain: tuple[float, float, float]
    offset_v: tuple[float, float, float]


def known_meters(
    bench: BenchFile, day: datetime.date, meters: Sequence[str], learned: LearnedMeters
) -> tuple[KnownMeters | None, tuple[str, ...]]:
    """Return what is known of a bench's voltmeters on a day, `meters` their identities, and notes on the rest."""
    apart = abs((day - learned.day).days) / METERS_DRIFT.days
    kept = math.sqrt(max(1.0 - apart**2, 0.0))
    at = [learned.meters.index(meter) if meter in learned.meters else None for meter in meters]
    origin = f"differences learned from exchanged voltmeters, {learned.day}"
    found: dict[str, OfMeters] = {}
    notes = []
    every: tuple[tuple[Quantity, str, Told], ...] = (
        ("voltmeter_gain", "gains", learned.gain), ("voltmeter_offset", "zeros", learned.zero)
    )  # fmt: skip
    for name, words, told in every:
        stated = getattr(bench.uncertainty, name)
        forms = bench.instruments.voltmeters
        sizes = [size_of(name, meter, day) for meter in forms]
        if stated is not None:
            sizes = [Size(stated.to_distribution(), "bench file", stated.dof)] * len(forms)
        certified = np.array([stated is None and is_certified(name, meter) for meter in forms])
        if kept == 0.0:
            own: Together | str = f"in {METERS_DRIFT.days} days voltmeters may drift through their limits"
        else:
            own = together(told, at, np.array([size.distribution.u for size in sizes]), certified, kept)
        if isinstance(own, str):
            notes.append(f"what was learned of how the {words} of the voltmeters differ is not used: {own}")
            continue
        origins = "; ".join(dict.fromkeys(size.origin for size in sizes))
        size = Size(
            Distribution(own.u),
            f"{origins}; {origin}",
            min(s.dof for s in sizes),
            any(s.prior for s in sizes),
        )
        found[name] = OfMeters(size, own)
    if not found:
        return None, tuple(notes)
    notes.append(f"readings corrected by the {origin}; what the voltmeters have in common stays as stated")
    return KnownMeters(
        found, _added(found, bench, "voltmeter_gain"), _added(found, bench, "voltmeter_offset")
    ), tuple(notes)


def _added(found: Mapping[str, OfMeters], bench: BenchFile, name: str) -> tuple[float, float, float]:
    by_channel = dict.fromkeys(CHANNELS, 0.0)
    if name in found:
        for meter, mean in zip(bench.instruments.voltmeters, found[name].together.mean.tolist(), strict=True):
            for channel in meter.channels:
                by_channel[channel] = -mean
    return by_channel["x"], by_channel["y"], by_channel["z"]
