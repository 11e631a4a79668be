"""An error of a bench by name: how large, how distributed, what it is common to, where its size comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from bench.analysis.calibration.design import EffectUnknown
from bench.base.arrays import ARCSEC, CHANNELS, Floats
from bench.model import Distribution
from bench.readings.levelled import DAY

Common = Literal["reading", "setting", "angle", "orientation", "mounting", "time", "run"]
"""What shares one draw of an error: a single signal, the three of a setting of the head, all settings at one angle
of it, all readings in one orientation, all of one mounting, readings soon after each other, everything."""

Group = Literal["stand", "scale", "block"]
"""Which errors a source belongs to: the stand's and the readings' own, which `bench calibrate` states; those
of scale and zero, which no reading shows; what the model of the block leaves out or has in addition."""

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
    """An error with its distribution in `unit` (SI), what it is common to and its degrees of freedom.

    `origin` says where the size comes from; `prior` that it is a plausible size and not a stated one.
    `factors` scale the error where it acts (the temperature coefficients, per K). The parameter of an effect
    has `effect`, and in `written_in` the unit in which files state it with its size in SI. `channels` are
    those that it is of: K2 and K3 are not of one for which the model has such an effect, a voltmeter's are its own.
    Draws that hang together have a `root`: what makes theirs (q) of independent ones (k), q rows of k.
    `angles` are the kinds of the stand's angles whose means of all mountings it is. What readings soon after each
    other share has a correlation time, `correlation_s`.
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
        """Its name without whose it is: "voltmeter_gain" of "voltmeter_gain[x]"."""
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
        """1 for a channel that it is of, 0 for another, shape (3,)."""
        return np.array([float(channel in self.channels) for channel in CHANNELS])

    def acting(self, draws: Floats) -> Floats:
        """Return what each of its draws (..., q) does that are one unit large, for draws one u large."""
        return self.u * draws if self.root is None else self.u * draws @ np.array(self.root)

    def sized(self, u: float) -> ErrorSource:
        """Return the source with another standard uncertainty, normally distributed."""
        return replace(self, distribution=Distribution(u), origin="as asked")
