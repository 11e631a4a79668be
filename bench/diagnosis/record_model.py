"""Records at a known input: deviations of the meters from it, slow noise, and the evidence for an effect.

The model of a record is U = reference + zero + drift t + effects + noise, a zero and a drift of each channel. The
noise is white plus slow noise: a random walk, flicker, or noise of an exponential correlation, larger where the
readings scatter more. Channels that read one reference share its noise, so that the evidence is that of the
channels' mean and of their differences (Helmert contrasts), each with noise of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg, ndimage, special

from bench.base.arrays import HOUR, MINUTE, Floats, Ints, Mask
from bench.calibration.result import CalibrationError
from bench.diagnosis.evidence import LOG_SIZE_WEIGHTS, SIZES
from bench.model.conditions import Conditions
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Seen
from bench.model.geometry import Block
from bench.readings.columns import METER_C, ROOM_C, meter_c, numbers, rails_of, voltage_column
from bench.readings.table import REFERENCE, REFERENCE_V, Readings

# --- the record ---------------------------------------------------------------------------------------

BINS: Final = 300
"""Largest number of means of a record; slow effects need no more."""
LEAST: Final = 30
"""Fewest means that separate noise from effects."""
APART: Final = 6.0
"""A reading is left out of its mean from this many standard deviations (by the median deviation) on."""
GAUSSIAN_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Record:
    """A record as n means of consecutive readings, in c channels.

    `deviation_v` (n, c) is the signal minus the reference in the `channels` read, `reference_v` (n,) the reference;
    `conditions` have the mean times, temperatures and rail voltages. `scale` (n,) is the relative size of the
    noise, from the scatter of the readings in each mean. `used` (m,) is the mask of the m readings that the means
    use.
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
        """The time since the first mean, h, shape (n,)."""
        elapsed_s = self.conditions.elapsed_s
        return np.asarray((elapsed_s - elapsed_s[0]) / HOUR)

    @property
    def trend(self) -> Floats:
        """The columns that every model contains: a constant, and a line from -1 to 1 over the record, shape
        (n, 2).
        """
        time_h = self.time_h
        return np.column_stack([np.ones(len(self)), 2.0 * time_h / time_h[-1] - 1.0])

    def added(self, applied: AppliedEffect) -> Floats:
        """Return the voltages that an effect adds in the c channels of the record, V, shape (n, c)."""
        at_inputs = np.repeat(self.reference_v[:, None], 3, axis=1)
        seen = Seen(at_inputs, self.conditions, Block(np.eye(3), np.zeros(3)))
        return applied.addition(seen)[:, list(self.channels)]


def make_record(readings: Readings) -> Record:
    """Return a record as means over equal times. Raises `CalibrationError` for what cannot be evaluated.

    The first means are left out where they jump as nothing later does: the input had not settled.
    """
    time_s, reference_v, channels = _checked(readings)
    edges = np.linspace(time_s[0], time_s[-1], min(BINS, len(readings)) + 1)
    of_row = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, len(edges) - 2)
    used = np.flatnonzero(np.bincount(of_row, minlength=len(edges) - 1))
    if len(used) < LEAST:
        raise CalibrationError(
            f"{readings.source}: {len(used)} readings at different times are too few to tell an effect from "
            f"noise; a record needs {LEAST}"
        )
    groups = [np.flatnonzero(of_row == number) for number in used]
    means, spread, stay = _robust_means(readings.signal[:, channels] - reference_v[:, None], groups)
    warmth, notes = _meter_c(readings)
    begin = _settled(means)
    groups, stay = groups[begin:], stay[begin:]
    if begin:
        minutes = (time_s[groups[0][0]] - time_s[0]) / MINUTE
        notes += (f"the first {minutes:.0f} min are left out: the input had not settled",)
    rows = np.zeros(len(readings), dtype=bool)
    rows[np.concatenate(groups)] = np.concatenate(stay)
    if left_out := int(np.sum(~rows[groups[0][0] :])):
        notes += (f"{left_out} of {len(readings)} readings lie far from their neighbours and are left out",)

    def mean(values: Floats) -> Floats:
        return np.array([np.mean(values[rows]) for rows in groups])

    conditions = Conditions.of(
        [REFERENCE] * len(groups),
        np.full(len(groups), np.nan),
        time_s=mean(time_s),
        supply_v=_rails(readings, mean),
        meter_c=None if warmth is None else mean(warmth),
    )
    at_inputs, size = mean(reference_v), _relative(spread[begin:])
    return Record(readings.source, tuple(channels), means[begin:], at_inputs, size, conditions, rows, notes)


def _settled(means: Floats) -> int:
    """Return the number of first means (n, c) that are left out, at most a tenth of them."""
    steps = np.abs(np.diff(means, axis=0))
    jumps = np.any(steps > APART * GAUSSIAN_MAD * np.median(steps, axis=0), axis=1)
    early = np.flatnonzero(jumps[: len(means) // 10])
    return int(early[-1]) + 1 if len(early) else 0


def _checked(readings: Readings) -> tuple[Floats, Floats, list[int]]:
    """Return times, reference voltages and the channels read. Raises `CalibrationError` with all that is wrong."""
    wrong = []
    if readings.unit != "V":
        wrong.append(f"the signals are in {readings.unit}, a record has volts (ux_v)")
    if not np.isfinite(readings.time_s).all():
        wrong.append("time_s is empty in a row; a record needs the time of each")
    elif np.any(np.diff(readings.time_s) < 0.0) or readings.time_s[-1] == readings.time_s[0]:
        wrong.append("time_s runs backwards or stands still")
    known = readings.extra.get(REFERENCE_V)
    reference_v = np.full(len(readings), np.nan) if known is None else numbers(known)
    if not np.isfinite(reference_v).all():
        wrong.append(f"{REFERENCE_V} is empty in a row; it holds the voltage at the inputs")
    channels = [i for i in range(3) if np.isfinite(readings.signal[:, i]).all()]
    if not channels:
        wrong.append("no signal column is complete")
    if wrong:
        raise CalibrationError(f"{readings.source}: {'; '.join(wrong)}")
    return readings.time_s, reference_v, channels


def _robust_means(deviation: Floats, groups: Sequence[Ints]) -> tuple[Floats, Floats, list[Mask]]:
    """Return the means of groups of rows without those far from their median, the scatter, and which rows stay.

    The means and the standard deviations of the rows, by their median deviation, are (n, c).
    """
    middle = [np.median(deviation[rows], axis=0) for rows in groups]
    off = [np.abs(deviation[rows] - at) for rows, at in zip(groups, middle, strict=True)]
    spread = GAUSSIAN_MAD * np.array([np.median(one, axis=0) for one in off])
    limit = APART * np.maximum(spread, np.median(spread, axis=0))
    stay = [np.all((one <= most) | (most == 0.0), axis=1) for one, most in zip(off, limit, strict=True)]
    means = [
        deviation[rows][near].mean(axis=0) if near.any() else at
        for rows, near, at in zip(groups, stay, middle, strict=True)
    ]
    return np.array(means), spread, stay


SMOOTHED: Final = 41
"""Means over which the size of the noise is smoothed."""
LIKE: Final = 2.0
"""The noise counts as even where its size varies by less than this factor,"""
MOST_UNLIKE: Final = 4.0
"""and is taken to vary by no more than this factor from its median."""


def _relative(spread: Floats) -> Floats:
    """Return the relative size (n,) of the noise from the scatter (n, c) of the readings in each mean."""
    middle = np.median(spread, axis=0)
    if np.any(middle == 0.0):
        return np.ones(len(spread))
    size = ndimage.median_filter(np.mean(spread / middle, axis=1), SMOOTHED, mode="reflect")
    size = np.clip(size / np.median(size), 1.0 / MOST_UNLIKE, MOST_UNLIKE)
    return np.ones(len(size)) if size.max() < LIKE * size.min() else np.asarray(size)


def _meter_c(readings: Readings) -> tuple[Floats | None, tuple[str, ...]]:
    found = meter_c(readings.extra)
    if found is None:
        return None, (
            f"no column {METER_C} or {ROOM_C}: effects of the meter's temperature are not looked for",
        )
    known = np.isfinite(found)
    whole = np.interp(readings.time_s, readings.time_s[known], found[known])
    given = any(map(str.strip, readings.extra.get(METER_C, ())))
    return whole, () if given else (f"the temperature of the room ({ROOM_C}) is taken for that of the meter",)


def _rails(readings: Readings, mean: Callable[[Floats], Floats]) -> Floats | None:
    """Return the means of the rails less their nominal voltage, or less their median where none is given."""
    rails = rails_of(readings.extra)
    if not rails:
        return None
    above = readings.conditions().supply_v
    assert above is not None  # noqa: S101 - there are rails
    columns = []
    for number, rail in enumerate(rails):
        voltage = numbers(readings.extra[voltage_column(rail)])
        volts = above[:, number] if np.isfinite(above[:, number]).any() else voltage - np.nanmedian(voltage)
        known = np.isfinite(volts)
        columns.append(mean(np.interp(readings.time_s, readings.time_s[known], volts[known])))
    return np.stack(columns, axis=1)


# --- noise --------------------------------------------------------------------------------------------

RATIOS: Final = (0.0, *np.geomspace(1e-2, 1e5, 11).tolist())
"""Mean variance of the slow noise over that of the white noise of a mean."""
FLICKER: Final = 10
"""Number of exponentially correlated noises, evenly spaced in ln of their time, that add up to flicker."""
CORRELATED: Final = (0.005, 0.02, 0.06)
"""Correlation times of the exponentially correlated noises, in lengths of the record."""


def slow_kernels(time_h: Floats) -> tuple[Floats, ...]:
    """Return the covariances (n, n) of slow noise, each of mean variance 1.

    They are a random walk, flicker, and noises of an exponential correlation.
    """
    length = float(time_h[-1])
    apart = np.abs(time_h[:, None] - time_h)
    times = np.geomspace(length / len(time_h), length, FLICKER)
    flicker = np.sum([np.exp(-apart / time) for time in times], axis=0)
    short = [np.exp(-apart / (part * length)) for part in CORRELATED]
    kernels = (np.minimum.outer(time_h, time_h), flicker, *short)
    return tuple(kernel / np.mean(np.diag(kernel)) for kernel in kernels)


@dataclass(frozen=True)
class Slow:
    """One kind of slow noise: its covariance, of mean variance 1, with eigenvalues and eigenvectors."""

    kernel: Floats
    variance: Floats
    vectors: Floats

    @classmethod
    def of(cls, kernel: Floats) -> Slow:
        """Decompose a covariance."""
        variance, vectors = linalg.eigh(kernel)
        return cls(kernel, np.maximum(variance, 0.0), vectors)


class Noise(NamedTuple):
    """The noise of a component: the index of its slow noise, the ratio of slow to white noise, and the variance of
    the white noise, V².
    """

    slow: int
    ratio: float
    variance: float


@dataclass(frozen=True)
class Whitening:
    """The whitened products of a record with any columns, for each kind of slow noise and each ratio of slow to
    white noise.
    """

    slow: tuple[Slow, ...]
    trend: Floats

    @classmethod
    def of(cls, record: Record) -> Whitening:
        """Return the whitening of a record; its trend are the columns that every model has."""
        return cls(tuple(map(Slow.of, slow_kernels(record.time_h))), record.trend / record.scale[:, None])

    @property
    def settings(self) -> tuple[tuple[int, float], ...]:
        """The trial settings of the noise: index of the kind of slow noise, ratio of slow to white noise.

        Ratio 0 occurs once, as all kinds are then the same.
        """
        return tuple((k, r) for k in range(len(self.slow)) for r in RATIOS if k == 0 or r > 0.0)

    def products(self, known: Floats, columns: Floats, targets: Floats) -> Products:
        """Return the products of `columns` (n, h) with `targets` (n, d), beside the trend and `known` (n, m)."""
        fixed = np.column_stack([self.trend, known])
        each = []
        for kind in self.slow:
            turned = kind.vectors.T @ np.column_stack([fixed, columns, targets])
            for ratio in RATIOS:
                if ratio == 0.0 and kind is not self.slow[0]:
                    continue
                size = 1.0 / np.sqrt(1.0 + ratio * kind.variance)
                basis, upper = np.linalg.qr(turned[:, : fixed.shape[1]] * size[:, None])
                rest = turned[:, fixed.shape[1] :] * size[:, None]
                rest -= basis @ (basis.T @ rest)
                column, target = rest[:, : columns.shape[1]], rest[:, columns.shape[1] :]
                log_det = float(np.sum(np.log(size)) - np.sum(np.log(np.abs(np.diag(upper)))))
                each.append(
                    (log_det, np.sum(column**2, axis=0), column.T @ target, np.sum(target**2, axis=0))
                )
        dets, squares, products, lefts = (np.array(part) for part in zip(*each, strict=True))
        return Products(dets, squares, products, lefts, len(self.trend) - fixed.shape[1])


@dataclass(frozen=True)
class Products:
    """Products for s settings of the noise: `square` (s, h), `product` (s, h, d), `left` (s, d)."""

    log_det: Floats
    square: Floats
    product: Floats
    left: Floats
    freedom: int

    def without(self) -> Floats:
        """Return ln of the likelihood without an effect, summed over the noise, shape (d,)."""
        return _summed(self.likelihood)

    @property
    def likelihood(self) -> Floats:
        """ln of the restricted likelihood of each setting of the noise without an effect, shape (s, d)."""
        return np.asarray(self.log_det[:, None] - 0.5 * self.freedom * np.log(self.left))

    def noise(self, settings: Sequence[tuple[int, float]]) -> Noise:
        """Return the most probable noise for the first target."""
        best = int(np.argmax(self.likelihood[:, 0]))
        return Noise(*settings[best], float(self.left[best, 0]) / self.freedom)

    def with_one(self, plausible: Floats) -> Floats:
        """Return ln of the marginal likelihood with each column, of plausible size (h,), shape (h, d).

        The size is normal about zero with `SIZES` times the plausible size; the variance of the noise in the
        Occam factor is that of the residuals.
        """
        prior = [(size * plausible[:, None]) ** 2 for size in SIZES]
        total = np.full(self.product.shape[1:], -np.inf)
        for log_det, square, product, left in zip(
            self.log_det, self.square[:, :, None], self.product, self.left, strict=True
        ):
            gain = product**2 / np.maximum(square, 1e-300)
            inverse = self.freedom / np.maximum(left - gain, 1e-300)
            for wide, weight in zip(prior, LOG_SIZE_WEIGHTS, strict=True):
                known = square * wide * inverse
                rest = left - gain * known / (1.0 + known)
                log = weight + log_det - 0.5 * (np.log1p(known) + self.freedom * np.log(rest))
                np.logaddexp(total, log, out=total)
        return np.asarray(total - np.log(len(self.log_det)))


def _summed(logs: Floats) -> Floats:
    """Return ln of the mean over the settings of the noise, the first axis."""
    return np.asarray(special.logsumexp(logs, axis=0) - np.log(len(logs)))


def components(channels: int) -> Floats:
    """Return the Helmert matrix (c, c).

    It maps c channels to their mean times the root of c, and to their differences.
    """
    return np.asarray(linalg.helmert(channels, full=True)) if channels > 1 else np.ones((1, 1))


# --- what may explain a record ----------------------------------------------------------------------

FOLLOWS: Final[Mapping[str, str]] = {
    "voltmeter_thermal_gain": "meter",
    "voltmeter_thermal_offset": "meter",
    "reference_supply": "rail",
    "voltmeter_warm_up": "time",
    "voltmeter_move": "time",
}
"""The effects that a record at a known input can show beside its zero and drift, and what each follows."""


@dataclass(frozen=True)
class Course:
    """One effect in one shape: its course (n,) at the plausible size, and ln of its prior probability.

    The course is in V over the relative size of the noise.
    """

    effect: Effect
    shape: Mapping[str, float]
    course: Floats
    log_prior: float

    @property
    def of_channels(self) -> bool:
        """Whether each channel has its own size."""
        return any(p.per_channel for p in self.effect.parameters)

    @property
    def size(self) -> str:
        """The name of the parameter of size."""
        return next(p.name for p in self.effect.parameters if not p.is_shape)

    def applied(self, sizes: Floats, u: Floats, channels: tuple[int, ...]) -> AppliedEffect:
        """Return the effect with sizes and their u in plausible sizes, in the `channels` of the record."""
        parameter = next(p for p in self.effect.parameters if not p.is_shape)

        def whole(values: Floats) -> Floats:
            if not parameter.per_channel:
                return np.asarray(values[0] * parameter.plausible)
            each = np.zeros(3)
            each[list(channels)] = values * parameter.plausible
            return each

        shape = {name: np.asarray(value) for name, value in self.shape.items()}
        of = tuple("xyz"[i] for i in channels) if parameter.per_channel else ("x", "y", "z")
        return AppliedEffect(self.effect, {self.size: whole(sizes), **shape}, of, u={self.size: whole(u)})


@dataclass(frozen=True)
class Courses:
    """All courses that may explain a record."""

    each: tuple[Course, ...] = field(repr=False)

    @cached_property
    def columns(self) -> Floats:
        """The courses as columns, shape (n, h)."""
        return np.column_stack([one.course for one in self.each])

    @cached_property
    def log_prior(self) -> Floats:
        """ln of the prior probabilities, shape (h,)."""
        return np.array([one.log_prior for one in self.each])

    @cached_property
    def common(self) -> Mask:
        """Whether each course is the same voltage in all channels, shape (h,)."""
        return np.array([not one.of_channels for one in self.each])

    @property
    def families(self) -> tuple[str, ...]:
        """The names of the effects."""
        return tuple(dict.fromkeys(one.effect.name for one in self.each))

    def of_family(self, family: str) -> Ints:
        """Return the indices of the courses of one effect."""
        return np.flatnonzero([one.effect.name == family for one in self.each])


SEEN: Final = 1e-9
"""A course whose part beside zero and drift is less than this part of it shows nothing."""


def make_courses(record: Record) -> Courses:
    """Return the courses that may explain a record: each effect of `FOLLOWS` in each shape that shows in the
    record.
    """
    there: dict[str, bool] = {
        "meter": record.conditions.meter_c is not None,
        "rail": record.conditions.supply_v is not None,
        "time": True,
    }
    found = []
    for name, driver in FOLLOWS.items():
        if not there[driver]:
            continue
        effect = CATALOGUE[name]
        shapes = [one for one in _shapes(record, effect) if _shows(record, _course(record, effect, one))]
        for shape in shapes:
            course = _course(record, effect, shape)
            found.append(Course(effect, shape, course / record.scale, -float(np.log(len(shapes)))))
    families = len({one.effect.name for one in found})
    return Courses(
        tuple(Course(c.effect, c.shape, c.course, c.log_prior - float(np.log(families))) for c in found)
    )


def _shapes(record: Record, effect: Effect) -> list[dict[str, float]]:
    """Return the shapes of an effect to try: each shape parameter by itself, the others at their default."""
    if effect.name == "voltmeter_move":
        time_s = record.conditions.elapsed_s
        return [{"at": float(at)} for at in (time_s[2:-2] + time_s[1:-3]) / 2.0]
    default = {p.name: p.default for p in effect.parameters if p.is_shape}
    shapes = [default, *({**default, p.name: v} for p in effect.parameters if p.is_shape for v in p.grid)]
    return [dict(one) for one in dict.fromkeys(tuple(shape.items()) for shape in shapes)]


def _course(record: Record, effect: Effect, shape: Mapping[str, float]) -> Floats:
    parameter = next(p for p in effect.parameters if not p.is_shape)
    size = np.full(3 if parameter.per_channel else (), parameter.plausible)
    values = {parameter.name: size, **{name: np.asarray(value) for name, value in shape.items()}}
    return record.added(AppliedEffect(effect, values))[:, 0]


def course_of(record: Record, effect: Effect, shape: Mapping[str, float]) -> Course | None:
    """Return the course of one effect in one shape, or None if it does not show in the record."""
    course = _course(record, effect, shape)
    return Course(effect, shape, course / record.scale, 0.0) if _shows(record, course) else None


def _shows(record: Record, course: Floats) -> bool:
    fitted, *_ = np.linalg.lstsq(record.trend, course, rcond=None)
    left = course - record.trend @ fitted
    return bool(np.sum(left**2) > SEEN**2 * np.sum(course**2)) and bool(np.any(course))
