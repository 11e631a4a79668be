"""The diagnosis of a record at a known input: name what the readings follow, hold out its excursions in turn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats, rms
from bench.diagnosis.evidence import Threshold
from bench.diagnosis.gap import Gap
from bench.diagnosis.record_folds import Rival, measure_record_gap
from bench.diagnosis.record_model import (
    FOLLOWS,
    Noise,
    Record,
    Whitening,
    make_courses,
    make_record,
)
from bench.diagnosis.record_search import ChannelFit, Find, RecordWork
from bench.diagnosis.result import UNNAMED_WORDS, NamedEffect, Verdict
from bench.model.effects import AppliedEffect
from bench.readings.table import Readings

SLOW_IN_TIME: Final = "slow_in_time"


@dataclass(frozen=True)
class Far:
    """A mean of a channel that lies `size_u` standard uncertainties from the value that the model and neighbouring
    means predict.
    """

    channel: str
    time_h: float
    size_u: float
    p: float

    @property
    def words(self) -> str:
        """The place and the size in words."""
        return f"channel {self.channel} at {self.time_h:.2f} h jumps by {self.size_u:.0f} u"


@dataclass(frozen=True)
class Place:
    """The residuals of a channel after zero and drift: their root mean square in V, before any effect is named."""

    channel: str
    pattern: str
    size: float
    p: float
    installation: str = "R"
    unit: str = "V"


@dataclass(frozen=True)
class RecordDiagnosis:
    """The diagnosis of a record at a known input; `gap` is that of the excursions held out in turn.

    `rivals` compares at once, lag and hysteresis by the same excursions. `noises` are those of the components
    of the channels (`record_model.components`).
    """

    source: str
    record: Record
    verdict: Verdict
    where: tuple[Place, ...]
    effects: tuple[NamedEffect, ...]
    fits: tuple[ChannelFit, ...]
    gap: Gap
    rivals: tuple[Rival, ...]
    far: tuple[Far, ...]
    limit: Threshold
    noises: tuple[Noise, ...]
    hidden: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def white_v(self) -> float:
        """Standard deviation of the white noise in a mean of all channels, V."""
        return float(np.sqrt(self.noises[0].variance / len(self.record.channels)))

    @property
    def slow_v(self) -> float:
        """Standard deviation of the slow noise in a mean of all channels, V."""
        return self.white_v * float(np.sqrt(self.noises[0].ratio))

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The named effects with their values."""
        return tuple(applied for effect in self.effects for applied in effect.applied)


def diagnose_record(readings: Readings, known_v: Floats | None = None) -> RecordDiagnosis:
    """Return the diagnosis of a record at a known input, less known effects in its means, `known_v` (n, c).

    Raises `CalibrationError` if it cannot be evaluated.
    """
    record = make_record(readings)
    left = None if known_v is None else record.deviation_v - known_v
    work = RecordWork(record, make_courses(record), Whitening.of(record), left)
    finds, limit = work.search()
    gap, rivals, unconfirmed = measure_record_gap(work, finds)
    confirmed = [one for one in finds if one.family not in unconfirmed]
    effects = (*work.named(confirmed, limit), *_unconfirmed(unconfirmed, finds, limit))
    noises = work.noises(finds)
    far = tuple(_far(work, finds, noises))
    fits = tuple(work.fits(finds, noises))
    return RecordDiagnosis(
        source=readings.source,
        record=record,
        verdict=_verdict(effects, far),
        where=tuple(_places(work)),
        effects=effects,
        fits=fits,
        gap=gap,
        rivals=rivals,
        far=far,
        limit=limit,
        noises=tuple(noises),
        hidden=tuple(name for name in FOLLOWS if name not in work.courses.families),
        notes=record.notes,
    )


def _verdict(effects: Sequence[NamedEffect], far: Sequence[Far]) -> Verdict:
    if any(not one.in_catalogue for one in effects) or (far and not effects):
        return "unknown"
    if any(one.cannot_tell_from for one in effects):
        return "confounded"
    return "named" if effects else "agrees"


def _places(work: RecordWork) -> Iterator[Place]:
    """Yield what each channel leaves beside zero and drift, with the p-value of it by white noise alone."""
    record = work.record
    for number, channel in enumerate(record.channels):
        signal = work.deviation_v[:, number]
        left = signal - record.trend @ np.linalg.lstsq(record.trend, signal, rcond=None)[0]
        white = np.mean(np.diff(left) ** 2) / 2.0
        freedom = len(left) - record.trend.shape[1]
        p = float(special.chdtrc(freedom, float(left @ left) / white)) if white else 0.0
        yield Place(CHANNELS[channel], "slow in time", rms(left), p)


FAR_P: Final = 0.01
FAR_U: Final = 6.0


def _far(work: RecordWork, finds: Sequence[Find], noises: Sequence[Noise]) -> Iterator[Far]:
    """Yield the means that lie far from what model and earlier readings say, the farthest first."""
    courses = [one.course for one in finds]
    found = []
    for part in work.parts:
        lower = linalg.cholesky(work.covariance(noises[part]), lower=True)
        mean, _, _ = work.fitted(part, courses, noises[part])
        design = np.column_stack([work.trend, work.columns(courses, part)])
        white = linalg.solve_triangular(lower, work.signal[:, part] - design @ mean, lower=True)
        for row in np.flatnonzero(np.abs(white) >= FAR_U):
            size = float(abs(white[row]))
            p = min(2.0 * float(special.ndtr(-size)) * white.size * len(work.parts), 1.0)
            channel = work.record.channels[int(np.argmax(np.abs(work.helmert[part])))]
            if p < FAR_P:
                found.append(Far(CHANNELS[channel], float(work.record.time_h[row]), size, p))
    yield from sorted(found, key=lambda one: -one.size_u)


def _unconfirmed(why: dict[str, str], finds: Sequence[Find], limit: Threshold) -> Iterator[NamedEffect]:
    """Yield an unnamed effect in place of each find that readings held out do not confirm."""
    for find in finds:
        if find.family in why:
            yield NamedEffect(
                name=SLOW_IN_TIME,
                channels=(),
                installations=(),
                cannot_tell_from=(),
                plainer_than=(),
                parameters=(),
                p=limit.p(find.total),
                p_all_looks=limit.p(find.total),
                rho=None,
                words=f"{UNNAMED_WORDS[SLOW_IN_TIME]}: {find.family} would explain it, but {why[find.family]}",
                odds=find.odds,
            )
