"""The search of a record at a known input: courses scored by their evidence, and estimates of those found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.evidence import SEED, Threshold, fit_tail
from bench.diagnosis.levels import OFTEN
from bench.diagnosis.naming import MOST_EFFECTS, FamilyOdds, holding
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.record_model import Course, Noise, NoiseTrials, Record, solved
from bench.diagnosis.result import NamedEffect

NULLS: Final = 200


@dataclass(frozen=True)
class ChannelFit:
    """Zero (V) and drift (V/h) of a channel with their u, estimated together with the effects found.

    `before_v` (n,) are the residuals with zero and drift only, `residual_v` (n,) those with the effects as
    well, V.
    """

    channel: str
    zero_v: float
    u_zero_v: float
    drift_v_h: float
    u_drift_v_h: float
    before_v: Floats
    residual_v: Floats


class Find(NamedTuple):
    """An effect that was found in a record, as its most probable course.

    `odds` are the posterior probabilities of the names that may explain it. `total` is ln of the odds that
    anything was missing before it was found.
    """

    course: Course
    odds: tuple[FamilyOdds, ...]
    total: float


@dataclass(frozen=True)
class RecordWork:
    """A record, the courses that may explain it, and its trial noises.

    All is evaluated in components: the mean of the c channels, and their differences (`helmert`). n is the
    number of means of the record.
    """

    record: Record
    courses: tuple[Course, ...]
    trials: NoiseTrials

    @classmethod
    def of(cls, record: Record, courses: tuple[Course, ...] = ()) -> RecordWork:
        """Return a record with its trial noises; without `courses`, it can be fitted but not searched."""
        return cls(record, courses, NoiseTrials.of(record))

    def shapes_of(self, family: str) -> list[Course]:
        """Return the courses of the effect with the name `family`, one for each shape."""
        return [course for course in self.courses if course.family == family]

    def less(self, added_v: Floats) -> RecordWork:
        """Return the same with known voltages `added_v` (n, c), V, subtracted from the record."""
        return replace(self, record=self.record.less(added_v))

    @property
    def helmert(self) -> Floats:
        """The orthogonal Helmert matrix (c, c) that converts channels to components.

        The first component is the mean of the channels times the square root of c.
        """
        count = len(self.record.channels)
        return np.asarray(linalg.helmert(count, full=True)) if count > 1 else np.ones((1, 1))

    @property
    def signal(self) -> Floats:
        """The deviations as components, divided by the relative noise of each mean, V, shape (n, c)."""
        return np.asarray(self.record.deviation_v / self.record.scale[:, None] @ self.helmert.T)

    @property
    def parts(self) -> range:
        """The indices of the components: 0 is the mean of the channels, the others are differences."""
        return range(len(self.record.channels))

    def columns(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns (n, m) of courses in the component `part`.

        A course that all channels share occurs in the mean only, so that m may be less than the number of
        courses.
        """
        common = np.sqrt(len(self.parts))
        mine = [c.course * (1.0 if c.of_channels else common) for c in courses if c.of_channels or part == 0]
        return np.column_stack(mine) if mine else np.zeros((len(self.record), 0))

    def design(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns of trend and courses in the component `part`, then its signal, (n, 3 + m)."""
        return np.column_stack([self.trials.trend, self.columns(courses, part), self.signal[:, part]])

    def noises(self, courses: Sequence[Course]) -> list[Noise]:
        """Return the most probable noise of each component, with the courses in the model.

        The sizes of the courses have no prior.
        """
        none = np.zeros((len(self.record), 0))
        signal = self.signal
        return [
            self.trials.products(self.columns(courses, k), none, signal[:, k : k + 1]).noise
            for k in self.parts
        ]

    def gains(self, finds: Sequence[Find], targets: Sequence[Floats]) -> Floats:
        """Return ln of the posterior odds of each of the h courses, given the effects found, shape (h, d).

        `targets` has, for each component, d data sets as columns (n, d).
        """
        courses, columns = [one.course for one in finds], np.column_stack([c.course for c in self.courses])
        common = np.array([not course.of_channels for course in self.courses])
        scale = np.where(common, np.sqrt(len(self.parts)), 1.0)
        total = np.tile([[course.log_prior] for course in self.courses], targets[0].shape[1])
        for k in self.parts:
            products = self.trials.products(self.columns(courses, k), columns, targets[k])
            total += np.where((common & (k > 0))[:, None], 0.0, products.gain(scale))
        return total

    def search(self) -> tuple[list[Find], Threshold]:
        """Return the effects found, the strongest first, and the threshold of the search.

        The threshold is simulated from the noise of this very record.
        """
        rng = np.random.default_rng(SEED)
        nulls = [noise.drawn(rng, NULLS) for noise in self.noises([])]
        limit = fit_tail(special.logsumexp(self.gains([], nulls), axis=0))
        finds: list[Find] = []
        while len(finds) < MOST_EFFECTS:
            log_odds = self.gains(finds, [self.signal[:, k : k + 1] for k in self.parts])[:, 0]
            total = float(special.logsumexp(log_odds))
            if total <= max(limit.value, 0.0):
                break
            finds.append(self._find(log_odds, total))
        return finds, limit

    def _find(self, log_odds: Floats, total: float) -> Find:
        logs: dict[str, float] = {}
        for course, one in zip(self.courses, log_odds.tolist(), strict=True):
            logs[course.family] = float(np.logaddexp(logs.get(course.family, -np.inf), one))
        ordered = sorted(logs, key=lambda family: -logs[family])
        odds = tuple(FamilyOdds(family, float(np.exp(logs[family] - total))) for family in ordered)
        likeliest = np.where([course.family == ordered[0] for course in self.courses], log_odds, -np.inf)
        return Find(self.courses[int(np.argmax(likeliest))], odds, total)

    # --- estimates ------------------------------------------------------------------------------------

    def fitted(self, part: int, courses: Sequence[Course], noise: Noise) -> tuple[Floats, Floats, float]:
        """Return the least-squares estimates of trend and courses in the component `part`, for a known noise.

        They are the estimates (2 + m,), their covariance (2 + m, 2 + m), and the chi-square that is left.
        """
        white = noise.whiten(self.design(courses, part))
        return solved(white[:, :-1], white[:, -1])

    def sizes(
        self, courses: Sequence[Course], number: int = 0, shapes: Sequence[Course] = ()
    ) -> tuple[Floats, Floats]:
        """Return the size and its u, in plausible sizes, of the course with the index `number`.

        Both have an entry for each channel, or one if the size is common. All `courses` are in the model. The
        result is averaged over `shapes`, courses of the same effect, weighted by their likelihood; by default
        the course itself is the only one.
        """
        noises, course = self.noises(courses), courses[number]
        parts = self.parts if course.of_channels else range(1)
        means, variances, chi2 = [], [], []
        for shape in shapes or [course]:
            mine = [*courses[:number], shape, *courses[number + 1 :]]
            estimates = [self.fitted(k, mine, noises[k]) for k in parts]
            at = [2 + [c for c in mine if c.of_channels or k == 0].index(shape) for k in parts]
            means.append([e[0][i] for e, i in zip(estimates, at, strict=True)])
            variances.append([e[1][i, i] for e, i in zip(estimates, at, strict=True)])
            chi2.append(sum(e[2] for e in estimates))
        weight = np.exp(-0.5 * (np.array(chi2) - min(chi2)))
        weight /= weight.sum()
        mean = weight @ np.array(means)
        variance = weight @ (np.array(variances) + (np.array(means) - mean) ** 2)
        if not course.of_channels:
            return mean, np.sqrt(variance)
        return self.helmert.T @ mean, np.sqrt(self.helmert.T**2 @ variance)

    def named(self, finds: Sequence[Find], limit: Threshold) -> Iterator[NamedEffect]:
        """Yield the effects found as results with their values; `limit` is the threshold of the search."""
        courses, channels = [one.course for one in finds], self.record.channels
        for number, (course, odds, total) in enumerate(finds):
            size, u = self.sizes(courses, number, self.shapes_of(course.family))
            applied = course.applied(size, u, channels)
            if (
                course.of_channels
            ):  # a channel whose size is no more than noise is not said to have the effect
                seen = special.chdtrc(1, (size / u) ** 2) < OFTEN
                shown = tuple(CHANNELS[c] for c, one in zip(channels, seen, strict=True) if one)
                applied = replace(applied, channels=shown or applied.channels)
            chi2 = float(np.sum((size / u) ** 2))
            names = tuple(holding(odds))
            yield NamedEffect(
                name=course.family,
                channels=applied.channels,
                installations=(),
                cannot_tell_from=names[1:],
                plainer_than=(),
                parameters=tuple(values_of((applied,))),
                p=float(special.chdtrc(len(size), chi2)),
                p_all_looks=limit.p(total),
                rho=float(np.sqrt(chi2)),
                words=course.effect.sentence,
                applied=(replace(applied, either_of=names if len(names) > 1 else ()),),
                odds=odds,
            )

    def fits(self, courses: Sequence[Course], noises: Sequence[Noise]) -> Iterator[ChannelFit]:
        """Yield zero, drift and residuals of each channel, with the courses in the model.

        `noises` has the noise of each component.
        """
        estimates = [self.fitted(k, courses, noises[k]) for k in self.parts]
        trend = np.array([mean[:2] for mean, _, _ in estimates])
        variance = np.array([np.diag(spread)[:2] for _, spread, _ in estimates])
        designs = [self.design(courses, k) for k in self.parts]
        left = [one[:, -1] - one[:, :-1] @ mean for one, (mean, _, _) in zip(designs, estimates, strict=True)]
        residual_v = self.record.scale * (self.helmert.T @ np.array(left))
        per_hour = np.array([1.0, 2.0 / float(self.record.time_h[-1])])
        values, u = per_hour * (self.helmert.T @ trend), per_hour * np.sqrt(self.helmert.T**2 @ variance)
        for number, channel in enumerate(self.record.channels):
            (zero, drift), (u_zero, u_drift) = values[number].tolist(), u[number].tolist()
            before = self.record.beside_trend[:, number]
            yield ChannelFit(CHANNELS[channel], zero, u_zero, drift, u_drift, before, residual_v[number])
