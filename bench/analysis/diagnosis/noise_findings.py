"""The noise that was found, held against what the readings' own scatter and the bench file say of it.

What no candidate explains passes for noise. So noise that is larger than anybody stated is a finding: something
may hide in it. Noise that is smaller than stated is none; a bench file states limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import special

from bench.analysis.diagnosis.linear import RunSizes
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

    `found` and `stated` in `unit`, `factor` times one another; `p` is the probability of so much by chance, all
    runs counted. It is that of the run with these `series`, where runs have noise of their own.
    """

    what: str
    found: float
    stated: float
    unit: str
    factor: float
    p: float
    source: str
    series: tuple[int, ...] = ()

    @property
    def words(self) -> str:
        """A sentence: what, by how much, what it may mean."""
        of = "a reading" if self.what == "reading" else "a setting of the head"
        if self.series:
            of += f" of series {', '.join(str(number) for number in self.series)}"
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
    by_run: RunSizes | None = None,
) -> tuple[NoiseFinding, ...]:
    """Return where the noise found is larger than stated, significantly and by more than a factor of two.

    `stand_u` has the "setting_error" (rad) and the "voltmeter_error" (V) of the bench file, `typical_slope` is
    how a setting error shows in all three signals, unit of the signal per rad, `digit` the step of the signals'
    last digit: rounding to it is expected. Runs with noise of their own, `by_run`, are each held against what is
    stated of them.
    """
    of_readings = _of_readings if by_run is None else partial(_of_runs, by_run)
    found = [*of_readings(noise, readings, stand_u, digit), *_of_settings(noise, stand_u, typical_slope)]
    return tuple(one for one in found if one.factor > LARGER and one.p < SIGNIFICANT)


def _of_readings(
    noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], digit: float
) -> Iterator[NoiseFinding]:
    """Yield the noise of readings beside what is stated of it."""
    stated = _stated(readings, stand_u, digit / np.sqrt(12.0))
    if stated is not None:
        factor = noise.reading / stated.size
        p = float(special.fdtrc(noise.freedom, min(stated.freedom, 1e9), factor**2))
        yield NoiseFinding("reading", noise.reading, stated.size, readings.unit, factor, p, stated.source)


def _of_runs(
    by_run: RunSizes, noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], digit: float
) -> Iterator[NoiseFinding]:
    """Yield that of each run by itself."""
    runs = len(by_run.sizes)
    for number in range(runs):
        own = readings.select(readings.run == number)
        size = noise.reading * float(by_run.sizes[number])
        of_run = replace(noise, reading=size, freedom=max(round(float(by_run.freedom[number])), 1))
        series = tuple(int(one) for one in np.unique(own.series))
        for found in _of_readings(of_run, own, stand_u, digit):
            yield replace(found, p=min(runs * found.p, 1.0), series=series)


def _of_settings(
    noise: NoiseSize, stand_u: Mapping[str, float], typical_slope: float
) -> Iterator[NoiseFinding]:
    """Yield the error of settings beside what the bench file says."""
    setting = stand_u.get("setting_error", 0.0)
    if setting > 0.0:
        along = [noise.reading**2 + (size * typical_slope) ** 2 for size in (noise.setting_rad, setting)]
        freedom = noise.freedom / 3.0
        p = float(special.chdtrc(freedom, freedom * along[0] / along[1]))
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
