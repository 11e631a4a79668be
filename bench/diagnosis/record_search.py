"""The search of a record at a known input: courses scored by their evidence, and estimates of what is found."""

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
    """Zero (V) and drift (V/h) of a channel, with u, given the effects found.

    `before_v` (n,) is the channel beside zero and drift alone, `residual_v` (n,) with the effects.
    """

    channel: str
    zero_v: float
    u_zero_v: float
    drift_v_h: float
    u_drift_v_h: float
    before_v: Floats
    residual_v: Floats


class Find(NamedTuple):
    """An effect that was found: its likeliest course, the odds of its names, and the evidence of all."""

    course: Course
    odds: tuple[FamilyOdds, ...]
    total: float


@dataclass(frozen=True)
class RecordWork:
    """A record, the courses that may explain it, and the noises that it may have.

    Its components are the mean of the channels and their differences: the rows of the Helmert matrix.
    """

    record: Record
    courses: tuple[Course, ...]
    trials: NoiseTrials

    @classmethod
    def of(cls, record: Record, courses: tuple[Course, ...] = ()) -> RecordWork:
        """Return a record with its noises; without `courses`, nothing is searched in it."""
        return cls(record, courses, NoiseTrials.of(record))

    def shapes_of(self, family: str) -> list[Course]:
        """Return the courses of one effect."""
        return [course for course in self.courses if course.family == family]

    def less(self, added_v: Floats) -> RecordWork:
        """Return the same without known errors (n, c), V."""
        return replace(self, record=self.record.less(added_v))

    @property
    def helmert(self) -> Floats:
        """The matrix (c, c) from channels to components; the first is the mean times the root of c."""
        count = len(self.record.channels)
        return np.asarray(linalg.helmert(count, full=True)) if count > 1 else np.ones((1, 1))

    @property
    def signal(self) -> Floats:
        """The components (n, c), over the relative size of the noise."""
        return np.asarray(self.record.deviation_v / self.record.scale[:, None] @ self.helmert.T)

    @property
    def parts(self) -> range:
        """The components: the mean of the channels first, then their differences."""
        return range(len(self.record.channels))

    def columns(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns (n, m) of courses in a component; the common ones are in the mean only."""
        common = np.sqrt(len(self.parts))
        mine = [c.course * (1.0 if c.of_channels else common) for c in courses if c.of_channels or part == 0]
        return np.column_stack(mine) if mine else np.zeros((len(self.record), 0))

    def design(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns (n, 2 + m) of trend and courses in a component, and its signal as the last."""
        return np.column_stack([self.trials.trend, self.columns(courses, part), self.signal[:, part]])

    def noises(self, courses: Sequence[Course]) -> list[Noise]:
        """Return the likeliest noise of each component beside courses of any size."""
        none = np.zeros((len(self.record), 0))
        signal = self.signal
        return [
            self.trials.products(self.columns(courses, k), none, signal[:, k : k + 1]).noise
            for k in self.parts
        ]

    def gains(self, finds: Sequence[Find], targets: Sequence[Floats]) -> Floats:
        """Return ln of the posterior odds of each of h courses given the finds, shape (h, d).

        `targets` (n, d) are the d signals of a component.
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
        """Return the finds, the strongest first, and the threshold, simulated from noise alone for this very
        record.
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
        """Return estimates (2 + m,) of trend and courses in a component, their covariance, and chi-square."""
        white = noise.whiten(self.design(courses, part))
        return solved(white[:, :-1], white[:, -1])

    def sizes(
        self, courses: Sequence[Course], number: int = 0, shapes: Sequence[Course] = ()
    ) -> tuple[Floats, Floats]:
        """Return the sizes of one of some courses, in plausible sizes, and their u.

        They are averaged over `shapes` of its effect, by default the one that it has.
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
        """Yield the finds as named effects with their values."""
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
        """Yield zero, drift and residuals of each channel, given the courses found."""
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
