"""The search of a record at a known input: courses scored by their evidence, and estimates of what is found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.evidence import Threshold, fit_tail
from bench.diagnosis.naming import ALONE, SET, FamilyOdds
from bench.diagnosis.record_model import Course, Courses, Noise, Record, Whitening, components
from bench.diagnosis.result import EffectValue, NamedEffect
from bench.model.effects import AppliedEffect

NULLS: Final = 200
SEED: Final = 20260
MOST_FINDS: Final = 4
SHOWN: Final = 2.0
"""Standard uncertainties from which a channel has an effect that others have."""


@dataclass(frozen=True)
class ChannelFit:
    """Zero (V) and drift (V/h) of a channel, with u, given the effects found; `residual_v` (n,) are the
    residuals.
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

    @property
    def family(self) -> str:
        """The name of the effect."""
        return self.course.effect.name

    @property
    def names(self) -> tuple[str, ...]:
        """The names that together have the probability `SET`; a single name if its probability is at least
        `ALONE`.
        """
        if self.odds[0].probability >= ALONE:
            return (self.odds[0].name,)
        held = np.cumsum([one.probability for one in self.odds])
        return tuple(one.name for one in self.odds[: int(np.searchsorted(held, SET)) + 1])


class RecordWork:
    """A record with its courses and the products for all sizes of noise."""

    def __init__(
        self, record: Record, courses: Courses, whitening: Whitening, deviation_v: Floats | None = None
    ) -> None:
        """`deviation_v` (n, c) stands in place of that of the record where effects are known."""
        self.record, self.courses, self.whitening = record, courses, whitening
        self.deviation_v = record.deviation_v if deviation_v is None else deviation_v
        self.helmert = components(len(record.channels))
        self.signal: Floats = self.deviation_v / record.scale[:, None] @ self.helmert.T
        self.trend = whitening.trend

    @property
    def parts(self) -> range:
        """The components: the mean of the channels first, then their differences."""
        return range(len(self.helmert))

    def known(self, finds: Sequence[Find], part: int) -> Floats:
        """Return the m columns of the finds in a component, (n, m).

        Finds common to all channels are in the mean only.
        """
        return self.columns([one.course for one in finds], part)

    def columns(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns (n, m) of courses in a component."""
        scale = np.sqrt(len(self.helmert))
        mine = [c.course * (1.0 if c.of_channels else scale) for c in courses if c.of_channels or part == 0]
        return np.column_stack(mine) if mine else np.zeros((len(self.record), 0))

    def noises(self, finds: Sequence[Find]) -> list[Noise]:
        """Return the likeliest noise of each component with the finds."""
        return self.noises_beside([one.course for one in finds])

    def noises_beside(self, courses: Sequence[Course]) -> list[Noise]:
        """Return the likeliest noise of each component with courses of any size."""
        none = np.zeros((len(self.record), 0))
        return [
            self.whitening.products(self.columns(courses, k), none, self.signal[:, k : k + 1]).noise(
                self.whitening.settings
            )
            for k in self.parts
        ]

    def gains(self, finds: Sequence[Find], targets: Sequence[Floats]) -> Floats:
        """Return ln of the evidence of each of h courses given the finds, shape (h, d).

        `targets` (n, d) are the d signals of a component.
        """
        total = np.zeros((len(self.courses.each), targets[0].shape[1]))
        scale = np.where(self.courses.common, np.sqrt(len(self.helmert)), 1.0)
        for k in self.parts:
            products = self.whitening.products(self.known(finds, k), self.courses.columns, targets[k])
            gain = products.with_one(scale) - products.without()
            total += np.where((self.courses.common & (k > 0))[:, None], 0.0, gain)
        return total

    def search(self) -> tuple[list[Find], Threshold]:
        """Return the finds, the strongest first, and the threshold, simulated from noise alone for this very
        record.
        """
        limit = self._threshold()
        finds: list[Find] = []
        while len(finds) < MOST_FINDS:
            log_odds = self.gains(finds, [self.signal[:, k : k + 1] for k in self.parts])[:, 0]
            log_odds += self.courses.log_prior
            total = float(special.logsumexp(log_odds))
            if total <= max(limit.value, 0.0):
                break
            finds.append(self._find(log_odds, total))
        return finds, limit

    def _threshold(self) -> Threshold:
        rng = np.random.default_rng(SEED)
        targets = [self.drawn(noise, rng, NULLS) for noise in self.noises([])]
        return fit_tail(special.logsumexp(self.gains([], targets) + self.courses.log_prior[:, None], axis=0))

    def drawn(self, noise: Noise, rng: np.random.Generator, count: int) -> Floats:
        """Return drawn noise of a component, shape (n, count)."""
        slow = self.whitening.slow[noise.slow]
        size = np.sqrt(noise.variance * (1.0 + noise.ratio * slow.variance))
        return np.asarray(slow.vectors @ (size[:, None] * rng.standard_normal((len(size), count))))

    def _find(self, log_odds: Floats, total: float) -> Find:
        of = {f: float(special.logsumexp(log_odds[self.courses.of_family(f)])) for f in self.courses.families}
        ordered = sorted(of, key=lambda family: -of[family])
        odds = tuple(FamilyOdds(family, float(np.exp(of[family] - total))) for family in ordered)
        mine = self.courses.of_family(ordered[0])
        return Find(self.courses.each[int(mine[np.argmax(log_odds[mine])])], odds, total)

    # --- estimates ------------------------------------------------------------------------------------

    def covariance(self, noise: Noise) -> Floats:
        """Return the covariance (n, n) of the noise of a component, V²."""
        kernel = self.whitening.slow[noise.slow].kernel
        return np.asarray(noise.variance * (np.eye(len(kernel)) + noise.ratio * kernel))

    def whitened(self, noise: Noise, columns: Floats) -> Floats:
        """Return the columns (n, m) times the inverse root of the covariance of the noise."""
        slow = self.whitening.slow[noise.slow]
        size = np.sqrt(noise.variance * (1.0 + noise.ratio * slow.variance))
        return np.asarray((slow.vectors.T @ columns) / size[:, None])

    def fitted(self, part: int, courses: Sequence[Course], noise: Noise) -> tuple[Floats, Floats, float]:
        """Return estimates (2 + m,) of trend and courses in a component, their covariance, and chi-square."""
        columns = [self.trend, self.columns(courses, part), self.signal[:, part : part + 1]]
        white = self.whitened(noise, np.column_stack(columns))
        spread = np.asarray(np.linalg.pinv(white[:, :-1].T @ white[:, :-1], hermitian=True), dtype=np.float64)
        mean = spread @ white[:, :-1].T @ white[:, -1]
        return mean, spread, float(np.sum((white[:, -1] - white[:, :-1] @ mean) ** 2))

    def sizes(self, finds: Sequence[Find], number: int) -> tuple[Floats, Floats]:
        """Return the sizes of a find, in plausible sizes, and their u, averaged over the shapes of its effect."""
        noises, find = self.noises(finds), finds[number]
        shapes = [self.courses.each[i] for i in self.courses.of_family(find.family)]
        parts = self.parts if find.course.of_channels else range(1)
        others = [one.course for one in finds]
        means, variances, chi2 = [], [], []
        for shape in shapes:
            mine = [*others[:number], shape, *others[number + 1 :]]
            estimates = [self.fitted(k, mine, noises[k]) for k in parts]
            at = [2 + [c for c in mine if c.of_channels or k == 0].index(shape) for k in parts]
            means.append([e[0][i] for e, i in zip(estimates, at, strict=True)])
            variances.append([e[1][i, i] for e, i in zip(estimates, at, strict=True)])
            chi2.append(sum(e[2] for e in estimates))
        weight = np.exp(-0.5 * (np.array(chi2) - min(chi2)))
        weight /= weight.sum()
        mean = weight @ np.array(means)
        variance = weight @ (np.array(variances) + (np.array(means) - mean) ** 2)
        if not find.course.of_channels:
            return mean, np.sqrt(variance)
        return self.helmert.T @ mean, np.sqrt((self.helmert.T**2) @ variance)

    def sizes_of(self, course: Course) -> tuple[Floats, Floats]:
        """Return the sizes of one course in this shape, in plausible sizes, and their u."""
        noises = self.noises_beside([course])
        parts = self.parts if course.of_channels else range(1)
        estimates = [self.fitted(k, [course], noises[k]) for k in parts]
        mean = np.array([one[0][2] for one in estimates])
        variance = np.array([one[1][2, 2] for one in estimates])
        if not course.of_channels:
            return mean, np.sqrt(variance)
        return self.helmert.T @ mean, np.sqrt((self.helmert.T**2) @ variance)

    def named(self, finds: Sequence[Find], limit: Threshold) -> Iterator[NamedEffect]:
        """Yield the finds as named effects with their values."""
        for number, find in enumerate(finds):
            size, u = self.sizes(finds, number)
            course = find.course
            applied = course.applied(size, u, self.record.channels)
            if (
                course.of_channels
            ):  # a channel whose size is no more than noise is not said to have the effect
                shown = [i for i, c in enumerate(self.record.channels) if abs(size[i]) > SHOWN * u[i]]
                channels = tuple(CHANNELS[self.record.channels[i]] for i in shown)
                applied = replace(applied, channels=channels or applied.channels)
            chi2 = float(np.sum((size / u) ** 2))
            names = find.names
            yield NamedEffect(
                name=find.family,
                channels=applied.channels if course.of_channels else CHANNELS,
                installations=(),
                cannot_tell_from=tuple(name for name in names if name != find.family),
                plainer_than=(),
                parameters=tuple(values_of(applied)),
                p=float(special.chdtrc(len(size), chi2)),
                p_all_looks=limit.p(find.total),
                rho=float(np.sqrt(chi2)),
                words=course.effect.sentence,
                applied=(replace(applied, either_of=names if len(names) > 1 else ()),),
                odds=find.odds,
            )

    def fits(self, finds: Sequence[Find], noises: Sequence[Noise]) -> Iterator[ChannelFit]:
        """Yield zero, drift and residuals of each channel, given the finds."""
        courses = [one.course for one in finds]
        estimates = [self.fitted(k, courses, noises[k]) for k in self.parts]
        trend = np.array([mean[:2] for mean, _, _ in estimates])
        variance = np.array([np.diag(spread)[:2] for _, spread, _ in estimates])
        left = np.column_stack(
            [
                self.signal[:, k] - np.column_stack([self.trend, self.columns(courses, k)]) @ mean
                for k, (mean, _, _) in enumerate(estimates)
            ]
        )
        per_hour = 2.0 / float(self.record.time_h[-1])
        plain = (
            self.record.deviation_v
            - self.record.trend @ np.linalg.lstsq(self.record.trend, self.record.deviation_v, rcond=None)[0]
        )
        for number, channel in enumerate(self.record.channels):
            turn = self.helmert[:, number]
            value, u = turn @ trend, np.sqrt(turn**2 @ variance)
            yield ChannelFit(
                CHANNELS[channel], float(value[0]), float(u[0]), float(value[1] * per_hour),
                float(u[1] * per_hour), plain[:, number], left @ turn * self.record.scale,
            )  # fmt: skip


def values_of(applied: AppliedEffect) -> Iterator[EffectValue]:
    """Yield the values of an effect in the catalogue's unit; a shape parameter has no u."""
    complete = applied.complete_values()
    for parameter in applied.effect.parameters:
        value = complete[parameter.name] / parameter.si_per_unit
        if parameter.is_shape:
            if value or parameter.default:
                yield EffectValue(parameter.name, "", "", float(value), None, parameter.unit)
            continue
        u = np.asarray(applied.u.get(parameter.name, np.zeros_like(value))) / parameter.si_per_unit
        if not parameter.per_channel:
            yield EffectValue(parameter.name, "", "", float(value), float(u), parameter.unit)
            continue
        for channel in applied.channels:
            at = CHANNELS.index(channel)
            yield EffectValue(parameter.name, channel, "", float(value[at]), float(u[at]), parameter.unit)
