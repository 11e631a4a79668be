"""The search of a record at a known input: courses scored by their evidence, and estimates of those found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, HOUR, Floats
from bench.diagnosis.candidates import Candidates, Variant
from bench.diagnosis.evidence import NULLS, SEED, Scores, Threshold, fit_tail
from bench.diagnosis.levels import INSEPARABLE, OFTEN, STEPS
from bench.diagnosis.naming import MOST_EFFECTS, FoundEffect, Naming, holding, ranked_odds
from bench.diagnosis.open_parts import Shape
from bench.diagnosis.pipeline import effects_of
from bench.diagnosis.posterior import Posterior
from bench.diagnosis.record_model import MOVE, Noise, NoiseTrials, Record, courses_of, solved
from bench.diagnosis.result import NamedEffect
from bench.model.effects import CATALOGUE

FINE: Final = 41
"""Number of values of a shape parameter over which its effect is averaged, all in the likely range."""
FAINT: Final = 9.0
"""A value is likely if ln of its likelihood is less than this below the maximum: within 4.2 normal u."""


@dataclass(frozen=True)
class ChannelFit:
    """Zero (V) and drift (V/h) of a channel with their u, estimated together with the effects found.

    `before_v` (n,) are the residuals of a fit of zero and drift only, V; `residual_v` (n,), the residuals of a
    fit that includes the effects, V.
    """

    channel: str
    zero_v: float
    u_zero_v: float
    drift_v_h: float
    u_drift_v_h: float
    before_v: Floats
    residual_v: Floats


@dataclass(frozen=True)
class Forms:
    """The h forms that a course may have in a record, with what the record says of each.

    `columns` (n, h) are their columns, as in `courses_of`. `log` (h,) is ln of the likelihood; `size` and
    `variance` (parts, h) are the size and its variance in each component. The first forms have the `values` of
    the shape `parameter`, with the probabilities `of_values` among each other; the parameter is None if there is
    none, or it has no unit.
    """

    columns: Floats
    log: Floats
    size: Floats
    variance: Floats
    parameter: str | None = None
    values: Floats = field(default_factory=lambda: np.zeros(0))
    of_values: Floats = field(default_factory=lambda: np.zeros(0))

    def spread_beside(self, noise: Noise, design: Floats, held: Floats, target: Floats) -> Floats:
        """Return the covariance (p, p) that the unknown form adds to the estimates of the columns of a design.

        `design` (n, p) lacks the column of the course. `held` (n,) is the column with which the estimates were
        made: deviations are from these estimates. `target` (n,) are the data.
        """
        weight = special.softmax(self.log)
        likely = weight > INSEPARABLE
        white = noise.whiten(np.column_stack([design, target, held, self.columns[:, likely]]))
        count = design.shape[1]
        own, aim = white[:, :count], white[:, count]
        each = [solved(np.column_stack([own, one]), aim)[0][:count] for one in white[:, count + 1 :].T]
        off = np.array(each[1:]) - each[0]
        return np.asarray((off.T * weight[likely]) @ off)


@dataclass(frozen=True)
class RecordWork:
    """A record, the courses that may explain it, and its trial noises.

    The c channels are evaluated as c components: their mean, and their differences (`helmert`). The record has n
    means.
    """

    record: Record
    candidates: Candidates
    trials: NoiseTrials

    @classmethod
    def of(cls, record: Record, candidates: Candidates | None = None) -> RecordWork:
        """Return a record with its trial noises; without `candidates`, it can be fitted but not searched."""
        return cls(record, candidates or courses_of(record, ()), NoiseTrials.of(record))

    def shapes_of(self, family: str) -> list[Variant]:
        """Return the candidates of the effect with the name `family`, one for each shape."""
        return [variant for variant in self.candidates.variants if variant.family == family]

    def nearest(self, family: str, shape: Shape) -> Variant | None:
        """Return the candidate of the effect `family` with the nearest shape; None if none has its parameters."""
        names = [name for name, _ in shape]
        alike = [one for one in self.shapes_of(family) if [name for name, _ in one.shape] == names]
        apart = [sum(abs(a - b) for (_, a), (_, b) in zip(one.shape, shape, strict=True)) for one in alike]
        return alike[int(np.argmin(apart))] if alike else None

    def of_channels(self, variant: Variant) -> bool:
        """Return whether each channel has its own size of the effect; otherwise one size is common to all."""
        return self.candidates.kinds[variant.columns[0]].channel is not None

    def less(self, added_v: Floats) -> RecordWork:
        """Return the work with known voltages `added_v` (n, c), V, subtracted from the record."""
        return replace(self, record=self.record.less(added_v))

    def settling(self, lag_s: float) -> RecordWork:
        """Return the work with one more column of the trend: what a lag leaves of an unknown state at the start."""
        left = np.exp(-(self.record.time_h - self.record.time_h[0]) * HOUR / lag_s)
        trend = np.column_stack([self.trials.trend, left / self.record.scale])
        return replace(self, trials=replace(self.trials, trend=trend))

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

    def columns(self, courses: Sequence[Variant], part: int) -> Floats:
        """Return the columns (n, m) of courses in the component `part`.

        A course that all channels share occurs in the mean only, so that m may be less than the number of
        courses.
        """
        mine = [course for course in courses if part == 0 or self.of_channels(course)]
        scale = [1.0 if self.of_channels(course) else len(self.parts) ** 0.5 for course in mine]
        return np.asarray(self.candidates.columns[:, [course.columns[0] for course in mine]] * scale)

    def design(self, courses: Sequence[Variant], part: int) -> Floats:
        """Return, for the component `part`, the columns of trend, m courses and signal as one array (n, 3 + m)."""
        return np.column_stack([self.trials.trend, self.columns(courses, part), self.signal[:, part]])

    def noises(self, courses: Sequence[Variant]) -> list[Noise]:
        """Return the most probable noise of each component, with the courses in the model.

        The sizes of the courses have no prior.
        """
        none = np.zeros((len(self.record), 0))
        signal = self.signal
        return [
            self.trials.products(self.columns(courses, k), none, signal[:, k : k + 1]).noise
            for k in self.parts
        ]

    def log_odds(self, found: Sequence[Variant], targets: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return ln of the Bayes factor of each of h variants (h, d), and ln of the posterior odds of each
        family.

        The variants `found` are in the model already. `targets` has, for each component, d data sets as
        columns (n, d).
        """
        every = self.candidates.variants
        columns = self.candidates.columns[:, [one.columns[0] for one in every]]
        common = np.array([not self.of_channels(one) for one in every])
        scale = np.where(common, len(self.parts) ** 0.5, 1.0)
        total = np.zeros((len(every), targets[0].shape[1]))
        for k in self.parts:
            products = self.trials.products(self.columns(found, k), columns, targets[k])
            total += np.where((common & (k > 0))[:, None], 0.0, products.gain(scale))
        families = Scores(total, np.zeros(0)).families(self.candidates)
        return total, families + self.candidates.log_prior[:, None]

    def search(self) -> tuple[RecordWork, list[FoundEffect], Threshold]:
        """Return this work with columns for the effects found, these effects (strongest first), and the threshold.

        Each effect gets its most likely shape, not just the nearest of the grid: otherwise its remainder could be
        taken for a second effect. The threshold is simulated from the noise of this record. It uses fewer data
        sets than for runs, because each is scored with every kind of slow noise.
        """
        rng = np.random.default_rng(SEED)
        nulls = [noise.drawn(rng, NULLS // len(self.trials.slow)) for noise in self.noises([])]
        limit = fit_tail(special.logsumexp(self.log_odds([], nulls)[1], axis=0))
        finds: list[FoundEffect] = []
        work = self
        while len(finds) < MOST_EFFECTS:
            known = [one.variant for one in finds]
            forms, families = work.log_odds(known, [self.signal[:, k : k + 1] for k in self.parts])
            total = float(special.logsumexp(families))
            if total <= max(limit.value, 0.0):
                break
            odds = ranked_odds(dict(zip(self.candidates.families, families[:, 0].tolist(), strict=True)))
            first, *others = holding(odds)
            best = max(self.candidates.of_family(first), key=lambda member: forms[member, 0])
            variant, evidence = self.candidates.variants[best], float(forms[best, 0])
            work, close = work.with_close_shapes([*known, variant], len(known))
            variant = close[0]
            size, u = work.sizes([*known, variant], len(known))
            finds.append(
                FoundEffect(
                    variant, evidence, total, float(np.linalg.norm(size / u)), tuple(others), odds=tuple(odds)
                )
            )
        return work, finds, limit

    def with_close_shapes(self, courses: Sequence[Variant], number: int) -> tuple[RecordWork, list[Variant]]:
        """Return the work with columns for the likely shapes of the course `number`, and a course for each shape.

        The most likely shape is the first. All other `courses` are in the model. A jump, or a course whose shape
        has no continuous parameter, is returned alone.
        """
        course, parameter = courses[number], self._parameter(courses[number])
        if parameter is None or course.family == MOVE:
            return self, [course]
        values, columns = self._along(courses, number, self._tried(course, parameter))
        order = np.argsort(-self._scored(courses, number, columns)[0])
        of, own = self.candidates, list(course.columns)
        begin = of.columns.shape[1] + len(own) * np.arange(len(order))
        more = replace(
            of,
            columns=np.column_stack([of.columns, np.repeat(columns[:, order], len(own), axis=1)]),
            kinds=(*of.kinds, *([of.kinds[k] for k in own] * len(order))),
            scale=np.concatenate([of.scale, np.tile(of.scale[own], len(order))]),
        )
        shapes = [
            course._replace(columns=tuple(range(at, at + len(own))), shape=((parameter, value),))
            for at, value in zip(begin.tolist(), values[order].tolist(), strict=True)
        ]
        return replace(self, candidates=more), shapes

    @staticmethod
    def _parameter(course: Variant) -> str | None:
        """Return the name of the continuous parameter of the shape of a course; None if there is none."""
        names = dict(course.shape)
        parameter = next((p for p in CATALOGUE[course.family].parameters if p.name in names), None)
        return None if parameter is None or parameter.unit == "1" else parameter.name

    def _tried(self, course: Variant, parameter: str) -> list[float]:
        """Return the values of the shape parameter of a course in the grid, in rising order."""
        family = self.shapes_of(course.family)
        return sorted(one.shape[0][1] for one in family if parameter in dict(one.shape))

    # --- estimates ------------------------------------------------------------------------------------

    def fitted(self, part: int, courses: Sequence[Variant], noise: Noise) -> tuple[Floats, Floats, float]:
        """Return the least-squares estimates of trend and courses in the component `part`, for a known noise.

        Three values are returned: the estimates (2 + m,), their covariance (2 + m, 2 + m), and the chi-square of
        the residuals.
        """
        white = noise.whiten(self.design(courses, part))
        return solved(white[:, :-1], white[:, -1])

    def sizes(self, courses: Sequence[Variant], number: int = 0) -> tuple[Floats, Floats]:
        """Return the size of the course with the index `number`, and its u, as multiples of the plausible size.

        Both have an entry for each channel, or one entry if the size is common. All `courses` are in the model.
        The course keeps its shape.
        """
        scored = self._scored(courses, number, self._columns(self.candidates, [courses[number]]))
        return self._averaged(courses[number], *scored)

    def alone(self, course: Variant, *, keeps_shape: bool) -> tuple[Floats, Floats]:
        """Return the size of a course that is alone in the model, and its covariance, in plausible sizes.

        Both have an entry for each channel, or one entry if the size is common: channels share the noise of the
        mean. Unless the course `keeps_shape`, they are averaged over its shapes as in `shaped`.
        """
        if keeps_shape:
            return self._jointly(course, *self._scored([course], 0, self._columns(self.candidates, [course])))
        forms = self.forms([course], 0)
        return self._jointly(course, forms.log, forms.size, forms.variance)

    def shaped(self, courses: Sequence[Variant], number: int) -> tuple[Variant, float | None, Floats, Floats]:
        """Return the course `number` with its mean shape, the u of the shape (SI), its size, and u of the size.

        The sizes are as in `sizes`, but averaged over the shapes of the effect, weighted by their likelihood.
        The values of the course's shape parameter are so close together that the likelihood between them is
        known. The u is None if there is no such parameter, or it has no unit. The other courses keep their
        shapes.
        """
        forms, course = self.forms(courses, number), courses[number]
        averaged = self._averaged(course, forms.log, forms.size, forms.variance)
        if forms.parameter is None:
            return course, None, *averaged
        value = float(forms.of_values @ forms.values)
        steps = np.gradient(forms.values)
        u = float(np.sqrt(forms.of_values @ ((forms.values - value) ** 2 + steps**2 / 12.0)))
        return course._replace(shape=((forms.parameter, value),)), u, *averaged

    def forms(self, courses: Sequence[Variant], number: int) -> Forms:
        """Return the forms that the course `number` may have, with the likelihood of each.

        All other `courses` are in the model and keep their shapes.
        """
        course, parameter = courses[number], self._parameter(courses[number])
        family = self.shapes_of(course.family)
        if parameter is None:
            columns = self._columns(self.candidates, family)
            return Forms(columns, *self._scored(courses, number, columns))
        own = sorted((one for one in family if parameter in dict(one.shape)), key=lambda one: one.shape)
        tried = self._tried(course, parameter)
        if course.family == MOVE:
            values, columns = np.array(tried), self._columns(self.candidates, own)
        else:
            values, columns = self._along(courses, number, tried)
        others = self._columns(self.candidates, [one for one in family if one not in own])
        columns = np.column_stack([columns, others])
        log, size, variance = self._scored(courses, number, columns)
        count = len(values)
        of_values = special.softmax(log[:count])
        # each value counts as the part of the interval between two tried values that it stands for
        log[:count] += np.log(np.gradient(np.interp(values, tried, np.arange(len(tried)))))
        return Forms(columns, log, size, variance, parameter, values, of_values)

    def _along(
        self, courses: Sequence[Variant], number: int, tried: Sequence[float]
    ) -> tuple[Floats, Floats]:
        """Return likely values (h,) of the shape parameter of the course `number`, and their columns (n, h).

        They lie between the values `tried`, close enough for the likelihood between neighbours to be known.
        """
        course, places = courses[number], np.arange(len(tried))
        ((name, _),) = course.shape
        low, high = 0.0, float(places[-1])
        for _ in range(STEPS):  # each draws the values up to 20 times closer together
            fine = np.interp(np.linspace(low, high, FINE), places, tried)
            shapes = [(CATALOGUE[course.family], ((name, value),)) for value in fine.tolist()]
            made = courses_of(self.record, shapes)
            values = np.array([one.shape[0][1] for one in made.variants])
            columns = self._columns(made, made.variants)
            log = self._scored(courses, number, columns)[0]
            inside = np.flatnonzero(log > log.max() - FAINT)
            if len(inside) > FINE / 2:
                break
            ends = values[[max(inside[0] - 1, 0), min(inside[-1] + 1, len(values) - 1)]]
            low, high = np.interp(ends, tried, places)
        return values, columns

    @staticmethod
    def _columns(of: Candidates, variants: Sequence[Variant]) -> Floats:
        return of.columns[:, [one.columns[0] for one in variants]]

    def _scored(
        self, courses: Sequence[Variant], number: int, columns: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return ln of the likelihood (h,), the size and its variance of `columns` in place of a course.

        Each of the h `columns` (n, h) replaces the course `number`. The size and its variance have a row for
        each component, (parts, h).
        """
        course, others = courses[number], [*courses[:number], *courses[number + 1 :]]
        own = self.of_channels(course)
        columns = columns if own else columns * len(self.parts) ** 0.5
        each = [
            self.trials.products(self.columns(others, k), columns, self.signal[:, k : k + 1]).sizes
            for k in (self.parts if own else range(1))
        ]
        log, size, variance = (np.array(of) for of in zip(*each, strict=True))
        return log.sum(axis=0), size, variance

    def _averaged(
        self, course: Variant, log: Floats, size: Floats, variance: Floats
    ) -> tuple[Floats, Floats]:
        """Return size and u of a course in each channel, as an average over forms with the likelihoods `log`."""
        mean, covariance = self._jointly(course, log, size, variance)
        return mean, np.sqrt(np.diag(covariance))

    def _jointly(self, course: Variant, log: Floats, size: Floats, variance: Floats) -> tuple[Floats, Floats]:
        """Return size and covariance of a course in the channels, as an average as in `_averaged`."""
        weight = special.softmax(log)
        mean = size @ weight
        covariance = np.diag((variance + (size - mean[:, None]) ** 2) @ weight)
        if not self.of_channels(course):
            return mean, covariance
        return self.helmert.T @ mean, self.helmert.T @ covariance @ self.helmert

    def named(self, finds: Sequence[FoundEffect], limit: Threshold) -> tuple[NamedEffect, ...]:
        """Return `finds` as named effects with values; `limit` is the threshold of the search.

        A channel whose size is no more than noise is left out, unless all are.
        """
        shown, u_of_shapes, sizes, known = [], [], [np.zeros(0)], [np.zeros(0)]
        courses = [f.variant for f in finds]
        for number, one in enumerate(finds):
            variant, u_shape, size, u = self.shaped(courses, number)
            u = np.sqrt(u**2 + self._by_other_shapes(courses, number))
            seen = special.chdtrc(1, (size / u) ** 2) < OFTEN
            if self.of_channels(variant) and seen.any():
                columns, channels = (tuple(compress(of, seen)) for of in (variant.columns, variant.channels))
                variant = variant._replace(columns=columns, channels=channels)
                size, u = size[seen], u[seen]
            shown.append(replace(one, variant=variant))
            u_of_shapes.append(u_shape)
            sizes.append(size)
            known.append(u)
        fitted = Posterior(
            np.concatenate(sizes), np.diag(np.concatenate(known) ** 2), len(np.concatenate(sizes))
        )
        effects = effects_of(self.candidates, Naming(tuple(shown), 0.0), fitted, limit)
        return tuple(_with_u(effect, u) for effect, u in zip(effects, u_of_shapes, strict=True))

    def _by_other_shapes(self, courses: Sequence[Variant], number: int) -> Floats:
        """Return the variance that the shapes of the other courses add to the size of the course `number`.

        It has an entry for each channel, or one if the size is common, and is in squares of the plausible size.
        """
        course, noises = courses[number], self.noises(courses) if len(courses) > 1 else []
        own = self.of_channels(course)
        variance = np.zeros(len(self.parts) if own else 1)
        for place, other in enumerate(courses):
            if place == number:
                continue
            forms, rest = self.forms(courses, place), [one for one in courses if one not in (course, other)]
            for k in self.parts if own and self.of_channels(other) else range(1):
                beside = self.design([course, *rest], k)
                held = self.columns([other], k)
                column = self.trials.trend.shape[1]
                variance[k] += forms.spread_beside(noises[k], beside[:, :-1], held, beside[:, -1])[
                    column, column
                ]
        return np.asarray(self.helmert.T**2 @ variance) if own else variance

    def fits(self, courses: Sequence[Variant], noises: Sequence[Noise]) -> Iterator[ChannelFit]:
        """Yield zero, drift and residuals of each channel, with the courses in the model.

        `noises` has the noise of each component. u includes the uncertainty of the shapes of the courses.
        """
        estimates = [self.fitted(k, courses, noises[k]) for k in self.parts]
        trend = np.array([mean[:2] for mean, _, _ in estimates])
        variance = np.array([np.diag(spread)[:2] for _, spread, _ in estimates])
        for number, course in enumerate(courses):
            forms, others = self.forms(courses, number), [*courses[:number], *courses[number + 1 :]]
            for k in self.parts if self.of_channels(course) else range(1):
                beside, held = self.design(others, k), self.columns([course], k)
                variance[k] += np.diag(forms.spread_beside(noises[k], beside[:, :-1], held, beside[:, -1]))[
                    :2
                ]
        designs = [self.design(courses, k) for k in self.parts]
        left = [one[:, -1] - one[:, :-1] @ mean for one, (mean, _, _) in zip(designs, estimates, strict=True)]
        residual_v = self.record.scale * (self.helmert.T @ np.array(left))
        per_hour = np.array([1.0, 2.0 / float(self.record.time_h[-1])])
        values, u = per_hour * (self.helmert.T @ trend), per_hour * np.sqrt(self.helmert.T**2 @ variance)
        for number, channel in enumerate(self.record.channels):
            (zero, drift), (u_zero, u_drift) = values[number].tolist(), u[number].tolist()
            before = self.record.beside_trend[:, number]
            yield ChannelFit(CHANNELS[channel], zero, u_zero, drift, u_drift, before, residual_v[number])


def _with_u(effect: NamedEffect, u: float | None) -> NamedEffect:
    """Return the effect with the u of its shape parameter, SI."""
    if u is None:
        return effect
    in_si = {p.name: p.si_per_unit for p in CATALOGUE[effect.name].parameters if p.is_shape}
    values = (replace(v, u=u / in_si[v.parameter]) if v.parameter in in_si else v for v in effect.parameters)
    return replace(effect, parameters=tuple(values))
