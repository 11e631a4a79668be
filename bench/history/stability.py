"""A static record of a block at rest, and how long a reading should average by its Allan deviation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.computing import tracked
from bench.base.numbers import read_number
from bench.base.text import shortened
from bench.calibration.result import CalibrationError
from bench.readings.columns import OVERLOAD
from bench.readings.csv import LISTED_AT_ONCE, ReadingsError, split_table
from bench.readings.table import UNITS
from bench.stats.allan import AllanCurve, NoiseTerms, allan_curve, fit_terms

LEAST_SAMPLES: Final = 32
EXAMPLE: Final = "time_s,ux_v,uy_v,uz_v"
STEADY: Final = 0.01
"""The rate in each tenth of a record may differ by this part: the Allan deviation hardly knows it."""


@dataclass(frozen=True)
class StaticRecord:
    """Signals (n, 3) in `unit`, one every `interval_s` seconds, as `source` has them."""

    source: str
    unit: str
    interval_s: float
    signal: Floats

    @property
    def duration_s(self) -> float:
        """Duration of the record, s."""
        return self.interval_s * len(self.signal)

    @property
    def mean(self) -> Floats:
        """Means of the three signals."""
        return np.asarray(self.signal.mean(axis=0), dtype=np.float64)

    @property
    def drift_per_s(self) -> Floats:
        """Slope of the straight line through each signal, unit/s."""
        time = self.interval_s * (np.arange(len(self.signal)) - (len(self.signal) - 1) / 2)
        return np.asarray(time @ (self.signal - self.mean) / (time @ time), dtype=np.float64)


def read_static(path: Path) -> StaticRecord:
    """Read a static record: a CSV file with `time_s` and three signal columns of one unit (`ux_v`, …).

    Further columns are left aside. Raises `ReadingsError` for a file that lacks a column or has cells that are
    no numbers (the first 20 are listed with line and column), `CalibrationError` as `from_columns` does.
    """
    header, body = split_table(path, EXAMPLE)
    suffixes = [s for s in UNITS if any(f"u{axis}_{s}" in header for axis in "xyz")]
    if len(suffixes) > 1:
        raise ReadingsError(
            f"{path}, line 1: signal columns in different units ({', '.join(suffixes)}); all three must be alike"
        )
    suffix = suffixes[0] if suffixes else "v"
    names = ["time_s", *(f"u{axis}_{suffix}" for axis in "xyz")]
    missing = [name for name in names if name not in header]
    if missing:
        raise ReadingsError(
            f"{path}, line 1: column {', '.join(missing)} is missing; a static record has {EXAMPLE} "
            f"(or _{', _'.join(s for s in UNITS if s != 'v')} for _v)"
        )
    places = [header.index(name) for name in names]
    bad: list[str] = []
    rows = [_row(path, line, cells, places, names, bad) for line, cells in body]
    if bad:
        more = [f"… and {len(bad) - LISTED_AT_ONCE} more"] if len(bad) > LISTED_AT_ONCE else []
        raise ReadingsError(
            "\n".join([*bad[:LISTED_AT_ONCE], *more, "nothing was used; a record has no holes: cut it there"])
        )
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return from_columns(str(path), UNITS[suffix], table[:, 0], table[:, 1:])


def from_columns(source: str, unit: str, time_s: Floats, signal: Floats) -> StaticRecord:
    """Make a record of times (n,) and signals (n, 3).

    Raises `CalibrationError` when there are fewer than 32 samples, a number is missing, or the times do not
    rise steadily: by one interval within half of it, at the same rate to 1 % throughout.
    """
    if len(time_s) < LEAST_SAMPLES:
        raise CalibrationError(
            f"{source}: {len(time_s)} samples; an Allan deviation needs {LEAST_SAMPLES} or more, and tells "
            "something of averaging over a quarter of the record at most"
        )
    whole = np.isfinite(time_s) & np.isfinite(signal).all(axis=1)
    if not np.all(whole):
        raise CalibrationError(
            f"{source}: sample {int(np.argmin(whole)) + 1} is not a number or has no time; cut the record there"
        )
    steps = np.diff(time_s)
    usual = float(np.median(steps))
    if usual <= 0 or np.any(steps <= 0):
        i = int(np.argmin(steps))
        raise CalibrationError(
            f"{source}: time_s does not rise after sample {i + 1} ({time_s[i]:g} s, then {time_s[i + 1]:g} s); "
            "a record is one stretch in order"
        )
    odd = np.abs(steps - usual) > 0.5 * usual
    if np.any(odd):
        i = int(np.argmax(odd))
        raise CalibrationError(
            f"{source}: time_s is not uniform: {steps[i]:g} s after sample {i + 1} (at {time_s[i]:g} s), "
            f"{usual:g} s elsewhere; cut the record there, or sample it anew at a steady rate"
        )
    rates = np.array([part.mean() for part in np.array_split(steps, 10)]) / steps.mean() - 1.0
    if np.max(np.abs(rates)) > STEADY:
        raise CalibrationError(
            f"{source}: the sampling interval changes by {100 * float(np.ptp(rates)):.1f} % along the record; "
            "sample it anew at a steady rate"
        )
    return StaticRecord(source, unit, float(steps.mean()), np.asarray(signal, dtype=np.float64))


def _row(
    path: Path, line: int, cells: list[str], places: list[int], names: list[str], bad: list[str]
) -> list[float]:
    """Return time and signals of a row; its mistakes are added to `bad`."""
    values = [math.nan] * 4
    for k, (place, name) in enumerate(zip(places, names, strict=True)):
        text = cells[place].strip() if place < len(cells) else ""
        try:
            values[k] = read_number(text)
        except ValueError:
            values[k] = math.nan
        if not abs(values[k]) < OVERLOAD:
            bad.append(f"{path}, line {line}, column {name}: expected a number, got {shortened(text)!r}")
    return values


FLAT: Final = -0.25
"""Slope of the logarithms at which the deviation counts as flat: half of that of white noise."""
LEAST_OF_A_READING: Final = 10
"""A reading has so many samples at least, so that their scatter tells of the noise."""
REJECTS_LINE: Final = 1.0
"""Integration times of whole power-line cycles reject the line; shorter ones do not."""


@dataclass(frozen=True)
class Averaging:
    """The averaging time to use for a signal, s, the noise that then remains, and the reason.

    `reached` is false where a size was asked for that no averaging time of the record reaches.
    """

    tau_s: float
    deviation: float
    why: str
    reached: bool = True


@dataclass(frozen=True)
class ReadingAdvice:
    """Samples of a reading and power-line cycles of each; `tau_s` is the time that they average over."""

    samples: int
    nplc: float
    tau_s: float

    def line(self) -> str:
        """Return the advice as a line of a procedure file."""
        return f"reading: {{samples: {self.samples}, nplc: {self.nplc:g}}}"


def averaging(curve: AllanCurve, terms: NoiseTerms, wanted: float | None = None) -> Averaging:
    """Return the averaging time for a signal.

    With `wanted`, the shortest of the curve's times at which the upper limit (95 %) of the Allan deviation is
    no more. Else where the noise terms stop falling: the slope there is half of that of white noise, and longer
    averages gain little; or the longest time that the curve has, where they still fall.
    """
    _, high = curve.limits(terms.freedom)
    if wanted is not None:
        enough = high <= wanted
        if np.any(enough):
            k = int(np.argmax(enough))
            return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), "the size asked for")
        k = int(np.argmin(high))
        why = f"the size asked for is not reached; here it is least, at most {high[k]:.2g}"
        return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), why, reached=False)
    fine = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 400)
    flat = terms.slope(fine) >= FLAT
    if flat[0]:
        tau, why = float(curve.tau_s[0]), "the deviation does not fall from the first sample on"
    elif np.any(flat):
        tau, why = float(fine[int(np.argmax(flat))]), "from here on longer averages gain little"
    else:
        tau, why = float(curve.tau_s[-1]), "the deviation still falls; the record is too short to show more"
    return Averaging(tau, float(np.interp(tau, curve.tau_s, curve.deviation)), why)


def reading_advice(
    tau_s: float, line_frequency_hz: float, nplc: Sequence[float], most_samples: int
) -> ReadingAdvice:
    """Return samples and NPLC whose product averages over `tau_s` at least.

    The longest integration time that leaves ten samples, of the meter's `nplc` (power-line cycles) that
    reject the line. Raises `CalibrationError` when the meter cannot average so long in one reading.
    """
    cycles = tau_s * line_frequency_hz
    usable = sorted(n for n in nplc if n >= REJECTS_LINE)
    if not usable:
        raise CalibrationError("the voltmeters have no integration time of a whole power-line cycle")
    fitting = [n for n in usable if n * LEAST_OF_A_READING <= cycles] or usable[:1]
    each = fitting[-1]
    samples = max(LEAST_OF_A_READING, int(np.ceil(cycles / each - 1e-9)))
    if samples > most_samples:
        raise CalibrationError(
            f"an averaging time of {tau_s:.3g} s takes {samples} samples of {each:g} power-line cycles, but a "
            f"reading has {most_samples} at most; ask for a larger size with --size"
        )
    return ReadingAdvice(samples, each, samples * each / line_frequency_hz)


@dataclass(frozen=True)
class Stability:
    """The analysis of a record: curve, noise terms, averaging time of each channel, and one reading for all.

    `advice` is None where the meters cannot average so long in one reading: `no_advice` says why.
    """

    record: StaticRecord
    line_frequency_hz: float
    curves: tuple[AllanCurve, ...]
    terms: tuple[NoiseTerms, ...]
    averages: tuple[Averaging, ...]
    advice: ReadingAdvice | None
    no_advice: str = ""

    @property
    def longest_s(self) -> float:
        """The averaging time that suits all channels, s."""
        return max(average.tau_s for average in self.averages)


def stability_of(
    record: StaticRecord,
    integration_s: float,
    size: float | None,
    line_frequency_hz: float,
    nplc: Sequence[float],
    most_samples: int,
) -> Stability:
    """Return the analysis of a record whose meters integrated each sample for `integration_s`.

    `size` is the noise that a reading may have, unit of the signals; None: where longer averages gain little.
    """
    channels = tracked(range(3), "Allan deviation of the channels")
    curves = tuple(allan_curve(record.signal[:, i], record.interval_s) for i in channels)
    terms = tuple(fit_terms(curve) for curve in tracked(curves, "noise terms of the channels"))
    averages = tuple(averaging(c, t, size) for c, t in zip(curves, terms, strict=True))
    found = Stability(record, line_frequency_hz, curves, terms, averages, None)
    integrated_s = found.longest_s * integration_s / record.interval_s
    try:
        advice = reading_advice(integrated_s, line_frequency_hz, nplc, most_samples)
    except CalibrationError as error:
        return replace(found, no_advice=str(error))
    return replace(found, advice=advice)
