"""What other runs of a bench told: angles of the stand, sizes of noise, errors of the same meters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, rms
from bench.calibration.result import Noise
from bench.stats.repeats_likelihood import LEAST_DOF

CONTRADICTS_P: Final = 0.01
"""Noise of a run that is that much unlike what is known is taken as the run has it."""

LEAST_SIGNALS: Final = 1.5 * LEAST_DOF
"""So many free signals tell a size that well: two of three tell of the reading noise, the third of the setting."""


@dataclass(frozen=True)
class KnownNoise:
    """Sizes (3,) of the channels in the unit and of the setting, rad, each with degrees of freedom.

    Each variance has a scaled inverse chi-square distribution: it counts like repeats with as many degrees of
    freedom. Those of other runs hold how far the noise of one run may be from that of the others; those of a
    statement (`stated`) count only as far as readings lack them.
    """

    channels: Floats
    channel_dof: Floats
    setting_rad: float
    setting_dof: float
    stated: bool = False

    @classmethod
    def of_bench(cls, sizes: Mapping[str, float]) -> KnownNoise | None:
        """Return what a bench file's sizes by name say; None where it states no noise of the voltmeter."""
        reading, setting = sizes.get("voltmeter_error", 0.0), sizes.get("setting_error", 0.0)
        if not reading > 0.0:
            return None
        return cls(np.full(3, reading), np.full(3, LEAST_DOF), setting, LEAST_DOF, stated=True)

    def beside(self, signals: float) -> KnownNoise | None:
        """Return what counts beside a fit that leaves so many signals free; None where they suffice."""
        if not self.stated:
            return self
        lacking = LEAST_DOF * (1.0 - max(signals, 0.0) / LEAST_SIGNALS)
        if lacking <= 0.0:
            return None
        return replace(self, channel_dof=np.full(3, lacking), setting_dof=lacking)

    @property
    def dof(self) -> float:
        """Degrees of freedom of the reading noise, as those of `Noise.reading_dof`."""
        return float(np.mean(self.channel_dof))

    def given(self) -> Noise:
        """Return the sizes as those of readings that are yet to come."""
        x, y, z = self.channels.tolist()
        return Noise(rms(self.channels), self.setting_rad, np.inf, "given", channels=(x, y, z))

    def times(self, part: float) -> KnownNoise:
        """Return the sizes so many times as large."""
        return replace(self, channels=part * self.channels, setting_rad=part * self.setting_rad)

    def joined(self, own: Noise) -> Noise:
        """Return the sizes of a run with what was known of them; the run's own where the two contradict."""
        if np.isinf(own.dof) or self.beside(own.dof) is None:
            return own
        dof = np.asarray(own.channel_dof) if own.channel_dof is not None else np.full(3, own.reading_dof)
        if self.contradicts(own.by_channel, dof):
            return own
        channels, whole = _pooled(own.by_channel, dof, self.channels, self.channel_dof)
        setting = self._setting(own)
        x, y, z = channels.tolist()
        nx, ny, nz = whole.tolist()
        return replace(
            own, reading=rms(channels), setting_rad=setting, dof=1.5 * float(np.mean(whole)),
            channels=(x, y, z), channel_dof=(nx, ny, nz),
        )  # fmt: skip

    def contradicts(self, sizes: Floats, dof: Floats) -> bool:
        """Whether sizes (3,) of a run with degrees of freedom (3,) are none that the known ones allow."""
        ratio = np.square(sizes / self.channels)
        above = special.fdtrc(dof, self.channel_dof, ratio)
        chance = 2.0 * np.minimum(above, 1.0 - above)
        return bool(np.min(chance) < CONTRADICTS_P / 3)

    def _setting(self, own: Noise) -> float:
        """Variances weighed by what is known of each; a run alone often knows next to nothing of its own."""
        known = self.setting_rad**2
        if own.setting_limits_rad is None or not np.isfinite(own.setting_limits_rad[1]):
            return self.setting_rad
        u_own = (own.setting_limits_rad[1] ** 2 - own.setting_rad**2) / 2
        u_known = known * np.sqrt(2.0 / self.setting_dof)
        if not u_own > 0 or not u_known > 0:
            return own.setting_rad
        weights = np.array([u_own, u_known]) ** -2.0
        return float(np.sqrt(weights @ np.array([own.setting_rad**2, known]) / weights.sum()))


def _pooled(one: Floats, dof: Floats, other: Floats, other_dof: Floats) -> tuple[Floats, Floats]:
    whole = dof + other_dof
    return np.sqrt((dof * one**2 + other_dof * other**2) / whole), whole


@dataclass(frozen=True)
class KnownStand:
    """The stand's angles by kind and, where installations have means of their own, by installation.

    `keys` (k,) are pairs of a name in `STAND_ANGLES` and an installation (empty: of all), `mean` (k,) rad,
    `covariance` (k, k) rad^2 that of the means; `remount` are standard deviations of a mounting's own departure by
    the name, rad. `noise` is what is known of the noise, None where nothing is.
    """

    keys: tuple[tuple[str, str], ...]
    mean: Floats
    covariance: Floats
    remount: Mapping[str, float]
    noise: KnownNoise | None = None

    def place(self, name: str, installation: str) -> int | None:
        """Return which mean an angle of a mounting has, None where nothing is known of it."""
        for key in ((name, ""), (name, installation)):
            if key in self.keys:
                return self.keys.index(key)
        return None

    def prior(self, unknowns: Sequence[tuple[str, str]], stated_u: Floats) -> tuple[Floats, Floats]:
        """Return means (q,) and covariance (q, q) of angles (name, installation); as stated where none is known."""
        places = [self.place(name, installation) for name, installation in unknowns]
        known = np.array([place is not None for place in places], dtype=bool)
        at = np.array([place or 0 for place in places], dtype=np.int64)
        mean = np.where(known, self.mean[at], 0.0)
        both = np.outer(known, known)
        covariance = np.where(both, self.covariance[np.ix_(at, at)], 0.0)
        own = [
            self.remount[name] if k else u for (name, _), k, u in zip(unknowns, known, stated_u, strict=True)
        ]
        return mean, covariance + np.diag(np.square(own))


METERS_DRIFT: Final = timedelta(days=90)
"""In so long a meter may drift through its limits: those of data sheets are of 90 days."""
ONE_SITTING: Final = timedelta(days=1)
"""Within so long a meter stays as it is: data sheets state 24 hours' limits apart, and they are of this kind."""


def drifted(
    first: tuple[Sequence[str], datetime | None], later: tuple[Sequence[str], datetime | None]
) -> float:
    """Return the part of the meters' limits by which their errors may differ, from 0 (they cancel) to 1.

    Each side is the identities of its meters and the time; other meters, unnamed ones and times that nobody told
    cancel nothing.
    """
    (meters, when), (other, then) = first, later
    if not meters or tuple(meters) != tuple(other) or when is None or then is None:
        return 1.0
    apart = abs(then - when)
    return 0.0 if apart <= ONE_SITTING else min(apart / METERS_DRIFT, 1.0)
