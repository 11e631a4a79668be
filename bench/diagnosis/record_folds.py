"""Excursions of a record held out in turn: whether the rest predicts them with what was found, in which shape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import linalg

from bench.base.arrays import Floats, Mask, rms
from bench.diagnosis.gap import Fold, Gap, HeldOut
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.record_model import FOLLOWS, Course, Noise
from bench.diagnosis.record_search import Find, RecordWork


@dataclass(frozen=True)
class Rival:
    """A kind of shape of an effect, and how well the readings outside of an excursion predict the excursion."""

    what: str
    held_out_rms_v: float
    chi2: float


SWING: Final = 0.15
"""An excursion is where what is followed is further from its level at rest than this part of its range."""
PLATEAU: Final = 0.1
"""Part of the range within which what is followed counts as at one level."""
COMMON: Final = 0.2
"""Part of the record at one level from which on it is the level at rest; evenly spread it would be a tenth."""
LEAST_ROWS: Final = 8
TURNS: Final = 5
"""Consecutive means that are held out together where an effect follows time alone."""
LEAST_GAIN: Final = 4.0
"""Least fall of the chi-square of the excursions held out that confirms an effect."""


def measure_record_gap(
    work: RecordWork, finds: Sequence[Find]
) -> tuple[Gap, tuple[Rival, ...], dict[str, str]]:
    """Return the gap on excursions held out in turn, the rivals in shape, and what is not confirmed, with why."""
    noises = work.noises(finds)
    folds: list[Fold] = []
    unconfirmed: dict[str, str] = {}
    gained: dict[str, float] = {}
    for number, find in enumerate(finds):
        masks = list(_excursions(work, find))
        if len(masks) < 2:
            unconfirmed[find.family] = (
                "there is one excursion of what it follows; a second one, at another time, would confirm it"
            )
            continue
        for label, rows in masks:
            others = [one for i, one in enumerate(finds) if i != number]
            without = _predicted(work, [o.course for o in others], None, rows, noises)
            after = _predicted(work, [o.course for o in others], _shapes_in_fold(work, find), rows, noises)
            gain = without.chi2 - after.chi2
            gained[find.family] = gained.get(find.family, 0.0) + gain
            folds.append(Fold(label, {find.family: gain}, without, after))
    unconfirmed |= {
        name: f"readings held out do not confirm it (chi-square falls by {gain:.1f} in all)"
        for name, gain in gained.items()
        if gain < LEAST_GAIN
    }
    part = noises[0]
    size = NoiseSize(float(np.sqrt(part.variance / len(work.helmert))), 0.0, len(work.record) - 2)
    gap = Gap(tuple(folds), size, "V", size.freedom, tuple(one.family for one in finds))
    return gap, tuple(_rivals(work, finds, noises)), unconfirmed


def _shapes_in_fold(work: RecordWork, find: Find) -> list[Course]:
    """Return the shapes that the rest of a record chooses from; the time of a jump stays, as a gap hides it."""
    if find.family == "voltmeter_move":
        return [find.course]
    return [work.courses.each[i] for i in work.courses.of_family(find.family)]


def _excursions(work: RecordWork, find: Find) -> Iterator[tuple[str, Mask]]:
    """Yield what is held out in turn: the excursions of what an effect follows, or runs of means for time."""
    record, conditions = work.record, work.record.conditions
    match FOLLOWS[find.family]:
        case "meter":
            driver = conditions.meter_warmth_k
        case "rail":
            driver = conditions.above_nominal_v[:, round(find.course.shape["rail"]) - 1]
        case _:
            turn = np.arange(len(record)) // TURNS % 2
            for number, which in enumerate(("first", "next")):
                yield f"every other {TURNS} means, from the {which}", turn == number
            return
    from_rest = driver - _rest(driver)
    side = np.where(np.abs(from_rest) > SWING * np.ptp(driver), np.sign(from_rest), 0.0)
    turns = np.flatnonzero(np.diff(side)) + 1
    bounds: list[int] = [0, *turns.tolist(), len(side)]
    for start, end in pairwise(bounds):
        if side[start] and end - start >= LEAST_ROWS:
            rows = np.zeros(len(side), dtype=bool)
            rows[start:end] = True
            word = "high" if side[start] > 0 else "low"
            yield f"{word} from {record.time_h[start]:.1f} to {record.time_h[end - 1]:.1f} h", rows


def _rest(driver: Floats) -> float:
    """Return the level from which excursions count: the commonest one, or the median where none is common."""
    ordered = np.sort(driver)
    last = np.searchsorted(ordered, ordered + PLATEAU * np.ptp(driver), side="right")
    inside = last - np.arange(len(ordered))
    start = int(np.argmax(inside))
    if inside[start] < COMMON * len(ordered):
        return float(np.median(driver))
    return float(np.median(ordered[start : last[start]]))


@dataclass(frozen=True)
class _Split:
    """A component split into rows held out and the rest: the rest whitened, and what it predicts."""

    lower: Floats
    gain: Floats
    spread: Floats
    rows: Mask

    @classmethod
    def of(cls, covariance: Floats, rows: Mask) -> _Split:
        rest = ~rows
        lower = linalg.cholesky(covariance[np.ix_(rest, rest)], lower=True)
        gain = linalg.cho_solve((lower, True), covariance[np.ix_(rest, rows)]).T
        spread = covariance[np.ix_(rows, rows)] - gain @ covariance[np.ix_(rest, rows)]
        return cls(lower, gain, spread, rows)

    def fit(self, design: Floats, signal: Floats) -> tuple[Floats, Floats, float]:
        """Return estimates from the rest, their covariance and chi-square."""
        rest = np.column_stack([design, signal])[~self.rows]
        white = linalg.solve_triangular(self.lower, rest, lower=True)
        spread = np.asarray(np.linalg.pinv(white[:, :-1].T @ white[:, :-1], hermitian=True), dtype=np.float64)
        mean = spread @ white[:, :-1].T @ white[:, -1]
        return mean, spread, float(np.sum((white[:, -1] - white[:, :-1] @ mean) ** 2))

    def predict(self, design: Floats, signal: Floats) -> tuple[Floats, float, Floats]:
        """Return measured less model in the rows held out, chi-square of the prediction, and its variance."""
        mean, spread, _ = self.fit(design, signal)
        ahead = design[self.rows] - self.gain @ design[~self.rows]
        error = signal[self.rows] - self.gain @ signal[~self.rows] - ahead @ mean
        covariance = self.spread + ahead @ spread @ ahead.T
        return (
            signal[self.rows] - design[self.rows] @ mean,
            float(error @ linalg.solve(covariance, error, assume_a="pos")),
            np.diag(covariance),
        )


def _predicted(
    work: RecordWork,
    others: Sequence[Course],
    shapes: Sequence[Course] | None,
    rows: Mask,
    noises: Sequence[Noise],
) -> HeldOut:
    """Predict the rows held out, by the shape that the rest finds likeliest; without `shapes` by the others alone.

    Errors are those beside a straight line in the rows, as the level after an excursion is that of slow noise.
    """
    splits = [_Split.of(work.covariance(noise), rows) for noise in noises]

    def design(part: int, shape: Course | None) -> Floats:
        courses = [*others, *([] if shape is None else [shape])]
        return np.column_stack([work.trend, work.columns(courses, part)])

    best = None
    if shapes is not None:
        chi2 = [sum(splits[k].fit(design(k, s), work.signal[:, k])[2] for k in work.parts) for s in shapes]
        best = shapes[int(np.argmin(chi2))]
    found = [splits[k].predict(design(k, best), work.signal[:, k]) for k in work.parts]
    scale = work.record.scale[rows, None]
    error = np.column_stack([one[0] for one in found]) @ work.helmert * scale
    variance = np.column_stack([one[2] for one in found]) @ work.helmert**2 * scale**2
    line = work.record.trend[rows]
    error -= line @ np.linalg.lstsq(line, error, rcond=None)[0]
    return HeldOut(error.ravel(), error.ravel(), np.sqrt(variance).ravel(), sum(one[1] for one in found))


def _rivals(work: RecordWork, finds: Sequence[Find], noises: Sequence[Noise]) -> Iterator[Rival]:
    """Yield how well each kind of shape of the first effect of the meter's temperature predicts excursions."""
    thermal = next((one for one in finds if FOLLOWS[one.family] == "meter"), None)
    if thermal is None:
        return
    others = [one.course for one in finds if one is not thermal]
    family = [work.courses.each[i] for i in work.courses.of_family(thermal.family)]
    kinds = {
        "at once": [c for c in family if not c.shape["lag"] and not c.shape["width"]],
        "lag": [c for c in family if c.shape["lag"]],
        "hysteresis": [c for c in family if c.shape["width"]],
    }
    masks = list(_excursions(work, thermal))
    for what, shapes in kinds.items():
        if shapes and len(masks) > 1:
            held = [_predicted(work, others, shapes, rows, noises) for _, rows in masks]
            yield Rival(what, rms(np.concatenate([one.error for one in held])), sum(one.chi2 for one in held))
