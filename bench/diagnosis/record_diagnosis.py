"""The diagnosis of a record at a known input: name what the readings follow, hold out its excursions in turn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats, Mask, rms
from bench.diagnosis.evidence import Threshold, fit_tail
from bench.diagnosis.gap import Fold, Gap, HeldOut
from bench.diagnosis.naming import ALONE, SET, FamilyOdds
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.record_model import (
    FOLLOWS,
    Course,
    Courses,
    Noise,
    Record,
    Whitening,
    components,
    make_courses,
    make_record,
)
from bench.diagnosis.result import UNNAMED_WORDS, EffectValue, NamedEffect, Verdict
from bench.model.effects import AppliedEffect
from bench.readings.table import Readings

NULLS: Final = 200
SEED: Final = 20260
MOST_FINDS: Final = 4
SLOW_IN_TIME: Final = "slow_in_time"
SHOWN: Final = 2.0
"""Standard uncertainties from which a channel has an effect that others have."""


@dataclass(frozen=True)
class Far:
    """A mean of a channel that lies `size_u` standard uncertainties from what the model and its neighbours say."""

    channel: str
    time_h: float
    size_u: float
    p: float

    @property
    def words(self) -> str:
        """The place and the size in words."""
        return f"channel {self.channel} at {self.time_h:.2f} h jumps by {self.size_u:.0f} u"


@dataclass(frozen=True)
class Rival:
    """A kind of shape of an effect, and how well the readings outside of an excursion predict the excursion."""

    what: str
    held_out_rms_v: float
    chi2: float


@dataclass(frozen=True)
class Place:
    """What a channel leaves beside its zero and drift: root mean square in V, before anything is named."""

    channel: str
    pattern: str
    size: float
    p: float
    installation: str = "R"
    unit: str = "V"


@dataclass(frozen=True)
class ChannelFit:
    """Zero and drift of a channel with the effects found, V and V/h with u; `residual_v` (n,) is what is left."""

    channel: str
    zero_v: float
    u_zero_v: float
    drift_v_h: float
    u_drift_v_h: float
    before_v: Floats
    residual_v: Floats


@dataclass(frozen=True)
class RecordDiagnosis:
    """The diagnosis of a record at a known input; `gap` is that of the excursions held out in turn.

    `rivals` compares at once, lag and hysteresis by the same excursions. `white_v` and `slow_v` are the standard
    deviations of the noise in a mean of all channels.
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
    white_v: float
    slow_v: float
    hidden: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The named effects with their values."""
        return tuple(applied for effect in self.effects for applied in effect.applied)


class _Find(NamedTuple):
    """An effect that was found: its likeliest course, the odds of its names, and the evidence of all."""

    course: Course
    odds: tuple[FamilyOdds, ...]
    total: float

    @property
    def family(self) -> str:
        return self.course.effect.name

    @property
    def names(self) -> tuple[str, ...]:
        """The names that hold `SET` of the probability; one from `ALONE` on."""
        if self.odds[0].probability >= ALONE:
            return (self.odds[0].name,)
        held = np.cumsum([one.probability for one in self.odds])
        return tuple(one.name for one in self.odds[: int(np.searchsorted(held, SET)) + 1])


def diagnose_record(readings: Readings) -> RecordDiagnosis:
    """Return the diagnosis of a record at a known input. Raises `CalibrationError` if it cannot be evaluated."""
    record = make_record(readings)
    work = _Work(record, make_courses(record), Whitening.of(record))
    finds, limit = work.search()
    gap, rivals, unconfirmed = _held_out(work, finds)
    confirmed = [one for one in finds if one.family not in unconfirmed]
    effects = (*work.named(confirmed, limit), *_unconfirmed(unconfirmed, finds, limit))
    noises = work.noises(finds)
    far = tuple(_far(work, finds, noises))
    fits = tuple(work.fits(finds, noises))
    ratio, variance = noises[0].ratio, noises[0].variance
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
        white_v=float(np.sqrt(variance / len(record.channels))),
        slow_v=float(np.sqrt(ratio * variance / len(record.channels))),
        hidden=tuple(name for name in FOLLOWS if name not in work.courses.families),
        notes=record.notes,
    )


def _verdict(effects: Sequence[NamedEffect], far: Sequence[Far]) -> Verdict:
    if any(not one.in_catalogue for one in effects) or (far and not effects):
        return "unknown"
    if any(one.cannot_tell_from for one in effects):
        return "confounded"
    return "named" if effects else "agrees"


class _Work:
    """A record with its courses and the products for all sizes of noise."""

    def __init__(self, record: Record, courses: Courses, whitening: Whitening) -> None:
        self.record, self.courses, self.whitening = record, courses, whitening
        self.helmert = components(len(record.channels))
        self.signal: Floats = record.deviation_v / record.scale[:, None] @ self.helmert.T
        self.trend = whitening.trend

    @property
    def parts(self) -> range:
        """The components: the mean of the channels first, then their differences."""
        return range(len(self.helmert))

    def known(self, finds: Sequence[_Find], part: int) -> Floats:
        """Return the columns (n, m) of the finds in a component; those of all channels are in the mean alone."""
        return self.columns([one.course for one in finds], part)

    def columns(self, courses: Sequence[Course], part: int) -> Floats:
        """Return the columns (n, m) of courses in a component."""
        scale = np.sqrt(len(self.helmert))
        mine = [c.course * (1.0 if c.of_channels else scale) for c in courses if c.of_channels or part == 0]
        return np.column_stack(mine) if mine else np.zeros((len(self.record), 0))

    def noises(self, finds: Sequence[_Find]) -> list[Noise]:
        """Return the likeliest noise of each component with the finds."""
        none = np.zeros((len(self.record), 0))
        return [
            self.whitening.products(self.known(finds, k), none, self.signal[:, k : k + 1]).noise(
                self.whitening.settings
            )
            for k in self.parts
        ]

    def gains(self, finds: Sequence[_Find], targets: Sequence[Floats]) -> Floats:
        """Return ln of the evidence of each course beside the finds, shape (h, d).

        `targets` are the signals of each component, (n, d).
        """
        total = np.zeros((len(self.courses.each), targets[0].shape[1]))
        scale = np.where(self.courses.common, np.sqrt(len(self.helmert)), 1.0)
        for k in self.parts:
            products = self.whitening.products(self.known(finds, k), self.courses.columns, targets[k])
            gain = products.with_one(scale) - products.without()
            total += np.where((self.courses.common & (k > 0))[:, None], 0.0, gain)
        return total

    def search(self) -> tuple[list[_Find], Threshold]:
        """Return what is found, the strongest first, and the threshold from noise alone on this very record."""
        limit = self._threshold()
        finds: list[_Find] = []
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

    def _find(self, log_odds: Floats, total: float) -> _Find:
        of = {f: float(special.logsumexp(log_odds[self.courses.of_family(f)])) for f in self.courses.families}
        ordered = sorted(of, key=lambda family: -of[family])
        odds = tuple(FamilyOdds(family, float(np.exp(of[family] - total))) for family in ordered)
        mine = self.courses.of_family(ordered[0])
        return _Find(self.courses.each[int(mine[np.argmax(log_odds[mine])])], odds, total)

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

    def sizes(self, finds: Sequence[_Find], number: int) -> tuple[Floats, Floats]:
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

    def named(self, finds: Sequence[_Find], limit: Threshold) -> Iterator[NamedEffect]:
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
                parameters=tuple(_values(applied)),
                p=float(special.chdtrc(len(size), chi2)),
                p_all_looks=limit.p(find.total),
                rho=float(np.sqrt(chi2)),
                words=course.effect.sentence,
                applied=(replace(applied, either_of=names if len(names) > 1 else ()),),
                odds=find.odds,
            )

    def fits(self, finds: Sequence[_Find], noises: Sequence[Noise]) -> Iterator[ChannelFit]:
        """Yield zero and drift of each channel with the finds, and what is left."""
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


def _values(applied: AppliedEffect) -> Iterator[EffectValue]:
    """Yield the values of an effect in the catalogue's unit; a shape has no u."""
    complete = applied.complete_values()
    for parameter in applied.effect.parameters:
        value = complete[parameter.name] / parameter.si_per_unit
        if parameter.is_shape:
            if value or parameter.default:
                yield EffectValue(parameter.name, "", "", float(value), None, parameter.unit)
            continue
        u = np.asarray(applied.u[parameter.name]) / parameter.si_per_unit
        if not parameter.per_channel:
            yield EffectValue(parameter.name, "", "", float(value), float(u), parameter.unit)
            continue
        for channel in applied.channels:
            at = CHANNELS.index(channel)
            yield EffectValue(parameter.name, channel, "", float(value[at]), float(u[at]), parameter.unit)


def _places(work: _Work) -> Iterator[Place]:
    """Yield what each channel leaves beside zero and drift, with the p-value of it by white noise alone."""
    record = work.record
    for number, channel in enumerate(record.channels):
        signal = record.deviation_v[:, number]
        left = signal - record.trend @ np.linalg.lstsq(record.trend, signal, rcond=None)[0]
        white = np.mean(np.diff(left) ** 2) / 2.0
        freedom = len(left) - record.trend.shape[1]
        p = float(special.chdtrc(freedom, float(left @ left) / white)) if white else 0.0
        yield Place(CHANNELS[channel], "slow in time", rms(left), p)


FAR_P: Final = 0.01
FAR_U: Final = 6.0


def _far(work: _Work, finds: Sequence[_Find], noises: Sequence[Noise]) -> Iterator[Far]:
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


# --- held out --------------------------------------------------------------------------------------

SWING: Final = 0.15
"""An excursion is where what is followed is further from its median than this part of its range."""
LEAST_ROWS: Final = 8
TURNS: Final = 5
"""Consecutive means that are held out together where an effect follows time alone."""
LEAST_GAIN: Final = 4.0
"""Least fall of the chi-square of the excursions held out that confirms an effect."""


def _held_out(work: _Work, finds: Sequence[_Find]) -> tuple[Gap, tuple[Rival, ...], dict[str, str]]:
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
            family = [work.courses.each[i] for i in work.courses.of_family(find.family)]
            after = _predicted(work, [o.course for o in others], family, rows, noises)
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


def _excursions(work: _Work, find: _Find) -> Iterator[tuple[str, Mask]]:
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
    from_median = driver - np.median(driver)
    side = np.where(np.abs(from_median) > SWING * np.ptp(driver), np.sign(from_median), 0.0)
    turns = np.flatnonzero(np.diff(side)) + 1
    bounds: list[int] = [0, *turns.tolist(), len(side)]
    for start, end in pairwise(bounds):
        if side[start] and end - start >= LEAST_ROWS:
            rows = np.zeros(len(side), dtype=bool)
            rows[start:end] = True
            word = "high" if side[start] > 0 else "low"
            yield f"{word} from {record.time_h[start]:.1f} to {record.time_h[end - 1]:.1f} h", rows


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
    work: _Work,
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


def _rivals(work: _Work, finds: Sequence[_Find], noises: Sequence[Noise]) -> Iterator[Rival]:
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


def _unconfirmed(why: dict[str, str], finds: Sequence[_Find], limit: Threshold) -> Iterator[NamedEffect]:
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
