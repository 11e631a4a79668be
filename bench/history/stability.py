"""Static records of a block at rest, and the averaging time of a reading from their Allan deviation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.computing import tracked
from bench.base.languages import message
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
"""The largest relative change of the sampling interval along a record; it hardly affects the Allan deviation."""


@dataclass(frozen=True)
class StaticRecord:
    """Signals (n, c) of `channels` in `unit`, sampled every `interval_s` seconds; `source` names their origin.

    A record at a known input may have gaps: their samples are NaN, and `notes` say so.
    """

    source: str
    unit: str
    interval_s: float
    signal: Floats
    channels: tuple[str, ...] = CHANNELS
    notes: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Duration of the record, s."""
        return self.interval_s * len(self.signal)

    @property
    def mean(self) -> Floats:
        """The means of the signals, (c,)."""
        return np.asarray(self.signal[self.known].mean(axis=0), dtype=np.float64)

    @property
    def known(self) -> Mask:
        """Which samples are numbers, and not gaps (NaN), (n,)."""
        return np.asarray(np.isfinite(self.signal).all(axis=1))

    @property
    def drift_per_s(self) -> Floats:
        """The slope of the regression line of each signal over time, unit/s, (c,)."""
        time = self.interval_s * np.arange(len(self.signal), dtype=np.float64)[self.known]
        time -= time.mean()
        return np.asarray(time @ (self.signal[self.known] - self.mean) / (time @ time), dtype=np.float64)


def read_static(path: Path) -> StaticRecord:
    """Read a static record: a CSV file with `time_s` and three signal columns of one unit (`ux_v`, …).

    Further columns are ignored. Raises `ReadingsError` for missing columns and for cells that are not numbers (the
    first 20 are listed with line and column), and the `CalibrationError` of `from_columns`.
    """
    header, body = split_table(path, EXAMPLE)
    suffixes = [s for s in UNITS if any(f"u{axis}_{s}" in header for axis in "xyz")]
    if len(suffixes) > 1:
        raise ReadingsError(
            f"{path}, line 1: signal columns in different units ({', '.join(suffixes)}); convert the columns to "
            "one unit"
        )
    suffix = suffixes[0] if suffixes else "v"
    names = ["time_s", *(f"u{axis}_{suffix}" for axis in "xyz")]
    missing = [name for name in names if name not in header]
    if missing:
        raise ReadingsError(
            f"{path}, line 1: the header lacks {', '.join(missing)}; a static record has {EXAMPLE} "
            f"(or _{', _'.join(s for s in UNITS if s != 'v')} for _v)"
        )
    places = [header.index(name) for name in names]
    bad: list[str] = []
    rows = [_row(path, line, cells, places, names, bad) for line, cells in body]
    if bad:
        more = [f"… and {len(bad) - LISTED_AT_ONCE} more"] if len(bad) > LISTED_AT_ONCE else []
        raise ReadingsError(
            "\n".join(
                [
                    *bad[:LISTED_AT_ONCE],
                    *more,
                    "the record was not used; correct these cells, or cut the record there",
                ]
            )
        )
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return from_columns(str(path), UNITS[suffix], table[:, 0], table[:, 1:])


def from_columns(source: str, unit: str, time_s: Floats, signal: Floats) -> StaticRecord:
    """Return the record of times (n,) and signals (n, 3).

    Raises `CalibrationError` if there are fewer than 32 samples, a number is missing, or sampling is not uniform:
    each interval must be within 50 % of the median, and the mean interval in each tenth of the record within 1 % of
    the overall mean.
    """
    if len(time_s) < LEAST_SAMPLES:
        raise CalibrationError(
            f"{source}: {len(time_s)} samples are too few for an Allan deviation; record {LEAST_SAMPLES} or more "
            "(it covers averaging up to a quarter of the record)"
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
            "sort the rows, or cut the record there"
        )
    odd = np.abs(steps - usual) > 0.5 * usual
    if np.any(odd):
        i = int(np.argmax(odd))
        raise CalibrationError(
            f"{source}: time_s is not uniform: {steps[i]:g} s after sample {i + 1} (at {time_s[i]:g} s), "
            f"{usual:g} s elsewhere; cut the record there, or sample it again at a steady rate"
        )
    rates = np.array([part.mean() for part in np.array_split(steps, 10)]) / steps.mean() - 1.0
    if np.max(np.abs(rates)) > STEADY:
        raise CalibrationError(
            f"{source}: the sampling interval changes by {100 * float(np.ptp(rates)):.1f} % along the record; "
            "sample it again at a steady rate"
        )
    return StaticRecord(source, unit, float(steps.mean()), np.asarray(signal, dtype=np.float64))


LONGEST_GAPS: Final = 10.0
"""Greatest duration of a record, as a multiple of the time that its samples cover."""


def on_grid(source: str, time_s: Floats, signal: Floats, channels: tuple[str, ...]) -> StaticRecord:
    """Return a record in V, with each sample (n, c) moved to the nearest time of a uniform grid.

    The times `time_s` (n,) may jitter or have gaps. Samples at one time of the grid are averaged; a time without a
    sample has NaN. Raises `CalibrationError` for too few samples, and for a record that is mostly gaps.
    """
    if len(time_s) < LEAST_SAMPLES:
        raise CalibrationError(
            f"{source}: {len(time_s)} readings are too few for an Allan deviation; record {LEAST_SAMPLES} or more"
        )
    steps = np.diff(time_s)
    usual = float(np.median(steps[steps > 0.0]))
    interval_s = float(np.mean(steps[np.abs(steps - usual) <= 0.5 * usual]))
    place = np.rint((time_s - time_s[0]) / interval_s).astype(np.int64)
    if place[-1] > LONGEST_GAPS * len(place):
        raise CalibrationError(
            f"{source}: readings cover {100.0 * len(place) / place[-1]:.1f} % of the time; cut the record at its "
            "gaps"
        )
    count = np.bincount(place)
    sums = np.stack([np.bincount(place, column) for column in signal.T], axis=1)
    filled = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], np.nan)
    missing = int(np.sum(count == 0))
    told = message(
        f"{missing} of {len(count)} times on a grid of {interval_s:.4g} s have no reading; averages omit them"
    )
    return StaticRecord(source, "V", interval_s, filled, channels, (told,) * (missing > 0))


def _row(
    path: Path, line: int, cells: list[str], places: list[int], names: list[str], bad: list[str]
) -> list[float]:
    """Return the time and the signals of a row, NaN for bad cells; messages on these are appended to `bad`."""
    values = [math.nan] * 4
    for k, (place, name) in enumerate(zip(places, names, strict=True)):
        text = cells[place].strip() if place < len(cells) else ""
        try:
            values[k] = read_number(text)
        except ValueError:
            values[k] = math.nan
        if abs(values[k]) < OVERLOAD:
            continue
        wrong = f"expected a number, got {shortened(text)!r}"
        if k and math.isfinite(values[k]):
            wrong = message(
                f"the voltmeter was overloaded ({shortened(text)}); record again on a higher range"
            )
        bad.append(f"{path}, line {line}, column {name}: {wrong}")
    return values


FLAT: Final = -0.25
"""The log-log slope from which the Allan deviation counts as flat: half the slope of white noise."""
LEAST_OF_A_READING: Final = 10
"""The least number of samples in a reading, so that their scatter shows the noise."""
REJECTS_LINE: Final = 1.0
"""Least integration time, in power-line cycles, that rejects line interference."""


@dataclass(frozen=True)
class Averaging:
    """The averaging time for a signal, s, the Allan deviation at this time, and the reason for this choice.

    `reached` is false if a noise level was requested that no averaging time of the record reaches.
    """

    tau_s: float
    deviation: float
    why: str
    reached: bool = True


@dataclass(frozen=True)
class ReadingAdvice:
    """The samples of a reading and the power-line cycles of each; they average over `tau_s` seconds."""

    samples: int
    nplc: float
    tau_s: float

    def line(self) -> str:
        """Return the advice as a line of a procedure file: "reading: {samples: 10, nplc: 10}"."""
        return f"reading: {{samples: {self.samples}, nplc: {self.nplc:g}}}"


def averaging(curve: AllanCurve, terms: NoiseTerms, wanted: float | None = None) -> Averaging:
    """Return the averaging time for a signal.

    With `wanted`, the result is the shortest time at which the upper 95 % limit of the Allan deviation does not
    exceed `wanted`. If there is none, it is the time of the lowest limit, with `reached` false. Without `wanted`,
    it is the time from which the noise terms fall at less than half the slope of white noise, so that longer
    averages gain little. If the terms fall faster to the end, it is the longest time of the curve.
    """
    _, high = curve.limits(terms.freedom)
    if wanted is not None:
        enough = high <= wanted
        if np.any(enough):
            k = int(np.argmax(enough))
            return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), message("the size asked for"))
        k = int(np.argmin(high))
        why = message(f"the size asked for is not reached; the minimum, at most {high[k]:.2g}")
        return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), why, reached=False)
    fine = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 400)
    flat = terms.slope(fine) >= FLAT
    if flat[0]:
        tau, why = float(curve.tau_s[0]), message("the deviation does not fall from the first sample on")
    elif np.any(flat):
        tau, why = float(fine[int(np.argmax(flat))]), message("longer averages gain little from here")
    else:
        tau, why = (
            float(curve.tau_s[-1]),
            message("the deviation still falls; the record is too short to show more"),
        )
    return Averaging(tau, float(np.interp(tau, curve.tau_s, curve.deviation)), why)


def reading_advice(
    tau_s: float, line_frequency_hz: float, nplc: Sequence[float], most_samples: int
) -> ReadingAdvice:
    """Return samples and NPLC of a reading that averages over at least `tau_s`.

    `nplc` are the meter's integration times in power-line cycles. The advice uses the longest that rejects the line
    and leaves at least ten samples. Raises `CalibrationError` if the meter cannot average that long in one reading.
    """
    cycles = tau_s * line_frequency_hz
    usable = sorted(n for n in nplc if n >= REJECTS_LINE)
    if not usable:
        raise CalibrationError(
            "the voltmeters cannot integrate over a whole power-line cycle; use other voltmeters"
        )
    fitting = [n for n in usable if n * LEAST_OF_A_READING <= cycles] or usable[:1]
    each = fitting[-1]
    samples = max(LEAST_OF_A_READING, int(np.ceil(cycles / each - 1e-9)))
    if samples > most_samples:
        raise CalibrationError(
            f"an averaging time of {tau_s:.3g} s takes {samples} samples of {each:g} power-line cycles, but a "
            f"reading has {most_samples} at most; give a larger size with --size"
        )
    return ReadingAdvice(samples, each, samples * each / line_frequency_hz)


LONGEST_SEGMENT: Final = 4096
SEGMENTS: Final = 8
"""Number of segments in a record without overlap; with half overlaps there are about twice as many."""


@dataclass(frozen=True)
class Spectrum:
    """The one-sided power spectral density `density` (m, c) of c channels, unit²/Hz, at m frequencies, Hz.

    White noise of the Allan term N has the density 2 N². `segments` is the number of segments averaged.
    """

    frequency_hz: Floats
    density: Floats
    segments: int


SHORT_GAP: Final = 3
"""Longest gap, in samples, that the spectrum bridges by a straight line; a longer one splits the record."""


def spectrum_of(record: StaticRecord) -> Spectrum:
    """Return the spectrum by Welch's method: Hann windows, segments detrended linearly (IEEE Std 1554)."""
    from scipy.signal import welch  # slow to import

    stretches = _stretches(record)
    n = len(record.signal)
    length = min(max(n // SEGMENTS, 8), LONGEST_SEGMENT, max(map(len, stretches)))
    trend: Any = "linear"  # which the stubs of scipy lack
    found, weights = [], []
    for one in (stretch for stretch in stretches if len(stretch) >= length):
        frequency, density = welch(one, 1.0 / record.interval_s, nperseg=length, detrend=trend, axis=0)
        found.append(density[1:])
        weights.append(max(1, (len(one) - length) // (length - length // 2) + 1))
    return Spectrum(frequency[1:], np.average(found, axis=0, weights=weights), sum(weights))


def _stretches(record: StaticRecord) -> list[Floats]:
    """Return the parts (m, c) of a record between its longer gaps."""
    at = np.flatnonzero(record.known)
    bounds = [0, *(np.flatnonzero(np.diff(at) > SHORT_GAP + 1) + 1).tolist(), len(at)]
    parts = []
    for start, end in pairwise(bounds):
        mine = at[start:end]
        every = np.arange(mine[0], mine[-1] + 1)
        parts.append(np.stack([np.interp(every, mine, one[mine]) for one in record.signal.T], axis=1))
    return parts


@dataclass(frozen=True)
class Stability:
    """The analysis of a static record: Allan deviations, noise terms and averaging times by channel, and advice.

    `advice` suits all channels; it is None if the meters cannot average that long in one reading, and `no_advice`
    gives the reason.
    """

    record: StaticRecord
    line_frequency_hz: float
    curves: tuple[AllanCurve, ...]
    terms: tuple[NoiseTerms, ...]
    averages: tuple[Averaging, ...]
    advice: ReadingAdvice | None
    no_advice: str = ""

    @cached_property
    def spectrum(self) -> Spectrum:
        """The power spectral density of the channels."""
        return spectrum_of(self.record)

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
    """Return the analysis of a record whose meters integrated each sample for `integration_s` seconds.

    `size` is the permitted noise of a reading, in the unit of the signals. If it is None, the averaging time is the
    time beyond which longer averages gain little.
    """
    signals = list(zip(record.channels, record.signal.T, strict=True))
    curves = tuple(
        allan_curve(
            one, record.interval_s, gaps=bool(record.notes), name=f"{record.source}, channel {channel}"
        )
        for channel, one in tracked(signals, "Allan deviation of the channels")
    )
    terms = tuple(fit_terms(curve) for curve in tracked(curves, "noise terms of the channels"))
    averages = tuple(averaging(c, t, size) for c, t in zip(curves, terms, strict=True))
    found = Stability(record, line_frequency_hz, curves, terms, averages, None)
    integrated_s = found.longest_s * integration_s / record.interval_s
    try:
        advice = reading_advice(integrated_s, line_frequency_hz, nplc, most_samples)
    except CalibrationError as error:
        return replace(found, no_advice=str(error))
    return replace(found, advice=advice)
