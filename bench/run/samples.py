"""Samples of the signals: settling, scatter, drift and outliers. No sample is corrected or removed."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np
from scipy.special import stdtr, stdtrit

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.readings.table import Outlier
from bench.run.driver_checks import checked_temperature
from bench.run.events import EventType
from drivers.clock import Clock
from drivers.interfaces import BenchError, ThermalChamber

OUTLIER_LEVEL: Final = 0.01
"""Significance level of Grubbs' test: the probability of a false outlier in normally distributed samples."""
OUTLIER_LEAST: Final = 7
"""Least number of samples for an outlier test.

With fewer samples, the critical value is within 5 % of the greatest possible deviation, (n − 1)/√n; for three
samples both are 1.155. Rounding of the samples would then decide whether one is an outlier.
"""

_ROUNDING: Final = 1e-13
"""Relative scatter below which samples count as equal, because the scatter is a rounding error."""


@lru_cache(maxsize=256)
def grubbs_critical(n: int) -> float:
    """Return the critical value of the two-sided Grubbs test for n > 2 samples, in standard deviations."""
    t2 = float(stdtrit(n - 2, OUTLIER_LEVEL / (2 * n))) ** 2
    return (n - 1) / math.sqrt(n) * math.sqrt(t2 / (n - 2 + t2))


@dataclass(frozen=True)
class Statistics:
    """The statistics of the `n` samples of one channel, in the samples' unit; None where undefined.

    `sd` needs 2 samples, `drift` needs 3, and `outlier` needs `OUTLIER_LEAST`. `drift` is the change of the fitted
    line from the first to the last sample. `drift_p` is the probability that noise alone gives a drift at least as
    large. `outlier` is the sample found by Grubbs' test at the level `OUTLIER_LEVEL`.
    """

    n: int
    mean: float
    sd: float | None
    drift: float | None
    drift_p: float | None
    outlier: Outlier | None


def describe(samples: Mapping[str, Sequence[float]]) -> dict[str, Statistics]:
    """Return the statistics of each channel's samples.

    Raises `ValueError` for a channel without samples, or with a sample that is not finite.
    """
    return {channel: _statistics(channel, values) for channel, values in samples.items()}


def _statistics(channel: str, samples: Sequence[float]) -> Statistics:
    x = np.asarray(samples, dtype=np.float64)
    n = len(x)
    if not n:
        raise ValueError(message(f"channel {channel}: no samples; check its voltmeter"))
    mean = float(x.sum()) / n
    if not math.isfinite(mean):
        bad = n - int(np.isfinite(x).sum())
        raise ValueError(
            message(f"channel {channel}: {bad} of {n} samples are not finite numbers; check its wiring")
        )
    deviation = x - mean
    squares = float(deviation @ deviation)
    if squares <= n * (_ROUNDING * mean) ** 2:
        squares = 0.0  # equal samples, whose mean is affected by rounding
    sd = math.sqrt(squares / (n - 1)) if n > 1 else None
    drift, drift_p = _drift(deviation, squares) if n > 2 else (None, None)
    outlier = _outlier(x, deviation, sd) if sd and n >= OUTLIER_LEAST else None
    return Statistics(n, mean, sd, drift, drift_p, outlier)


def _drift(deviation: Floats, squares: float) -> tuple[float, float]:
    """Return the drift over the reading in the samples' unit, and the p-value of its t test.

    `deviation` are the samples minus their mean, `squares` is the sum of the squared deviations.
    """
    n = len(deviation)
    if squares == 0.0:
        return 0.0, 1.0
    time, time_squares = _sample_times(n)
    drift = float(time @ deviation) / time_squares
    left = squares - drift**2 * time_squares
    if left <= _ROUNDING * squares:
        return drift, 0.0  # samples exactly on a line
    u = math.sqrt(left / (n - 2) / time_squares)
    return drift, 2.0 * float(stdtr(n - 2, -abs(drift) / u))


@lru_cache(maxsize=64)
def _sample_times(n: int) -> tuple[Floats, float]:
    """Return the times of n samples, from -0.5 (first) to 0.5 (last), and the sum of their squares."""
    time = np.arange(n) / (n - 1) - 0.5
    return time, float(time @ time)


def _outlier(x: Floats, deviation: Floats, sd: float) -> Outlier | None:
    worst = int(np.abs(deviation).argmax())
    sigma = abs(float(deviation[worst])) / sd
    critical = grubbs_critical(len(x))
    return Outlier(worst + 1, float(x[worst]), sigma, critical) if sigma > critical else None


LEAST_SAMPLES: Final = 6
"""Least number of samples in a window for an estimate of the time left."""

SLOWING: Final = 0.9
"""The time left is estimated if the window's later half spans less than this fraction of its earlier half."""

_TIMING_S: Final = 1e-6
"""Tolerance for rounding errors when sums of intervals are compared with the window's length, s."""


@dataclass(frozen=True)
class Criterion:
    """The criterion by which a quantity counts as settled.

    The samples of the last `window_s`, s, must span at most `precision`, in the samples' unit.
    """

    precision: float
    window_s: float
    timeout_s: float
    interval_s: float


@dataclass(frozen=True)
class Settling:
    """The state of settling after a sample.

    `elapsed_s` is the time since the first sample. `spread` is the peak-to-peak span of each signal in the
    window. `left_s` is the estimated time until settled, None if there is no estimate.
    """

    settled: bool
    elapsed_s: float
    samples: int
    values: tuple[float, ...]
    spread: tuple[float, ...]
    left_s: float | None


class NotSettled(BenchError):
    """A quantity has not settled by the timeout; `state` is the last state of settling."""

    def __init__(self, instrument: str, cause: str, remedy: str, state: Settling) -> None:
        super().__init__(instrument, cause, remedy)
        self.state = state


class Window:
    """The samples of the last `window_s` (see `Criterion`) before the sample added last."""

    def __init__(self, criterion: Criterion) -> None:
        self.criterion = criterion
        self._samples: deque[tuple[float, tuple[float, ...]]] = deque()
        self._first_s: float | None = None
        self._taken = 0

    def add(self, time_s: float, values: Sequence[float]) -> Settling:
        """Add a sample of all signals taken at `time_s`; return the state of settling."""
        if self._first_s is None:
            self._first_s = time_s
        self._samples.append((time_s, tuple(map(float, values))))
        self._taken += 1
        self._forget(time_s)
        return self._state(time_s - self._first_s)

    def _forget(self, now_s: float) -> None:
        """Drop old samples; keep the last one before the window, so that the samples cover the whole window."""
        while len(self._samples) > 1 and self._is_old(self._samples[1][0], now_s):
            self._samples.popleft()

    def _is_old(self, time_s: float, now_s: float) -> bool:
        return now_s - time_s >= self.criterion.window_s - _TIMING_S

    def _state(self, elapsed_s: float) -> Settling:
        now_s, values = self._samples[-1]
        signals = list(zip(*(sample for _, sample in self._samples), strict=True))
        spread = tuple(max(signal) - min(signal) for signal in signals)
        still = all(span <= self.criterion.precision for span in spread)
        settled = still and self._is_old(self._samples[0][0], now_s)
        left_s = 0.0 if settled else self._left_s(signals, spread)
        return Settling(settled, elapsed_s, self._taken, values, spread, left_s)

    def _left_s(self, signals: Sequence[Sequence[float]], spread: Sequence[float]) -> float | None:
        """Return the longest estimated time, s, until a signal has settled; None if a signal has no estimate."""
        times = [time_s for time_s, _ in self._samples]
        estimates = [self._signal_left_s(times, *one) for one in zip(signals, spread, strict=True)]
        known = [estimate for estimate in estimates if estimate is not None]
        return max(known) if len(known) == len(estimates) else None

    def _signal_left_s(self, times: Sequence[float], signal: Sequence[float], spread: float) -> float | None:
        """Return the estimated time, s, until one signal has settled, from the window's samples, or None.

        If the span is within the precision, only the rest of the window remains to be filled. Otherwise the
        approach is modelled as exponential: the span shrinks by the same factor from each half-window to the next.
        With the time constant τ, it reaches the precision after τ ln(span/precision), but not before all samples
        outside the precision have left the window.
        """
        precision, now_s = self.criterion.precision, times[-1]
        moving = [t for t, v in zip(times, signal, strict=True) if abs(v - signal[-1]) > precision]
        fill_s = max(0.0, self.criterion.window_s - (now_s - (moving[-1] if moving else times[0])))
        if spread <= precision:
            return fill_s
        middle_s = (times[0] + now_s) / 2
        early = [v for t, v in zip(times, signal, strict=True) if t <= middle_s]
        late = [v for t, v in zip(times, signal, strict=True) if t >= middle_s]
        early_span, late_span = max(early) - min(early), max(late) - min(late)
        if len(times) < LEAST_SAMPLES or late_span >= SLOWING * early_span:
            return None
        if late_span == 0.0:
            return fill_s
        tau_s = (now_s - times[0]) / 2 / math.log(early_span / late_span)
        return max(fill_s, tau_s * math.log(max(spread / precision, 1.0)))


def wait_until_settled(
    sample: Callable[[], Sequence[float]],
    criterion: Criterion,
    clock: Clock,
    on_progress: Callable[[Settling], None] = lambda state: None,
    *,
    names: Sequence[str] = ("x", "y", "z"),
    unit: str = "V",
) -> Settling:
    """Sample until settled; return the last state, whose `elapsed_s` is the time it took.

    `sample` returns the signals (V, or a single temperature in °C) and may take time; its calls start every
    `interval_s` of the criterion. `on_progress` is called after every sample. `names` and `unit` are used in the
    error message. Raises `NotSettled` if a sample taken at or after `timeout_s` has not settled, and the errors of
    `sample`.
    """
    window = Window(criterion)
    begun_s = clock.now_s()
    while True:
        called_s = clock.now_s()
        values = sample()
        state = window.add(clock.now_s(), values)
        on_progress(state)
        if state.settled:
            return state
        if clock.now_s() - begun_s >= criterion.timeout_s - _TIMING_S:
            raise _not_settled(criterion, state, names, unit)
        clock.sleep(max(0.0, called_s + criterion.interval_s - clock.now_s()))


def _not_settled(criterion: Criterion, state: Settling, names: Sequence[str], unit: str) -> NotSettled:
    labels = list(names) if len(names) == len(state.spread) else [""] * len(state.spread)
    moving = [
        f"{label} {span:.3g} {unit}".strip()
        for label, span in zip(labels, state.spread, strict=True)
        if span > criterion.precision
    ]
    what = (
        message(f"still moved by {', '.join(moving)} in {criterion.window_s:g} s")
        if moving
        else message("was sampled too rarely to fill the window")
    )
    cause = message(
        f"not settled after {criterion.timeout_s:g} s: it {what}, where {criterion.precision:.3g} {unit} "
        "is allowed"
    )
    remedy = message(
        "find what moves or warms it and repeat the step, or lengthen the timeout in the procedure"
    )
    return NotSettled("block", cause, remedy, state)


SLOW_AFTER_S: Final = 300.0
"""Default time from a new set point to the check of the chamber, s."""
LEAST_SHARE: Final = 0.2
LEAST_WAY_K: Final = 2.0
"""Least difference of set point and air that is checked, K; noise and the air's lag hide a smaller one."""


def air_c(chamber: ThermalChamber, key: str) -> float:
    """Return the temperature of a settling chamber, °C. Raises `BenchError`, also for an implausible value."""
    return checked_temperature(chamber, "temperature", chamber.temperature(key, settling=True))


@dataclass
class ChamberWatch:
    """Checks that a chamber's air covers 20 % of the way to a new set point within `slow_after_s`, s.

    If it does not, `tell` records `CHAMBER_SLOW`.
    """

    clock: Clock
    slow_after_s: float
    tell: Callable[[EventType, dict[str, Any]], None]
    _way_c: tuple[float, float] | None = field(default=None, init=False)
    _begun_s: float = field(default=0.0, init=False)

    def begin(self, chamber: ThermalChamber, target_c: float, key: str) -> None:
        """Start the watch at a new set point, °C, unless a person sets it or the air is near (`LEAST_WAY_K`)."""
        self._way_c = None
        if chamber.asks_person:
            return
        try:
            start_c = air_c(chamber, key)
        except BenchError:
            return  # the step that needs the temperature will report the error
        if abs(target_c - start_c) >= LEAST_WAY_K:
            self._way_c, self._begun_s = (start_c, target_c), self.clock.now_s()

    @property
    def due(self) -> bool:
        """Whether the time of the check has come."""
        return self._way_c is not None and self.clock.now_s() - self._begun_s >= self.slow_after_s

    def look(self, chamber: ThermalChamber | None, key: str) -> None:
        """If the check is due, read the air temperature and check it."""
        if chamber is None or not self.due:
            return
        try:
            self.take(chamber.name, air_c(chamber, key))
        except BenchError:
            self._way_c = None  # the step that needs the temperature will report the error

    def take(self, name: str, air_c: float) -> None:
        """If the check is due, check `air_c`, °C, an air temperature that was read for another purpose."""
        if self._way_c is None or not self.due:
            return
        (start_c, target_c), self._way_c = self._way_c, None
        if (air_c - start_c) / (target_c - start_c) < LEAST_SHARE:
            after_s = self.clock.now_s() - self._begun_s
            way = {"start_c": start_c, "air_c": air_c, "target_c": target_c}
            self.tell(EventType.CHAMBER_SLOW, {"chamber": name, "after_s": round(after_s, 3), **way})
