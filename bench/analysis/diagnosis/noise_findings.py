"""The noise that was found, held against what the readings' own scatter and the bench file say of it.

What no candidate explains passes for noise. So noise that is larger than anybody stated is a finding: something
may hide in it. Noise that is smaller than stated is none; a bench file states limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import special

from bench.analysis.diagnosis.posterior import NoiseSize
from bench.base.arrays import ARCSEC, rms
from bench.base.numbers import quantity
from bench.readings.table import Readings

LARGER: Final = 2.0
"""Noise is a finding where it is more than so many times what is stated,"""
SIGNIFICANT: Final = 1e-4
"""and chance alone makes it so much larger less often than this."""

OWN_SCATTER: Final = "the readings' own scatter"
BENCH_FILE: Final = "the bench file"


@dataclass(frozen=True)
class NoiseFinding:
    """Noise of a reading ("reading") or a setting ("setting") that is larger than the `source` states.

    `found` and `stated` in `unit`, `factor` times one another; `p` is the probability of so much by chance.
    """

    what: str
    found: float
    stated: float
    unit: str
    factor: float
    p: float
    source: str

    @property
    def words(self) -> str:
        """A sentence: what, by how much, what it may mean."""
        of = "a reading" if self.what == "reading" else "a setting of the head"
        found, stated = (quantity(size, self.unit) for size in (self.found, self.stated))
        return (
            f"the noise of {of} is {found}, {self.factor:.1f} times the {stated} that {self.source} "
            f"{'say' if self.source == OWN_SCATTER else 'says'}: what the model lacks may hide in it"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        return asdict(self) | {"words": self.words}


class _Stated(NamedTuple):
    size: float
    freedom: float
    source: str


def noise_findings(
    noise: NoiseSize,
    readings: Readings,
    stand_u: Mapping[str, float],
    typical_slope: float,
    digit: float = 0.0,
) -> tuple[NoiseFinding, ...]:
    """Return where the noise found is larger than stated, significantly and by more than a factor of two.

    `stand_u` has the "setting_error" (rad) and the "voltmeter_error" (V) of the bench file, `typical_slope` is
    how a setting error shows in all three signals, unit of the signal per rad, `digit` the step of the signals'
    last digit: rounding to it is expected.
    """
    return tuple(_findings(noise, readings, stand_u, typical_slope, digit))


def _findings(
    noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], typical_slope: float, digit: float
) -> Iterator[NoiseFinding]:
    stated = _stated(readings, stand_u, digit / np.sqrt(12.0))
    if stated is not None:
        factor = noise.reading / stated.size
        p = float(special.fdtrc(noise.freedom, min(stated.freedom, 1e9), factor**2))
        if factor > LARGER and p < SIGNIFICANT:
            yield NoiseFinding("reading", noise.reading, stated.size, readings.unit, factor, p, stated.source)
    setting = stand_u.get("setting_error", 0.0)
    if setting > 0.0 and noise.setting_rad > LARGER * setting:
        along = [noise.reading**2 + (size * typical_slope) ** 2 for size in (noise.setting_rad, setting)]
        freedom = noise.freedom / 3.0
        p = float(special.chdtrc(freedom, freedom * along[0] / along[1]))
        if p < SIGNIFICANT:
            found, limit = noise.setting_rad / ARCSEC, setting / ARCSEC
            yield NoiseFinding("setting", found, limit, "arcsec", found / limit, p, BENCH_FILE)


def _stated(readings: Readings, stand_u: Mapping[str, float], rounding: float) -> _Stated | None:
    """Return the noise of a reading as it is stated: the larger of what its samples show and the bench file says.

    Either is without that of `rounding`. An error that is fresh in each reading and alike in all its samples, as
    that of the shipped stand, only the bench file knows: its word counts where it is larger.
    """
    stated = []
    size = stand_u.get("voltmeter_error", 0.0)
    if size > 0.0 and readings.unit == "V":
        stated.append(_Stated(float(np.hypot(size, rounding)), np.inf, BENCH_FILE))
    count = readings.samples[:, None] * np.isfinite(readings.signal_sd) * (readings.signal_sd > 0.0)
    sampled = count > 1
    if np.any(sampled & readings.is_oriented[:, None]):
        of_mean = readings.signal_sd[sampled] / np.sqrt(count[sampled])
        shown = float(np.hypot(rms(of_mean), rounding))
        stated.append(_Stated(shown, float(np.sum(count[sampled] - 1)), OWN_SCATTER))
    return max(stated, key=lambda each: each.size, default=None)
