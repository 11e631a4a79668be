"""Records at a known input: deviations of the meters from it, slow noise, and the evidence for an effect.

The model of a record is U = reference + zero + drift × t + effects + noise, with a zero and a drift for each
channel. The noise is white noise plus slow noise: a random walk, flicker noise, or noise of exponential
correlation; both are larger where the readings scatter more. Channels that read the same reference share its
noise. Therefore the mean of the channels and their differences (Helmert contrasts) are evaluated, each with
noise of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from scipy import ndimage, special

from bench.base.arrays import CHANNELS, HOUR, MINUTE, Floats, Ints, Mask, least_squares
from bench.base.languages import message
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import Candidates, Column, Variant
from bench.diagnosis.levels import CLEARLY_LARGER, FAR, NEGLIGIBLE
from bench.diagnosis.posterior import Shape
from bench.model.conditions import METER_REFERENCE_C, Conditions
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Seen
from bench.model.geometry import Block
from bench.readings.columns import METER_C, ROOM_C, meter_c, numbers, rails_of, voltage_column
from bench.readings.table import REFERENCE, REFERENCE_V, Readings

# --- the record ---------------------------------------------------------------------------------------

BINS: Final = 300
"""Largest number of means that a record is reduced to; slow effects need no more."""
LEAST: Final = 30
"""Least number of means from which noise and effects can be separated: they give the noise to 13 %."""
ZERO_V: Final = 1e-3
"""A reference below this, V, counts as a short circuit: an offset of 1 µV would change a gain by 0.1 %."""
LEVELS: Final = 0.01
"""A reference that changes by more than this fraction of its largest value determines both gain and offset.

With less, u of the gain is over 200 times that from one level with a known offset.
"""
OF_MEDIAN: Final = 1.0 / float(special.ndtri(0.75))
"""Standard deviation of a normal distribution, as a multiple of its median absolute deviation."""


@dataclass(frozen=True)
class Record:
    """A record at a known input, as n means of consecutive readings in c `channels` (indices).

    `reference_v` (n,) is the input, V; `deviation_v` (n, c) is signal minus input, V; `scale` (n,) is the
    relative white noise of each mean. `conditions` are those of the means; `used` (m,) is the mask of the
    readings in them.
    """

    source: str
    channels: tuple[int, ...]
    deviation_v: Floats
    reference_v: Floats
    scale: Floats
    conditions: Conditions
    used: Mask
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.reference_v)

    @property
    def time_h(self) -> Floats:
        """The time of each mean since the first, h, shape (n,)."""
        elapsed_s = self.conditions.elapsed_s
        return np.asarray((elapsed_s - elapsed_s[0]) / HOUR)

    @property
    def several_levels(self) -> bool:
        """Whether the reference deviates enough from a line in time to determine gain and offset."""
        beside_line = least_squares(self.line, self.reference_v)[1]
        enough = np.ptp(beside_line) > LEVELS * np.abs(self.reference_v).max()
        return bool(enough) and levels_apart(self.reference_v)

    @property
    def ramp(self) -> bool:
        """Whether the reference only changes linearly in time, so that an error of the gain looks like a drift."""
        return levels_apart(self.reference_v) and not self.several_levels

    @property
    def line(self) -> Floats:
        """A constant, and a line in time from -1 to 1, as columns (n, 2)."""
        time_h = self.time_h
        return np.column_stack([np.ones(len(self)), 2.0 * time_h / time_h[-1] - 1.0])

    @property
    def trend(self) -> Floats:
        """The columns (n, 2) of `line`; for several levels, a third is the reference minus its mean, V."""
        gain = [self.reference_v - self.reference_v.mean()] * self.several_levels
        return np.column_stack([self.line, *gain])

    @property
    def zero_and_drift(self) -> Floats:
        """The matrix (2, p) that converts estimates of `trend` to zero (V) and drift (V/h).

        With several levels, the zero is that at 0 V; otherwise it is that at the only level.
        """
        turn = np.diag([1.0, 2.0 / float(self.time_h[-1])])
        level_v = [[-float(self.reference_v.mean())], [0.0]] if self.several_levels else np.zeros((2, 0))
        return np.hstack([turn, level_v])

    @property
    def beside_trend(self) -> Floats:
        """The deviations minus the fit of `trend` to each channel, V, shape (n, c)."""
        return least_squares(self.trend, self.deviation_v)[1]

    def less(self, added_v: Floats) -> Record:
        """Return the record with known voltages `added_v` (n, c), V, subtracted."""
        return replace(self, deviation_v=self.deviation_v - added_v)

    def added_by(self, effects: Sequence[AppliedEffect]) -> Floats:
        """Return the sum of the voltages that the effects add to the signals, V, shape (n, c)."""
        return np.asarray(sum((self.added(one) for one in effects), np.zeros_like(self.deviation_v)))

    def added(self, applied: AppliedEffect) -> Floats:
        """Return the voltages that one effect adds to the signals, V, shape (n, c)."""
        at_inputs = np.repeat(self.reference_v[:, None], 3, axis=1)
        seen = Seen(at_inputs, self.conditions, Block(np.eye(3), np.zeros(3)))
        return applied.addition(seen)[:, list(self.channels)]


def make_record(readings: Readings) -> Record:
    """Return readings at a known input as means over equal intervals, after the last jump of the first tenth.

    Raises `CalibrationError` if the readings cannot be evaluated.
    """
    time_s, reference_v, channels = _checked(readings)
    groups = groups_of(time_s)
    if len(groups) < LEAST:
        raise CalibrationError(
            f"{readings.source}: {len(readings)} readings give means in {len(groups)} equal intervals of time, too "
            f"few to separate an effect from noise; a record needs {LEAST}"
        )
    means, spread, used = _robust_means(readings.signal[:, channels] - reference_v[:, None], groups)
    at_inputs = np.array(
        [np.mean(reference_v[rows[used[rows]] if used[rows].any() else rows]) for rows in groups]
    )
    begin = _settled(means, at_inputs)
    groups, first = groups[begin:], int(groups[begin][0])
    used[:first] = False
    notes, warmth, rails = [], meter_c(readings.extra), list(_rails(readings))
    if warmth is None:
        notes.append(
            message(
                f"no column {METER_C} or {ROOM_C}: the search excludes effects of the meter's temperature"
            )
        )
    elif not any(map(str.strip, readings.extra.get(METER_C, ()))):
        notes.append(message(f"the temperature of the room ({ROOM_C}) is used as the meter's temperature"))
    notes += _far_from_reference(readings.signal[:, channels], reference_v, channels)
    if begin:
        minutes = (time_s[first] - time_s[0]) / MINUTE
        notes.append(message(f"the first {minutes:.0f} min are left out: the input had not settled"))
    if left_out := int(np.sum(~used[first:])):
        notes.append(
            message(f"{left_out} of {len(readings)} readings lie far from their neighbours and are left out")
        )

    def mean(values: Floats) -> Floats:
        known = np.isfinite(values)
        complete = values if known.all() else np.interp(time_s, time_s[known], values[known])
        return np.array([np.mean(complete[rows]) for rows in groups])

    conditions = Conditions.of(
        [REFERENCE] * len(groups),
        np.full(len(groups), np.nan),
        time_s=mean(time_s),
        supply_v=np.stack([mean(rail) for rail in rails], axis=1) if rails else None,
        meter_c=None if warmth is None else mean(warmth),
    )
    record = Record(
        readings.source, tuple(channels), means[begin:], at_inputs[begin:], _relative(spread[begin:]),
        conditions, used, tuple(notes),
    )  # fmt: skip
    if wrong := list(without_noise(record)):
        raise CalibrationError(f"{readings.source}: {'; '.join(wrong)}")
    return record


def _far_from_reference(signal_v: Floats, reference_v: Floats, channels: Sequence[int]) -> Iterator[str]:
    """Yield a sentence for each channel of `signal_v` (n, c) that seems to have another unit than the reference."""
    level_v = float(np.median(np.abs(reference_v)))
    for channel, read_v in zip(channels, np.median(np.abs(signal_v), axis=0).tolist(), strict=True):
        if level_v >= ZERO_V and not 1.0 / CLEARLY_LARGER < read_v / level_v < CLEARLY_LARGER:
            yield message(
                f"u{CHANNELS[channel]}_v is {read_v:.3g} V where {REFERENCE_V} is {level_v:.3g} V; check their "
                "units in the mapping"
            )


def without_noise(record: Record) -> Iterator[str]:
    """Yield a sentence for each channel without noise; if there is none, for each pair with the same noise."""
    left, names = record.beside_trend, [f"u{CHANNELS[channel]}_v" for channel in record.channels]
    least = NEGLIGIBLE * float(np.abs(record.deviation_v + record.reference_v[:, None]).max())
    still = [name for name, one in zip(names, left.T, strict=True) if np.ptp(one) <= least]
    for name in still:
        yield message(
            f"{name} minus {REFERENCE_V} has no noise; give the readings with all digits of the meter"
        )
    for (one, a), (other, b) in combinations(zip(names, left.T, strict=True), 2):
        if not still and np.ptp(a - b) <= least:
            yield message(f"{one} and {other} have the same noise; give the readings of one meter once")


def groups_of(time_s: Floats) -> list[Ints]:
    """Return the indices of each mean's readings; `time_s` (m,), s, has at most `BINS` equal intervals."""
    edges = np.linspace(time_s[0], time_s[-1], min(BINS, len(time_s)) + 1)
    of_row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    return [np.flatnonzero(of_row == number) for number in np.unique(of_row)]


def levels_apart(reference_v: Floats) -> bool:
    """Return whether the reference (n,) reaches `ZERO_V` and changes by more than `LEVELS` of its maximum."""
    largest = np.abs(reference_v).max()
    return bool(largest >= ZERO_V and np.ptp(reference_v) > LEVELS * largest)


def _settled(means: Floats, reference_v: Floats) -> int:
    """Return the number of `means` (n, c) before the last jump in the first tenth; they are left out."""
    if levels_apart(reference_v):  # a gain jumps with the reference
        means = least_squares(np.column_stack([np.ones(len(means)), reference_v]), means)[1]
    steps = np.abs(np.diff(means, axis=0))
    jumps = np.any(steps > FAR * OF_MEDIAN * np.median(steps, axis=0), axis=1)
    early = np.flatnonzero(jumps[: len(means) // 10])
    return int(early[-1]) + 1 if len(early) else 0


def _checked(readings: Readings) -> tuple[Floats, Floats, list[int]]:
    """Return times, reference voltages and the channels read. Raises `CalibrationError` with all that is wrong."""
    wrong = []
    if readings.unit != "V":
        wrong.append(message(f"the signals are in {readings.unit}; give a record in volts (ux_v)"))
    if not np.isfinite(readings.time_s).all():
        row = int(np.argmin(np.isfinite(readings.time_s))) + 1
        wrong.append(message(f"time_s is empty in row {row}; fill it in, or delete the row"))
    elif np.any(back := np.diff(readings.time_s) < 0.0):
        wrong.append(
            message(
                f"time_s runs backwards in row {int(np.argmax(back)) + 2}; if the clock was put back, give times "
                "in UTC, otherwise sort the rows"
            )
        )
    elif readings.time_s[-1] == readings.time_s[0]:
        wrong.append(message("time_s is the same in all rows; state the time of each reading"))
    known = readings.extra.get(REFERENCE_V)
    reference_v = np.full(len(readings), np.nan) if known is None else numbers(known)
    if not np.isfinite(reference_v).all():
        row = int(np.argmin(np.isfinite(reference_v))) + 1
        wrong.append(message(f"{REFERENCE_V} is empty in row {row}; fill in the voltage at the inputs"))
    channels = [i for i in range(3) if np.isfinite(readings.signal[:, i]).all()]
    if not channels:
        wrong.append(message("no signal column is complete; delete the rows with empty signals"))
    if wrong:
        raise CalibrationError(f"{readings.source}: {'; '.join(wrong)}")
    return readings.time_s, reference_v, channels


def _robust_means(deviation: Floats, groups: Sequence[Ints]) -> tuple[Floats, Floats, Mask]:
    """Return means (n, c) of groups without rows `FAR` from the median, their scatter, and the rows used.

    The scatter (n, c) is the standard deviation of a row, from the median deviation.
    """
    middle = np.array([np.median(deviation[rows], axis=0) for rows in groups])
    off = [np.abs(deviation[rows] - at) for rows, at in zip(groups, middle, strict=True)]
    spread = OF_MEDIAN * np.array([np.median(one, axis=0) for one in off])
    limit = FAR * np.maximum(spread, np.median(spread, axis=0))
    used, means = np.zeros(len(deviation), dtype=bool), middle.copy()
    for number, (rows, one, most) in enumerate(zip(groups, off, limit, strict=True)):
        near = np.all((one <= most) | (most == 0.0), axis=1)
        used[rows] = near
        if near.any():
            means[number] = deviation[rows[near]].mean(axis=0)
    return means, spread, used


def _relative(spread: Floats) -> Floats:
    """Return the relative white noise (n,) of the means, from the `spread` (n, c) of the readings in each.

    It is uniform if the largest is less than `CLEARLY_LARGER` times the smallest; else it is limited to a factor of
    `CLEARLY_LARGER` squared about the median. It is smoothed over a seventh of a full record.
    """
    middle = np.median(spread, axis=0)
    if np.any(middle == 0.0):
        return np.ones(len(spread))
    size = ndimage.median_filter(np.mean(spread / middle, axis=1), 2 * (BINS // 15) + 1, mode="reflect")
    size = np.clip(size / np.median(size), CLEARLY_LARGER**-2, CLEARLY_LARGER**2)
    return np.ones(len(size)) if size.max() < CLEARLY_LARGER * size.min() else np.asarray(size)


def _rails(readings: Readings) -> Iterator[Floats]:
    """Yield the voltage (m,) of each rail minus its nominal value, or minus its median if none is given."""
    above = readings.conditions().supply_v
    for number, rail in enumerate(rails_of(readings.extra)):
        voltage = numbers(readings.extra[voltage_column(rail)])
        given = None if above is None else above[:, number]
        yield voltage - np.nanmedian(voltage) if given is None or np.isnan(given).all() else given


# --- what may explain a record ----------------------------------------------------------------------

MOVE: Final = "voltmeter_move"
FOLLOWS: Final[Mapping[str, str]] = {
    "voltmeter_thermal_gain": "meter",
    "voltmeter_thermal_offset": "meter",
    "reference_supply": "rail",
    "voltmeter_warm_up": "time",
    MOVE: "time",
}
"""The effects that a record at a known input can show besides zero and drift, with the quantity each follows."""


def make_courses(record: Record) -> Candidates:
    """Return every effect of `FOLLOWS` in each shape, if the record has the temperature or rail it needs."""
    conditions = record.conditions
    there = {"meter": conditions.meter_c is not None, "rail": conditions.supply_v is not None, "time": True}
    shown = [CATALOGUE[name] for name, driver in FOLLOWS.items() if there[driver]]
    return courses_of(record, [(effect, shape) for effect in shown for shape in _shapes(record, effect)])


def _shapes(record: Record, effect: Effect) -> list[Shape]:
    """Return the shapes to search: one parameter varies on its grid, the others have their defaults.

    If the parameter has a unit, values beyond the grid are searched as well.
    """
    if effect.name == MOVE:
        time_s = record.conditions.elapsed_s
        return [(("at", float(at)),) for at in (time_s[2:-2] + time_s[1:-3]) / 2.0]
    of_shape = [p for p in effect.parameters if p.is_shape]
    default = {p.name: p.default for p in of_shape}
    shapes = [default, *({**default, p.name: v} for p in of_shape for v in p.grid)]
    shapes += [{**default, p.name: CLEARLY_LARGER * p.grid[-1]} for p in of_shape if p.unit != "1"]
    return list(dict.fromkeys(shape_of(effect, shape) for shape in shapes))


def forms_of(record: Record, effect: Effect, shape: Shape) -> list[tuple[Effect, Shape]]:
    """Return the shapes that an effect of a model may have in a record.

    A supply, a formula, and an effect with several shape parameters that are not 0 keep the given `shape`.
    """
    known = any(p.is_shape and p.unit == "1" for p in effect.parameters)
    if known or effect.name not in FOLLOWS or len(shape) > 1:
        return [(effect, shape)]
    return [(effect, one) for one in _shapes(record, effect)]


def shape_of(effect: Effect, values: Mapping[str, Any]) -> Shape:
    """Return name and SI value of each shape parameter whose value or default is not zero."""
    return tuple(
        (p.name, float(values[p.name]))
        for p in effect.parameters
        if p.is_shape and (values[p.name] or p.default)
    )


def column_of(record: Record, effect: Effect, shape: Shape) -> Floats:
    """Return the change (n,) of a signal, V, by one plausible size of an effect, divided by the relative noise."""
    size = next(p for p in effect.parameters if p.is_size)
    plausible = np.full(3 if size.per_channel else (), size.plausible)
    values = {size.name: plausible, **{name: np.asarray(value) for name, value in shape}}
    return np.asarray(record.added(AppliedEffect(effect, values))[:, 0] / record.scale)


def start_of(record: Record, effect: Effect, shape: Shape) -> Floats:
    """Return the column (n,) of the starting state of an effect with a lag (`fading_record`), otherwise zeros."""
    lag_s = dict(shape).get("lag", 0.0)
    if not lag_s or FOLLOWS.get(effect.name) != "meter":
        return np.zeros(len(record))
    return column_of(fading_record(record, lag_s), effect, ())


def fading_record(record: Record, lag_s: float) -> Record:
    """Return the record with a temperature that decays from one standard deviation, with time constant `lag_s`."""
    left = np.exp(-record.time_h * HOUR / lag_s) if lag_s else np.zeros(len(record))
    meter_c = METER_REFERENCE_C + np.std(record.conditions.meter_warmth_k) * left
    return replace(record, conditions=replace(record.conditions, meter_c=meter_c))


def courses_of(record: Record, forms: Iterable[tuple[Effect, Shape]]) -> Candidates:
    """Return effects, each in a given shape, as candidates with the columns of `column_of`.

    An effect with an amplitude for each channel has the same column for each. A form that the trend can describe is
    left out.
    """
    columns, scale, variants = [np.zeros((len(record), 0))], [], []
    kinds: list[Column] = []
    for effect, shape in forms:
        size = next(p for p in effect.parameters if p.is_size)
        column = column_of(record, effect, shape)
        course = column * record.scale
        left = least_squares(record.trend, course)[1]
        if not np.any(course) or left @ left <= NEGLIGIBLE * (course @ course):
            continue
        own = [Column(size.name, channel) for channel in (record.channels if size.per_channel else (None,))]
        places = tuple(range(len(kinds), len(kinds) + len(own)))
        variants.append(
            Variant(effect.name, places, record.channels if size.per_channel else (0, 1, 2), shape=shape)
        )
        kinds += own
        scale += [size.plausible] * len(own)
        columns += [column[:, None]] * len(own)
    return Candidates(np.column_stack(columns), tuple(kinds), np.array(scale), tuple(variants))
