"""The diagnosis of a record at a known input: effects named by their evidence, and confirmed by hold-out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, rms
from bench.diagnosis.candidates import SLOW_IN_TIME, Variant
from bench.diagnosis.evidence import Threshold
from bench.diagnosis.levels import BY_CHANCE, FAR
from bench.diagnosis.naming import FoundEffect
from bench.diagnosis.pipeline import verdict_of
from bench.diagnosis.record_folds import Rival, measure_record_gap, why_unconfirmed
from bench.diagnosis.record_model import FOLLOWS, Noise, Record, make_courses, make_record
from bench.diagnosis.record_search import ChannelFit, RecordWork
from bench.diagnosis.result import UNNAMED_WORDS, Findings, NamedEffect
from bench.diagnosis.where import ResidualPattern
from bench.model.effects import AppliedEffect
from bench.readings.table import REFERENCE, Readings


@dataclass(frozen=True)
class RecordDiagnosis(Findings):
    """The result of the diagnosis of a record at a known input.

    `where` describes, for each channel, the residuals after zero and drift are subtracted. `fits` has the
    estimates of each channel from the model with the effects found. `gap` is measured on excursions (of
    temperature or rail voltage) held out in turn. `rivals` compares, on the same excursions, the kinds of
    response of an effect: at once, with a lag, with hysteresis. `far` has a sentence for each mean that is
    far from the model, the farthest first. `noises` has the noise of the mean of the channels, then the noise
    of each difference between channels (`RecordWork.helmert`). `hidden` are the effects that the record
    cannot show.
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
        """Standard deviation of the white noise of the average over all channels, V.

        The value is for one mean of consecutive readings of the record.
        """
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
    """Return the diagnosis of a record at a known input.

    The known `effects` are subtracted with their values. Raises `CalibrationError` if the record cannot be
    evaluated.
    """
    record = make_record(readings)
    work = RecordWork.of(record.less(record.added_by(effects)), make_courses(record))
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
        where=tuple(_places(work.record)),
        effects=named,
        fits=tuple(work.fits(courses, noises)),
        gap=gap,
        rivals=rivals,
        far=far,
        threshold=limit.value,
        noises=tuple(noises),
        hidden=tuple(name for name in FOLLOWS if name not in work.candidates.families),
        notes=record.notes,
    )


def _places(record: Record) -> Iterator[ResidualPattern]:
    """Yield the residuals of each channel after zero and drift, with their p-value if the noise is white."""
    for channel, left in zip(record.channels, record.beside_trend.T, strict=True):
        white = np.mean(np.diff(left) ** 2) / 2.0
        freedom = len(left) - record.trend.shape[1]
        p = float(special.chdtrc(freedom, float(left @ left) / white)) if white else 0.0
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
        yield f"channel {channel} at {at:.2f} h jumps by {size:.0f} u"


def _unnamed(find: FoundEffect, why: str, limit: Threshold) -> NamedEffect:
    """Return an unnamed effect to report in place of a find that held-out readings do not confirm."""
    p = limit.p(find.total)
    words = f"{UNNAMED_WORDS[SLOW_IN_TIME]}: {find.variant.family} would explain it, but {why}"
    return NamedEffect(SLOW_IN_TIME, (), (), (), (), (), p, p, None, words, odds=find.odds)
