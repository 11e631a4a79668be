"""Error sources, also those learned from other runs, and the tilt rate of the foundation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, Floats, rms
from bench.base.languages import message
from bench.calibration.design import EffectUnknown
from bench.calibration.noise import KnownNoise, KnownStand
from bench.config.bench_file.file import BenchFile
from bench.model.conditions import Conditions
from bench.model.geometry import STAND_ANGLES, Block, Distribution, Installation
from bench.readings.columns import drift_rad_s
from bench.readings.corrected import DAY, FOUNDATION
from bench.readings.table import Readings

Common = Literal["reading", "setting", "angle", "orientation", "mounting", "time", "run"]
"""The readings that share one random draw of an error.

In this order: one signal; the three signals of a setting of the head; all settings at one angle; all readings in
one orientation; one mounting; readings close in time; the whole run.
"""

Group = Literal["stand", "scale", "block"]
"""The group of a source.

In this order: errors of stand and readings, which `bench calibrate` states; errors of scale and zero, which no
reading shows; nonlinearity and effects of the block.
"""

_SHOWN: Final[Mapping[str, tuple[str, float]]] = {
    "rad": ("arcsec", ARCSEC),
    "rad/s": ("arcsec a day", ARCSEC / DAY),
    "V": ("µV", 1e-6),
    "1": ("ppm", 1e-6),
    "g": ("µg", 1e-6),
    "1/g": ("µg/g²", 1e-6),
    "1/g^2": ("µg/g³", 1e-6),
}


@dataclass(frozen=True)
class ErrorSource:
    """An error source: the distribution of its error, and the readings that share one random draw of it.

    The error is in `unit` (SI); `common` says which readings share a draw. `origin` says where the
    distribution comes from; `prior` marks a plausible distribution that nobody stated. `factors` are the
    numbers that convert the error to signals, such as temperature coefficients (per K). For a parameter of an
    effect, `effect` is set, and `written_in` has the unit of model files and its value in SI. The error acts
    on `channels`. For correlated draws, `root` (q, k) turns k independent draws into q correlated ones. If
    the source describes means of stand angles over mountings, `angles` names these angles. `correlation_s` is
    the correlation time of an error that is common in "time".
    """

    name: str
    symbol: str
    unit: str
    distribution: Distribution
    common: Common
    group: Group
    origin: str
    dof: float = math.inf
    prior: bool = False
    factors: Mapping[str, float] | None = None
    effect: EffectUnknown | None = None
    channels: tuple[str, ...] = CHANNELS
    root: tuple[tuple[float, ...], ...] | None = None
    angles: tuple[str, ...] = ()
    correlation_s: float = math.inf
    written_in: tuple[str, float] = ("", 1.0)

    @property
    def kind(self) -> str:
        """The name without the meter or rail: "voltmeter_gain" of "voltmeter_gain[x]"."""
        return self.name.partition("[")[0]

    @property
    def u(self) -> float:
        """Standard uncertainty, in `unit`."""
        return self.distribution.u

    @property
    def shown(self) -> str:
        """The standard uncertainty in the unit in which files state it: "1.67 arcsec"."""
        unit, size = _SHOWN.get(self.unit, (self.unit, 1.0)) if self.effect is None else self.written_in
        if self.unit == "V" and self.effect is None and self.u >= 1e-3:
            unit, size = "mV", 1e-3
        return f"{self.u / size:.3g} {unit}"

    @property
    def on_channels(self) -> Floats:
        """1 for each channel that the error acts on, else 0, shape (3,)."""
        return np.array([float(channel in self.channels) for channel in CHANNELS])

    def acting(self, draws: Floats) -> Floats:
        """Return the effects (..., k) of the source's k independent draws, each of one standard uncertainty.

        `draws` (..., q) are the effects of the source's q errors, each error being one unit.
        """
        return self.u * draws if self.root is None else self.u * draws @ np.array(self.root)

    def sized(self, u: float) -> ErrorSource:
        """Return the source with a normal distribution of standard uncertainty `u`."""
        return replace(self, distribution=Distribution(u), origin=message("as asked"))


MEANS: Final = "stand_means"
LEARNED: Final = message("learned of the bench")


def learned_sources(
    stated: Sequence[ErrorSource], known: KnownStand, conditions: Conditions
) -> tuple[ErrorSource, ...]:
    """Return the stand's error sources for the mountings in `conditions`, given knowledge from other runs.

    An angle of a mounting is the sum of a mean, which mountings share, and a deviation of this mounting. The
    deviations keep the names of the `stated` sources; the means form one source with correlated draws. Reading
    noise becomes one source per channel.
    """
    return tuple(_sources(stated, known, conditions))


def _sources(
    stated: Sequence[ErrorSource], known: KnownStand, conditions: Conditions
) -> Iterator[ErrorSource]:
    labels = [mount.installation for mount in conditions.mounts]
    clamped = conditions.clamped
    angles = [s for s in stated if s.name in STAND_ANGLES and s.u > 0]
    yield from _means(tuple(s.name for s in angles), known, labels)
    for source in stated:
        if source in angles:
            told = [known.place(source.name, label) is not None for label in labels]
            own = np.where(told, known.remount.get(source.name, 0.0), source.u)
            origin = message(f"{LEARNED}: what a remount adds")
            learned = replace(source, origin=origin, prior=False, dof=np.inf) if any(told) else source
            yield _with_root(learned, own[:, None] * (clamped[:, None] == np.arange(len(clamped))))
        elif known.noise is not None and source.name in ("voltmeter_error", "setting_error"):
            yield from _noise(source, known.noise)
        else:
            yield source


def _means(kinds: tuple[str, ...], known: KnownStand, labels: Sequence[str]) -> Iterator[ErrorSource]:
    """Yield one source for the means of all kinds; its draws are ordered by kind, then by mounting."""
    size, axes = np.linalg.eigh(known.covariance)
    half = axes * np.sqrt(np.maximum(size, 0.0))
    places = [known.place(kind, label) for kind in kinds for label in labels]
    root = np.array([np.zeros(len(half)) if place is None else half[place] for place in places])
    if root.size and np.any(root):
        plain = ErrorSource(
            MEANS, "α mean", "rad", Distribution(1.0), "run", "stand",
            message(f"{LEARNED}: means of all mountings"), angles=kinds,
        )  # fmt: skip
        yield _with_root(plain, root)


def _with_root(source: ErrorSource, root: Floats) -> ErrorSource:
    """Return the source with draws correlated by the matrix `root` (q, k), SI.

    Its u is the root mean square of the u of the q draws.
    """
    u = rms(np.sqrt(np.sum(root**2, axis=1)))
    return replace(
        source,
        distribution=Distribution(u),
        root=tuple(tuple(row) for row in (root / max(u, 1e-300)).tolist()),
    )


def _noise(source: ErrorSource, noise: KnownNoise) -> Iterator[ErrorSource]:
    if source.name == "setting_error":
        yield replace(
            source,
            distribution=Distribution(noise.setting_rad),
            dof=noise.setting_dof,
            origin=LEARNED,
            prior=False,
        )
        return
    for channel, size, dof in zip(CHANNELS, noise.channels.tolist(), noise.channel_dof.tolist(), strict=True):
        yield replace(
            source, name=f"{source.name}[{channel}]", distribution=Distribution(size), dof=dof, origin=LEARNED,
            prior=False, channels=(channel,),
        )  # fmt: skip


NAME = "foundation"


@dataclass(frozen=True)
class TiltRate:
    """Standard uncertainties, rad/s, of the rates at which the platform tilts along the shaft and across it."""

    along_rad_s: float
    across_rad_s: float
    origin: str
    prior: bool = False
    dof: float = np.inf

    @property
    def shown(self) -> str:
        """The tilt rates in words."""
        along, across = (rate * DAY / ARCSEC for rate in (self.along_rad_s, self.across_rad_s))
        return (
            f"{along:.2g} and {across:.2g} arcsec a day" if along != across else f"{along:.2g} arcsec a day"
        )

    def source(self) -> ErrorSource:
        """Return the tilt rate as one error source, with the larger of the two standard uncertainties."""
        size = replace(FOUNDATION, limit=max(self.along_rad_s, self.across_rad_s), shape="normal", k=1.0)
        return ErrorSource(NAME, "α1, α2", "rad/s", size, "run", "stand", self.origin, self.dof, self.prior)

    def parts(
        self, conditions: Conditions, block: Block, across: Floats, installations: Mapping[str, Installation],
        functionals: Floats,
    ) -> Floats:  # fmt: skip
        """Return the changes (m, 2) of m linear functionals of the readings due to the two tilt rates.

        Each tilt rate equals its standard uncertainty. `functionals` are (m, n, 3). `across` (n, 3) is the
        derivative of the signals by an angle about the shaft.
        """
        tilts = np.stack(tilt_patterns(conditions, block, across, installations))
        return np.asarray(
            np.einsum("mni,qni->mq", functionals, tilts) * [self.along_rad_s, self.across_rad_s]
        )


def tilt_patterns(
    conditions: Conditions, block: Block, across: Floats, installations: Mapping[str, Installation]
) -> tuple[Floats, Floats]:
    """Return the changes of the signals (V) by a tilt rate of 1 rad/s along and across the shaft.

    Each of the two is (n, 3).
    """
    time_s = np.nan_to_num(conditions.elapsed_s)
    begun = np.array([time_s[conditions.mount == m].min() for m in range(len(conditions.mounts))])
    gone_s = (time_s - begun[conditions.mount])[:, None]
    known = [installations.get(mount.installation) for mount in conditions.mounts]
    # a tilt α1 gives the specific force a component along y of the platform
    on_block = np.stack([np.zeros(3) if i is None else i.block_from_platform[:, 1] for i in known])
    return (on_block @ block.K.T)[conditions.mount] * gone_s, across * gone_s


def foundation_of(readings: Readings | None, bench: BenchFile, *, levelled: bool) -> TiltRate | None:
    """Return the foundation's tilt rate; None if nothing states it and the platform was not `levelled`.

    Levellings recorded with the readings take precedence over the bench file. Without both, the rate of the
    paper is assumed for a levelled platform.
    """
    seen = None if readings is None else drift_rad_s(readings.extra)
    if seen is not None:
        return TiltRate(*seen, message("the level, read again after the levelling"))
    stated = bench.stand.foundation
    if stated is not None:
        rate = stated.to_distribution().u / DAY
        return TiltRate(rate, rate, message("bench file"), dof=stated.dof)
    if not levelled:
        return None
    origin = message("not stated: ±2 arcsec a day, the paper's")
    return TiltRate(FOUNDATION.u, FOUNDATION.u, origin, prior=True)
