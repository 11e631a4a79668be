"""The search of a record at a known input: effects are scored by their evidence, and estimated.

A course is the change of the signals with time that an effect in one shape causes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, pairwise
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats, least_squares, u_of
from bench.diagnosis.candidates import Candidates, Variant
from bench.diagnosis.evidence import NULLS, SEED, Scores, Threshold, fit_tail
from bench.diagnosis.levels import HARDLY_EVER, INSEPARABLE, OFTEN, STEPS
from bench.diagnosis.naming import MOST_EFFECTS, FoundEffect, Naming, holding, ranked_odds
from bench.diagnosis.pipeline import effects_of
from bench.diagnosis.posterior import Posterior, Shape
from bench.diagnosis.record_model import MOVE, Record, column_of, courses_of, shape_of, start_of
from bench.diagnosis.record_noise import Noise, NoiseTrials, solved
from bench.diagnosis.result import NamedEffect
from bench.model.effects import CATALOGUE, AppliedEffect

FINE: Final = 41
"""Number of values of a shape parameter over which its effect is averaged, all in the likely range."""


@dataclass(frozen=True)
class ChannelFit:
    """Zero (V) and drift (V/h) of a channel with u, estimated together with the effects found.

    For a reference of several levels, the zero is that at 0 V. `before_v` and `residual_v` (n,), V, are
    residuals without and with these effects.
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
    """The h forms (shapes) that a course may have in a record, with ln of their likelihoods, `log` (h,).

    `columns` (n, h) are results of `column_of`, `starts` (n, h) of `start_of`. `size` and `variance` (parts, h) are
    estimates of the amplitude in each component. If the course has a shape `parameter` with a unit, the first forms
    have its `values`, with the probabilities `of_values`.
    """

    columns: Floats
    starts: Floats
    log: Floats
    size: Floats
    variance: Floats
    parameter: str | None = None
    values: Floats = field(default_factory=lambda: np.zeros(0))
    of_values: Floats = field(default_factory=lambda: np.zeros(0))

    def variance_beside(self, noise: Noise, design: Floats, held: Floats) -> Floats:
        """Return the covariance (p, p) that the unknown form adds to the estimates of other columns.

        `design` (n, p + 1) has these p columns, then the data. Deviations are from the estimates with the course in
        the form `held` (n, k).
        """
        weight = special.softmax(self.log)
        likely = np.flatnonzero(weight > INSEPARABLE)
        count = design.shape[1] - 1
        forms = [held, *(np.stack([self.columns[:, k], self.starts[:, k]], axis=1) for k in likely)]
        white = noise.whiten(np.column_stack([design, *forms]))
        own, data = white[:, :count], white[:, count]
        ends = np.cumsum([count + 1, *(form.shape[1] for form in forms)])
        each = [
            solved(np.column_stack([own, white[:, start:end]]), data)[0][:count]
            for start, end in pairwise(ends)
        ]
        off = np.array(each[1:]) - each[0]
        return np.asarray((off.T * weight[likely]) @ off)


@dataclass(frozen=True)
class RecordWork:
    """A record of n means, the courses that may explain it, and its trial noises.

    Its c channels are evaluated as c components, their mean and their differences (`helmert`). `kept` is a
    cache of columns by name and shape of an effect.
    """

    record: Record
    candidates: Candidates
    trials: NoiseTrials
    kept: dict[tuple[str, Shape], Floats] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, record: Record, candidates: Candidates | None = None) -> RecordWork:
        """Return a record with its trial noises; without `candidates`, it can be fitted but not searched."""
        return cls(record, candidates or courses_of(record, ()), NoiseTrials.of(record))

    def shapes_of(self, family: str) -> list[Variant]:
        """Return the candidates of the effect with the name `family`, one for each shape."""
        return [variant for variant in self.candidates.variants if variant.family == family]

    def nearest(self, family: str, shape: Shape) -> Variant | None:
        """Return the candidate of the effect `family` whose shape parameters are nearest to `shape`, if any.

        None means that no candidate of this effect has parameters of these names.
        """
        names = [name for name, _ in shape]
        alike = [one for one in self.shapes_of(family) if [name for name, _ in one.shape] == names]
        apart = [sum(abs(a - b) for (_, a), (_, b) in zip(one.shape, shape, strict=True)) for one in alike]
        return alike[int(np.argmin(apart))] if alike else None

    def of_channels(self, variant: Variant) -> bool:
        """Return whether the effect has an amplitude for each channel, and not one common to all."""
        return self.candidates.kinds[variant.columns[0]].channel is not None

    def without(self, effects: Sequence[AppliedEffect]) -> RecordWork:
        """Return the record with known effects subtracted; their starting states join the trend."""
        shapes = [(one.effect, shape_of(one.effect, one.complete_values())) for one in effects]
        starts = [start_of(self.record, *one) for one in dict.fromkeys(shapes)]
        trials = replace(self.trials, trend=np.column_stack([self.trials.trend, *filter(np.any, starts)]))
        return replace(self, record=self.record.less(self.record.added_by(effects)), trials=trials)

    @property
    def beside_trend(self) -> Floats:
        """The deviations minus the fit of trend and starting states of known effects, V, shape (n, c)."""
        return least_squares(self.trials.trend * self.record.scale[:, None], self.record.deviation_v)[1]

    @property
    def freedom(self) -> int:
        """The degrees of freedom of each component after a fit of trend and starting states of known effects."""
        return len(self.record) - int(self.trials.trend.shape[1])

    @property
    def helmert(self) -> Floats:
        """The orthogonal Helmert matrix (c, c) from channels to components; the first is √c times their mean."""
        count = len(self.record.channels)
        return np.asarray(linalg.helmert(count, full=True)) if count > 1 else np.ones((1, 1))

    @property
    def signal(self) -> Floats:
        """The deviations as components, each mean divided by its relative noise, V, shape (n, c)."""
        return np.asarray(self.record.deviation_v / self.record.scale[:, None] @ self.helmert.T)

    @property
    def parts(self) -> range:
        """The indices of the components: 0 is the mean of the channels, the others are differences."""
        return range(len(self.record.channels))

    def _in_part(self, courses: Sequence[Variant], part: int) -> tuple[Floats, Floats]:
        """Return columns and starting states, each (n, m), of courses in the component `part`.

        A course with one amplitude for all channels is in the mean only, so that m may be below their number.
        """
        mine = [course for course in courses if part == 0 or self.of_channels(course)]
        for one in mine:
            if (one.family, one.shape) not in self.kept:
                of = (self.record, CATALOGUE[one.family], one.shape)
                self.kept[one.family, one.shape] = np.stack([column_of(*of), start_of(*of)])
        scale = np.array([1.0 if self.of_channels(course) else len(self.parts) ** 0.5 for course in mine])
        each = np.array([self.kept[one.family, one.shape] for one in mine])
        columns, starts = each.reshape(len(mine), 2, len(self.record)).transpose(1, 2, 0) * scale
        return columns, starts

    def columns(self, courses: Sequence[Variant], part: int) -> Floats:
        """Return the columns of courses in the component `part`, then those of their starting states, (n, m)."""
        columns, starts = self._in_part(courses, part)
        return np.column_stack([columns, starts[:, np.any(starts, axis=0)]])

    def design(self, courses: Sequence[Variant], part: int) -> Floats:
        """Return the columns of trend, courses, their starting states, and signal in the component `part`."""
        return np.column_stack([self.trials.trend, self.columns(courses, part), self.signal[:, part]])

    def noises(self, courses: Sequence[Variant]) -> list[Noise]:
        """Return the most probable noise of each component; the amplitudes of the courses have no prior."""
        none, signal = np.zeros((len(self.record), 0)), self.signal
        return [
            self.trials.products(self.columns(courses, k), none, signal[:, k : k + 1]).noise
            for k in self.parts
        ]

    def log_odds(self, found: Sequence[Variant], targets: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return ln of the Bayes factor (h, d) of each variant, and ln of the posterior odds of each family.

        The variants `found` are in the model already. `targets` has d data sets (n, d) for each component.
        """
        every = self.candidates.variants
        own = np.array([self.of_channels(one) for one in every])
        total = np.zeros((len(every), targets[0].shape[1]))
        for k in self.parts:
            columns, starts = self._in_part(every, k)
            total[own | (k == 0)] += self.trials.products(
                self.columns(found, k), columns, targets[k], starts
            ).gain
        families = Scores(total, np.zeros(0)).families(self.candidates)
        return total, families + self.candidates.log_prior[:, None]

    def search(self) -> tuple[list[FoundEffect], Threshold]:
        """Return the effects found, strongest first, and the threshold, simulated from the noise of this record.

        An effect takes its likeliest shape: residuals of another shape could be taken for another effect.
        Fewer data sets are simulated than for runs, because each is scored with every kind of slow noise.
        """
        rng = np.random.default_rng(SEED)
        nulls = [noise.drawn(rng, NULLS // len(self.trials.slow)) for noise in self.noises([])]
        limit = fit_tail(special.logsumexp(self.log_odds([], nulls)[1], axis=0))
        finds: list[FoundEffect] = []
        while len(finds) < MOST_EFFECTS:
            known = [one.variant for one in finds]
            forms, families = self.log_odds(known, [self.signal[:, k : k + 1] for k in self.parts])
            total = float(special.logsumexp(families))
            if total <= max(limit.value, 0.0):
                break
            odds = ranked_odds(dict(zip(self.candidates.families, families[:, 0].tolist(), strict=True)))
            first, *others = holding(odds)
            best = max(self.candidates.of_family(first), key=lambda member: forms[member, 0])
            variant = self.close_shapes([*known, self.candidates.variants[best]], len(known))[0]
            size, covariance = self.sizes([*known, variant], len(known))
            rho = float(np.linalg.norm(size / u_of(covariance)))
            finds.append(
                FoundEffect(variant, float(forms[best, 0]), total, rho, tuple(others), odds=tuple(odds))
            )
        return finds, limit

    # --- estimates ------------------------------------------------------------------------------------

    def fitted(self, part: int, courses: Sequence[Variant], noise: Noise) -> tuple[Floats, Floats, float]:
        """Return estimates (p,), covariance and chi-square of `design` in a component, for a known noise."""
        white = noise.whiten(self.design(courses, part))
        return solved(white[:, :-1], white[:, -1])

    def sizes(
        self, courses: Sequence[Variant], number: int = 0, forms: Forms | None = None
    ) -> tuple[Floats, Floats]:
        """Return the amplitude of the course `number` in a fit of all `courses`, and its covariance.

        Both are in plausible sizes, and have an entry for each channel, or one for an amplitude common to all. With
        `forms`, they are averages over the possible forms of the course, weighted by likelihood.
        """
        course = courses[number]
        log, size, variance = (
            self._scored(courses, number, [course])
            if forms is None
            else (forms.log, forms.size, forms.variance)
        )
        weight = special.softmax(log)
        mean = size @ weight
        covariance = np.diag((variance + (size - mean[:, None]) ** 2) @ weight)
        if not self.of_channels(course):
            return mean, covariance
        return self.helmert.T @ mean, self.helmert.T @ covariance @ self.helmert

    def shaped(self, courses: Sequence[Variant], number: int) -> tuple[Variant, float | None, Floats, Floats]:
        """Return a course in its mean shape, u of this shape (SI or None), its amplitudes, and their u."""
        forms, course = self.forms(courses, number), courses[number]
        size, covariance = self.sizes(courses, number, forms)
        if forms.parameter is None:
            return course, None, size, u_of(covariance)
        value = float(forms.of_values @ forms.values)
        steps = np.gradient(forms.values)
        u = float(np.sqrt(forms.of_values @ ((forms.values - value) ** 2 + steps**2 / 12.0)))
        return course._replace(shape=((forms.parameter, value),)), u, size, u_of(covariance)

    def forms(self, courses: Sequence[Variant], number: int) -> Forms:
        """Return the forms of the course `number` with their likelihoods; other courses keep their shapes."""
        course, parameter = courses[number], _parameter(courses[number])
        family = self.shapes_of(course.family)
        if parameter is None:
            return Forms(*self._in_part(family, 0), *self._scored(courses, number, family))
        own = sorted((one for one in family if parameter in dict(one.shape)), key=lambda one: one.shape)
        tried = [one.shape[0][1] for one in own]
        close = own if course.family == MOVE else self._along(courses, number)
        every = [*close, *(one for one in family if one not in own)]
        log, size, variance = self._scored(courses, number, every)
        values, count = np.array([one.shape[0][1] for one in close]), len(close)
        of_values = special.softmax(log[:count])
        # each value counts as the part of the interval between two tried values that it stands for
        log[:count] += np.log(np.gradient(np.interp(values, tried, np.arange(len(tried)))))
        return Forms(*self._in_part(every, 0), log, size, variance, parameter, values, of_values)

    def close_shapes(self, courses: Sequence[Variant], number: int) -> list[Variant]:
        """Return the course `courses[number]` in its likely shapes, best first.

        A jump, or a course without a continuous shape parameter, is returned as it is.
        """
        course = courses[number]
        if course.family == MOVE or _parameter(course) is None:
            return [course]
        shapes = self._along(courses, number)
        return [shapes[k] for k in np.argsort(-self._scored(courses, number, shapes)[0])]

    def _along(self, courses: Sequence[Variant], number: int) -> list[Variant]:
        """Return the course `number` in its likely shapes, by parameter, close enough to interpolate."""
        course = courses[number]
        ((name, _),) = course.shape
        family = self.shapes_of(course.family)
        tried = sorted(one.shape[0][1] for one in family if name in dict(one.shape))
        low, high = 0.0, float(len(tried) - 1)
        for _ in range(STEPS):  # each draws the values up to 20 times closer together
            values = np.interp(np.linspace(low, high, FINE), np.arange(len(tried)), tried)
            shapes = [course._replace(shape=((name, value),)) for value in values.tolist()]
            log = self._scored(courses, number, shapes)[0]
            inside = np.flatnonzero(log > log.max() + np.log(HARDLY_EVER))
            if len(inside) > FINE / 2:
                break
            ends = values[[max(inside[0] - 1, 0), min(inside[-1] + 1, len(values) - 1)]]
            low, high = np.interp(ends, tried, np.arange(len(tried)))
        return shapes

    def _scored(
        self, courses: Sequence[Variant], number: int, forms: Sequence[Variant]
    ) -> tuple[Floats, Floats, Floats]:
        """Return ln of the likelihood (h,), size and variance (parts, h) of `forms` in place of a course."""
        others, each = [*courses[:number], *courses[number + 1 :]], []
        for k in self.parts if self.of_channels(courses[number]) else range(1):
            columns, starts = self._in_part(forms, k)
            known = self.columns(others, k)
            each.append(self.trials.products(known, columns, self.signal[:, k : k + 1], starts).sizes)
        log, size, variance = (np.array(of) for of in zip(*each, strict=True))
        return log.sum(axis=0), size, variance

    # --- results --------------------------------------------------------------------------------------

    def named(self, finds: Sequence[FoundEffect], limit: Threshold) -> tuple[NamedEffect, ...]:
        """Return `finds` as named effects with values; channels without a significant value are left out."""
        courses = [f.variant for f in finds]
        noises, shown, u_of_shapes = self.noises(courses), [], []
        sizes, known = [np.zeros(0)], [np.zeros(0)]
        for number, one in enumerate(finds):
            variant, u_shape, size, u = self.shaped(courses, number)
            u = np.sqrt(u**2 + self._by_other_shapes(courses, number, noises))
            seen = special.chdtrc(1, (size / u) ** 2) < OFTEN
            if self.of_channels(variant) and seen.any():
                columns, channels = (tuple(compress(of, seen)) for of in (variant.columns, variant.channels))
                variant = variant._replace(columns=columns, channels=channels)
                size, u = size[seen], u[seen]
            shown.append(replace(one, variant=variant))
            u_of_shapes.append(u_shape)
            sizes.append(size)
            known.append(u)
        mean = np.concatenate(sizes)
        fitted = Posterior(mean, np.diag(np.concatenate(known) ** 2), len(mean))
        effects = effects_of(self.candidates, Naming(tuple(shown)), fitted, limit)
        return tuple(_with_u(effect, u) for effect, u in zip(effects, u_of_shapes, strict=True))

    def _by_other_shapes(self, courses: Sequence[Variant], number: int, noises: Sequence[Noise]) -> Floats:
        """Return the variance, by channel or in common, that shapes of other courses add to an amplitude."""
        course = courses[number]
        own, first = self.of_channels(course), self.trials.trend.shape[1]
        variance = np.zeros(len(self.parts) if own else 1)
        for place, other in enumerate(courses):
            if place == number:
                continue
            forms, rest = self.forms(courses, place), [one for one in courses if one not in (course, other)]
            for k in self.parts if own and self.of_channels(other) else range(1):
                beside, held = self.design([course, *rest], k), self.columns([other], k)
                variance[k] += forms.variance_beside(noises[k], beside, held)[first, first]
        return np.asarray(self.helmert.T**2 @ variance) if own else variance

    def fits(self, courses: Sequence[Variant], noises: Sequence[Noise]) -> Iterator[ChannelFit]:
        """Yield zero, drift and residuals of each channel; u includes uncertain shapes and kinds of noise."""
        designs = [self.design(courses, k) for k in self.parts]
        estimates = [self.trials.averaged(one[:, :-1], one[:, -1:]) for one in designs]
        turn = self.record.zero_and_drift
        count = turn.shape[1]

        def variance_of(spread: Floats) -> Floats:
            return np.diag(turn @ spread[:count, :count] @ turn.T)

        trend = np.array([turn @ mean[:count, 0] for mean, _, _ in estimates])
        variance = np.array([variance_of(spread) for _, spread, _ in estimates])
        for number, course in enumerate(courses):
            forms, others = self.forms(courses, number), [*courses[:number], *courses[number + 1 :]]
            for k in self.parts if self.of_channels(course) else range(1):
                held = self.columns([course], k)
                variance[k] += variance_of(forms.variance_beside(noises[k], self.design(others, k), held))
        left = [
            one[:, -1] - one[:, :-1] @ mean[:, 0] for one, (mean, *_) in zip(designs, estimates, strict=True)
        ]
        residual_v = self.record.scale * (self.helmert.T @ np.array(left))
        values, u = self.helmert.T @ trend, np.sqrt(self.helmert.T**2 @ variance)
        before_v = self.beside_trend.T
        for number, channel in enumerate(self.record.channels):
            (zero, drift), (u_zero, u_drift) = values[number].tolist(), u[number].tolist()
            yield ChannelFit(
                CHANNELS[channel], zero, u_zero, drift, u_drift, before_v[number], residual_v[number]
            )


def _parameter(course: Variant) -> str | None:
    """Return the name of the shape parameter of a course that is continuous; None if there is none."""
    names = dict(course.shape)
    parameter = next((p for p in CATALOGUE[course.family].parameters if p.name in names), None)
    return None if parameter is None or parameter.unit == "1" else parameter.name


def _with_u(effect: NamedEffect, u: float | None) -> NamedEffect:
    if u is None:
        return effect
    in_si = {p.name: p.si_per_unit for p in CATALOGUE[effect.name].parameters if p.is_shape}
    values = (replace(v, u=u / in_si[v.parameter]) if v.parameter in in_si else v for v in effect.parameters)
    return replace(effect, parameters=tuple(values))
