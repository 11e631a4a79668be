"""Twins of the records: simulated records with the effects and the noise found, and what their diagnosis gives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats
from bench.diagnosis.record_diagnosis import RecordDiagnosis, diagnose_record
from bench.diagnosis.record_model import Record, groups_of, make_courses, make_record
from bench.diagnosis.record_noise import Noise, NoiseTrials
from bench.diagnosis.record_search import RecordWork
from bench.readings.table import Readings

SEED: Final = 11
KNOWN: Final = 300
"""Number of twins that are searched with the noise known, and of those whose odds are computed."""
SAME, TIE, FEWER, OTHER = "same names", "another tie", "fewer names", "another name"
"""What the names of a twin are beside those of its record."""
Names = Sequence[frozenset[str]]
"""The possible names of each effect found."""
Sizes = dict[tuple[str, str, str], tuple[float, float]]
"""Value and u of each parameter, by effect, parameter and channel."""


def simulated_v(found: RecordDiagnosis, record: Record, rng: np.random.Generator) -> Floats:
    """Return deviations (n, c), V, with the zero, drift, effects and noise found in a record."""
    noise = np.column_stack([one.drawn(rng, 1)[:, 0] for one in found.noises])
    zero_v, drift_v_h = np.array([(fit.zero_v, fit.drift_v_h) for fit in found.fits]).T
    trend = zero_v + drift_v_h * (record.time_h - record.time_h[-1] / 2.0)[:, None]
    slow = noise @ RecordWork.of(record).helmert * record.scale[:, None]
    return np.asarray(trend + record.added_by(found.applied) + slow)


def twin_of(readings: Readings, found: RecordDiagnosis, seed: int = SEED) -> Readings:
    """Return a record whose means are simulated.

    Times, temperatures, reference, and the scatter of the readings about their mean are those of the record, so
    that the noise of the means is the noise found. Readings before the first mean are shifted with it.
    """
    record = make_record(readings)
    shift = simulated_v(found, record, np.random.default_rng(seed)) - record.deviation_v
    groups, signal, channels = groups_of(readings.time_s), readings.signal.copy(), np.array(record.channels)
    for number, rows in enumerate(groups, len(record) - len(groups)):
        signal[rows[:, None], channels] += shift[max(number, 0)]
    return replace(readings, signal=signal)


def names_of(found: RecordDiagnosis) -> Names:
    """Return the possible names of each effect of the catalogue that was found."""
    return [frozenset({one.name, *one.cannot_tell_from}) for one in found.effects if one.in_catalogue]


def judged(record: Names, twin: Names) -> str:
    """Return what the names of a twin are beside those of its record.

    "same names": the same possible names of each effect. "another tie": each effect of the one shares a name with
    one of the other. "another name": an effect shares no name with those of the record. Otherwise "fewer names".
    """
    left, found = list(twin), 0
    for mine in sorted(record, key=lambda one: one not in twin):
        match = mine if mine in left else next((one for one in left if one & mine), None)
        if match is not None:
            left.remove(match)
            found += 1
    if left:
        return OTHER
    if found < len(record):
        return FEWER
    return SAME if Counter(record) == Counter(twin) else TIE


def sizes_off(record: RecordDiagnosis, twin: RecordDiagnosis) -> dict[str, float]:
    """Return how far each size of a twin is from the size put in, in units of the twin's u, by parameter.

    A shape parameter counts only if the twin has the same shape, such as a lag.
    """
    truth, sizes = _sizes(record), _sizes(twin)
    return {
        " of ".join(filter(None, (parameter, channel))): (sizes[key][0] - value) / sizes[key][1]
        for key, (value, _) in truth.items()
        for parameter, channel in [key[1:]]
        if key in sizes
    }


def _sizes(found: RecordDiagnosis) -> Sizes:
    return {
        (" ".join(sorted({one.name, *one.cannot_tell_from})), v.parameter, v.channel): (v.value, v.u)
        for one in found.effects
        for v in one.parameters
        if v.u
    }


@dataclass(frozen=True)
class Twins:
    """The outcome of many twins of a record.

    `names` counts what `judged` returns; `known`, the same for twins that are searched with the noise known.
    `odds` is what `odds_of_the_last` returns. Both are None for a record of several channels. `off` are the
    deviations of all sizes in u, of twins with the same names.
    """

    names: Counter[str]
    known: Counter[str] | None
    odds: tuple[float, Floats, float] | None
    off: Floats


def make_twins(readings: Readings, found: RecordDiagnosis, seeds: int) -> Twins:
    """Diagnose twins with the seeds from 1 to `seeds`."""
    each = [diagnose_record(twin_of(readings, found, seed)) for seed in range(1, seeds + 1)]
    words = [judged(names_of(found), names_of(twin)) for twin in each]
    off = [
        value
        for twin, word in zip(each, words, strict=True)
        if word == SAME
        for value in sizes_off(found, twin).values()
    ]
    if len(found.noises) > 1:
        return Twins(Counter(words), None, None, np.array(off))
    known, odds = Counter(searched_with_the_noise_known(found)), odds_of_the_last(found)
    return Twins(Counter(words), known, odds, np.array(off))


def odds_of_the_last(found: RecordDiagnosis) -> tuple[float, Floats, float]:
    """Return ln of the odds of the last effect of a record, those of `KNOWN` twins, and the limit that they exceed.

    The other effects are in the model. The record has one channel.
    """
    rng, record = np.random.default_rng(SEED), found.record
    work = RecordWork.of(record, make_courses(record))
    finds, limit = work.search()
    drawn = np.hstack([simulated_v(found, record, rng) for _ in range(KNOWN)]) / record.scale[:, None]
    odds = work.log_odds([one.variant for one in finds[:-1]], [drawn])[1]
    return finds[-1].total, np.asarray(special.logsumexp(odds, axis=0)), max(limit.value, 0.0)


@dataclass(frozen=True)
class _OneNoise(NoiseTrials):
    """A single trial noise: the true one."""

    noise: Noise

    def whitened(self, columns: Floats) -> Iterator[tuple[Noise, Floats]]:
        yield self.noise, self.noise.whiten(columns)


def searched_with_the_noise_known(found: RecordDiagnosis) -> Iterator[str]:
    """Yield what the names of each of `KNOWN` twins are if their search is given the true kind and ratio of noise.

    No search without this knowledge can be expected to do better. The record has one channel.
    """
    rng, record = np.random.default_rng(SEED), found.record
    work, (noise,) = RecordWork.of(record, make_courses(record)), found.noises
    known = _OneNoise(work.trials.slow, work.trials.trend, replace(noise, variance=1.0))
    for _ in range(KNOWN):
        deviation_v = simulated_v(found, record, rng)
        finds, _ = replace(work, record=replace(record, deviation_v=deviation_v), trials=known).search()
        yield judged(names_of(found), [frozenset({one.variant.family, *one.ties}) for one in finds])
