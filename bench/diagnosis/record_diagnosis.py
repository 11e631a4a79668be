"""The diagnosis of a record at a known input: effects named by their evidence, and confirmed by hold-out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats, Mask, least_squares, rms
from bench.base.languages import message
from bench.diagnosis.candidates import SLOW_IN_TIME, Variant
from bench.diagnosis.evidence import Threshold
from bench.diagnosis.gap import Fold, Gap, HeldOut
from bench.diagnosis.levels import BY_CHANCE, FAR, FOLDS
from bench.diagnosis.naming import FoundEffect
from bench.diagnosis.pipeline import verdict_of
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.record_model import FOLLOWS, MOVE, Record, make_courses, make_record
from bench.diagnosis.record_noise import Noise, solved
from bench.diagnosis.record_search import ChannelFit, RecordWork
from bench.diagnosis.result import UNNAMED_WORDS, Findings, NamedEffect
from bench.diagnosis.visibility import ResidualPattern
from bench.model.effects import AppliedEffect
from bench.readings.table import REFERENCE, Readings

GAIN_FITTED: Final = message(
    "the reference has several levels: the gain of each channel is fitted together with zero and drift; 'bench "
    "calibrate' gives it"
)
GAIN_IN_DRIFT: Final = message(
    "the reference changes linearly with time: zero and drift contain the error of the gain, but their u leaves it "
    "out"
)


@dataclass(frozen=True)
class Rival:
    """A kind of thermal response (`what`: "at once", "lag" or "hysteresis"), judged on held-out excursions.

    `held_out_rms_v` (V) and `chi2` are the root mean square and the chi-square of measured minus predicted.
    """

    what: str
    held_out_rms_v: float
    chi2: float


@dataclass(frozen=True)
class RecordDiagnosis(Findings):
    """The result of the diagnosis of a record at a known input.

    `where` has the residuals of channels without the effects found, `fits` the estimates with them. `gap` is
    measured on excursions held out in turn; `rivals` compares kinds of response there. `far` has a sentence
    for each mean far from the model. `noises` has the noise of each component: the mean of all channels, then
    differences between channels (`RecordWork.helmert`). `hidden` are effects that the record cannot show.
    """

    source: str
    record: Record
    fits: tuple[ChannelFit, ...]
    rivals: tuple[Rival, ...]
    far: tuple[str, ...]
    threshold: float
    noises: tuple[Noise, ...]
    hidden: tuple[str, ...]

    @property
    def white_v(self) -> float:
        """Standard deviation of the white noise of the average of all channels, V, of one mean of readings."""
        return self.noises[0].white / float(np.sqrt(len(self.record.channels)))

    @property
    def slow_v(self) -> float:
        """Standard deviation of the slow noise of the average over all channels, V."""
        return self.white_v * float(np.sqrt(self.noises[0].ratio))

    @property
    def models(self) -> tuple[tuple[AppliedEffect, ...], ...]:
        """The effects found, for a model file: a tuple whose only entry is the tuple of these effects."""
        return (self.applied,)


def diagnose_record(readings: Readings, effects: Sequence[AppliedEffect] = ()) -> RecordDiagnosis:
    """Return the diagnosis of a record at a known input, with known `effects` subtracted.

    The state in which a lag begins is estimated. Raises `CalibrationError` if the record cannot be evaluated.
    """
    record = make_record(readings)
    work = RecordWork.of(record, make_courses(record)).without(effects)
    finds, limit = work.search()
    gap, rivals = measure_record_gap(work, finds)
    why = why_unconfirmed(gap)
    named = (
        *work.named([one for one in finds if one.variant.family not in why], limit),
        *(_unnamed(one, why[one.variant.family], limit) for one in finds if one.variant.family in why),
    )
    courses = [one.variant for one in finds]
    noises = work.noises(courses)
    far = tuple(_far(work, courses, noises))
    return RecordDiagnosis(
        source=readings.source,
        record=work.record,
        of_copy=verdict_of(named, () if named else far, gap),
        where=tuple(_places(work)),
        effects=named,
        fits=tuple(work.fits(courses, noises)),
        gap=gap,
        rivals=rivals,
        far=far,
        threshold=limit.value,
        noises=tuple(noises),
        hidden=tuple(name for name in FOLLOWS if name not in work.candidates.families),
        notes=(*record.notes, *([GAIN_FITTED] * record.several_levels), *([GAIN_IN_DRIFT] * record.ramp)),
    )


def _places(work: RecordWork) -> Iterator[ResidualPattern]:
    """Yield the residuals of each channel about its trend, with their p-value if the noise is white."""
    for channel, left in zip(work.record.channels, work.beside_trend.T, strict=True):
        white = np.mean(np.diff(left) ** 2) / 2.0
        p = float(special.chdtrc(work.freedom, float(left @ left) / white)) if white else 0.0
        yield ResidualPattern(CHANNELS[channel], REFERENCE, "slow in time", rms(left), "V", p, p)


def _far(work: RecordWork, courses: Sequence[Variant], noises: Sequence[Noise]) -> Iterator[str]:
    """Yield a sentence for each mean that model and earlier readings do not predict, farthest first."""
    found = []
    for part, noise in enumerate(noises):
        mean, _, _ = work.fitted(part, courses, noise)
        design = work.design(courses, part)
        left = design[:, -1] - design[:, :-1] @ mean
        lower = linalg.cholesky(noise.covariance, lower=True)
        white = np.abs(linalg.solve_triangular(lower, left, lower=True))
        channel = CHANNELS[work.record.channels[int(np.argmax(np.abs(work.helmert[part])))]]
        for row in np.flatnonzero(white >= FAR):
            if 2.0 * float(special.ndtr(-white[row])) * work.signal.size < BY_CHANCE:
                found.append((float(white[row]), channel, float(work.record.time_h[row])))
    for size, channel, at in sorted(found, key=lambda one: -one[0]):
        yield message(f"channel {channel} at {at:.2f} h jumps by {size:.0f} u")


def _unnamed(find: FoundEffect, why: str, limit: Threshold) -> NamedEffect:
    """Return an unnamed effect to report in place of one that held-out readings do not confirm."""
    words = message(f"{UNNAMED_WORDS[SLOW_IN_TIME]}: {find.variant.family} would explain it, but {why}")
    return NamedEffect.unnamed(SLOW_IN_TIME, limit.p(find.total), words, find.odds)


# --- excursions held out in turn ------------------------------------------------------------------------

PLATEAU: Final = 0.15
"""Largest difference within one level, as a fraction of the range of the quantity that an effect follows.

In an excursion, the quantity differs from its rest level by more than this.
"""


def measure_record_gap(work: RecordWork, finds: Sequence[FoundEffect]) -> tuple[Gap, tuple[Rival, ...]]:
    """Return the gap on held-out excursions with the effects `finds`, and the comparison of responses."""
    noises = work.noises([one.variant for one in finds])
    folds: list[Fold] = []
    for number, course in enumerate(one.variant for one in finds):
        family = course.family
        masks = list(_excursions(work, course))
        others = [one.variant for i, one in enumerate(finds) if i != number]
        # a jump keeps its time, as a gap hides it
        close = work.close_shapes([one.variant for one in finds], number)
        shapes = close if family == MOVE else [*work.shapes_of(family), *close]
        for label, rows in masks if len(masks) > 1 else ():
            before, after = (_predicted(work, others, trials, rows, noises) for trials in ((), shapes))
            folds.append(Fold(label, {family: before.chi2 - after.chi2}, before, after))
    size = NoiseSize(noises[0].white / len(work.parts) ** 0.5, 0.0, work.freedom)
    gap = Gap(tuple(folds), size, "V", tuple(one.variant.family for one in finds))
    return gap, tuple(_rivals(work, finds, noises))


def why_unconfirmed(gap: Gap) -> dict[str, str]:
    """Return the names of the effects that held-out excursions do not confirm, each with the reason."""
    gains = {name: [fold.gains[name] for fold in gap.folds if name in fold.gains] for name in gap.unconfirmed}
    return {
        name: message(f"held-out readings do not confirm it (chi-square falls by {sum(each):.1f} in total)")
        if each
        else message(
            "there is one excursion of what it follows; a second one, at another time, would confirm it"
        )
        for name, each in gains.items()
    }


def _excursions(work: RecordWork, course: Variant) -> Iterator[tuple[str, Mask]]:
    """Yield label and mask of means to hold out in turn: excursions of the quantity that `course` follows.

    For a course in time they are two halves, of alternate blocks of means.
    """
    record, conditions = work.record, work.record.conditions
    match FOLLOWS[course.family]:
        case "meter":
            driver = conditions.meter_warmth_k
        case "rail":
            driver = conditions.above_nominal_v[:, round(dict(course.shape)["rail"]) - 1]
        case _:
            turn = np.arange(len(record)) // FOLDS % 2
            for number, which in enumerate((message("first"), message("next"))):
                yield message(f"every other {FOLDS} means, from the {which}"), turn == number
            return
    from_rest = driver - _rest(driver)
    side = np.where(np.abs(from_rest) > PLATEAU * np.ptp(driver), np.sign(from_rest), 0.0)
    turns = np.flatnonzero(np.diff(side)) + 1
    bounds: list[int] = [0, *turns.tolist(), len(side)]
    for start, end in pairwise(bounds):
        if side[start] and end - start >= FOLDS:
            rows = np.zeros(len(side), dtype=bool)
            rows[start:end] = True
            word = "high" if side[start] > 0 else "low"
            yield f"{word} from {record.time_h[start]:.1f} to {record.time_h[end - 1]:.1f} h", rows


def _rest(driver: Floats) -> float:
    """Return the level from which excursions count: the most frequent one, or the median if none is frequent."""
    ordered = np.sort(driver)
    last = np.searchsorted(ordered, ordered + PLATEAU * np.ptp(driver), side="right")
    inside = last - np.arange(len(ordered))
    start = int(np.argmax(inside))
    common = inside[start] >= 2 * PLATEAU * len(ordered)
    return float(np.median(ordered[start : last[start]] if common else driver))


def _predicted(
    work: RecordWork,
    others: Sequence[Variant],
    shapes: Sequence[Variant],
    rows: Mask,
    noises: Sequence[Noise],
) -> HeldOut:
    """Predict the held-out `rows` from the others, with the courses `others` and the best of `shapes`.

    A straight line is subtracted from the errors, as slow noise sets the level after an excursion. The
    chi-square is that of all rows minus that of the rows not held out.
    """
    rest = np.flatnonzero(~rows)
    lower = [linalg.cholesky(noise.covariance[np.ix_(rest, rest)], lower=True) for noise in noises]

    def fitted(courses: Sequence[Variant]) -> list[tuple[Floats, Floats, float]]:
        white = [
            linalg.solve_triangular(half, work.design(courses, k)[rest], lower=True)
            for k, half in enumerate(lower)
        ]
        return [solved(one[:, :-1], one[:, -1]) for one in white]

    trials = [[*others, shape] for shape in shapes] or [list(others)]
    fits = [fitted(courses) for courses in trials]
    best = int(np.argmin([sum(one[2] for one in parts) for parts in fits]))
    chi2, error = 0.0, np.empty((int(rows.sum()), len(work.parts)))
    for k, (mean, _, of_rest) in enumerate(fits[best]):
        design = work.design(trials[best], k)[rows]
        error[:, k] = design[:, -1] - design[:, :-1] @ mean
        chi2 += work.fitted(k, trials[best], noises[k])[2] - of_rest
    error_v = error @ work.helmert * work.record.scale[rows, None]
    beside = least_squares(work.record.trend[rows], error_v)[1].ravel()
    return HeldOut(beside, beside, np.full_like(beside, np.nan), chi2)


def _rivals(work: RecordWork, finds: Sequence[FoundEffect], noises: Sequence[Noise]) -> Iterator[Rival]:
    """Yield how kinds of response predict excursions, for the first effect of the meter's temperature."""
    thermal = next((one for one in finds if FOLLOWS[one.variant.family] == "meter"), None)
    masks = [] if thermal is None else list(_excursions(work, thermal.variant))
    if thermal is None or len(masks) < 2:
        return
    others = [one.variant for one in finds if one is not thermal]
    family = work.shapes_of(thermal.variant.family)
    kinds = {
        message("at once"): [c for c in family if not c.shape],
        "lag": [c for c in family if "lag" in dict(c.shape)],
        "hysteresis": [c for c in family if "width" in dict(c.shape)],
    }
    for what, shapes in kinds.items():
        if shapes:
            held = [_predicted(work, others, shapes, rows, noises) for _, rows in masks]
            yield Rival(what, rms(np.concatenate([one.error for one in held])), sum(one.chi2 for one in held))
