"""Hypotheses on the noise, compared by evidence: by channel, run or place, heavy-tailed, slow, of a reference.

A hypothesis changes the covariance of the readings; it competes with missing effects in explaining the
readings. For heavy tails, each row has its own precision, with a prior that makes the noise t-distributed.
The evidence of heavy tails is the lower bound of Tipping and Lawrence, Neurocomputing 69 (2005) 123. The last
part compares the noise with what the bench file and the samples state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints, Mask, quadratic_forms, rms
from bench.base.languages import message
from bench.base.numbers import quantity, two_digits
from bench.calibration.budget.meters import HALF_WAVES, flicker_waves
from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.levels import CLEARLY_LARGER, HARDLY_EVER, STEPS
from bench.diagnosis.linear import LinearSystem, RunSizes
from bench.diagnosis.noise_grid import (
    SAME_SIZE,
    NoiseGrid,
    Whitener,
    cells_of,
    is_coarse,
    make_noise_grid,
    make_whitener,
)
from bench.diagnosis.posterior import NoiseSize, posterior, whiten_rows
from bench.readings.table import Readings
from bench.stats.repeats_likelihood import believed_sizes

LOG_PRIOR: Final = dict.fromkeys(("channels", "runs", "place", "tails", "slow", "reference"), math.log(0.1))
"""ln of the prior odds of each kind of noise against ordinary noise, which is normal and has one size."""
TAIL_DOF: Final = 4.0
"""Degrees of freedom of the t distribution of heavy tails: clearly not normal, and of finite variance."""
SIZES: Final = tuple(np.geomspace(0.05, 20.0, 61))
"""Sizes of slow noise: root mean squares in units of the noise of a reading, all equally probable a priori."""


@dataclass(frozen=True)
class NoiseHypothesis:
    """A hypothesis on the noise: a `linear` system with this noise, the odds, and `words` for people.

    `what` is a key of `LOG_PRIOR`. `log_odds` is ln of the prior odds against ordinary noise, minus the cost of the
    parameters fitted to the readings.
    """

    what: str
    linear: LinearSystem
    log_odds: float
    words: str


def noise_hypotheses(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield noise hypotheses that `linear` does not yet contain, each with its likeliest parameters.

    The columns `effects` (N, m) are in the model; `noise` is the noise about this model.
    """
    left, free = _fit(linear, effects, noise)
    yield from _by_channel(linear, left, free)
    if linear.by_run is None and linear.readings.run.any():
        yield from _by_run(linear, effects, noise)
    if linear.by_place is None:
        yield from _by_place(linear, noise.reading * whiten_rows(linear, noise, left[:, None])[:, 0])
    beside = linear.with_random(effects * KNOWN_SIZE)
    if linear.by_row is None:
        yield _with_tails(linear, beside, noise)
    white = make_whitener(beside, noise.reading, noise.setting_rad)
    if not linear.slow_channels:
        yield from _slow(linear, white, noise)
    if not linear.slow_reference:
        yield from _of_reference(linear, white, noise)


def log_null(grid: NoiseGrid) -> float:
    """Return the term of ln of the evidence that makes grids with different `grid.sigma` comparable."""
    return -grid.freedom * math.log(grid.sigma)


def _fit(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[Floats, Floats]:
    """Return residuals (N,) of a fit with the `effects` (N, m), and the degrees of freedom of each, (N,)."""
    fitted = posterior(linear, effects, noise)
    design = linear.design(effects)
    white = whiten_rows(linear, noise, design)
    free = 1.0 - quadratic_forms(white, fitted.covariance)
    return linear.response - design @ fitted.mean, free


def residuals(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Floats:
    """Return residuals (N,), unit of the signal, divided by the relative noise of each row.

    They are of the fit with the columns `effects` (N, m); the setting error is removed.
    """
    left = _fit(linear, effects, noise)[0]
    return noise.reading * whiten_rows(linear, noise, left[:, None])[:, 0]


# --- channels, runs and places with noise of their own -----------------------------------------------


def _by_channel(linear: LinearSystem, residual: Floats, free: Floats) -> Iterator[NoiseHypothesis]:
    oriented = linear.setting >= 0
    other = linear.relative / linear.relative_of_channel
    left, slope, free = (of[oriented].reshape(-1, 3) for of in (residual / other, linear.slope / other, free))
    floor = 1e-11 * float(np.max(np.abs(linear.readings.signal)))
    sizes = sizes_by_channel(left, free.mean(axis=1), slope, cells_of(linear), floor)
    if np.max(np.abs(np.log(sizes / linear.by_channel))) < SAME_SIZE:
        return
    known = bool(np.any(linear.by_channel != 1.0))
    cost = 0.0 if known else LOG_PRIOR["channels"] - math.log(max(float(free.sum()) / 3.0, 1.0))
    yield NoiseHypothesis("channels", replace(linear, by_channel=sizes), cost, "")


def sizes_by_channel(left: Floats, freedom: Floats, slope: Floats, cells: Ints, floor: float) -> Floats:
    """Return the relative noise (3,) of the channels, of mean square 1, from residuals `left` (n, 3).

    `freedom` (n,) are the degrees of freedom of one residual, 0 to 1. `slope` (n, 3) is the direction of a setting
    error; `cells` (n,) numbers groups of settings with the same slope. `floor` is the least noise, unit of the
    signal.
    """
    count = int(cells.max()) + 1
    free = np.bincount(cells, freedom, count)
    scatter, mean = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(scatter, cells, left[:, :, None] * left[:, None, :])
    np.add.at(mean, cells, slope / np.bincount(cells)[cells, None])
    used = free > 1e-6
    sizes = np.sqrt(believed_sizes(scatter[used][None], free[used], mean[used][None], floor).variances[0, :3])
    return np.asarray(sizes / rms(sizes))


def _by_run(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield the hypothesis that the noise, but not the setting error, differs between runs."""
    run = linear.readings.run[linear.rows.reading]
    system, variance, sizes = linear, np.ones(1), np.ones(int(run.max()) + 1)
    for _ in range(STEPS):
        residual, free = _fit(system, effects, noise)
        white = whiten_rows(system, noise, residual[:, None])[:, 0]
        freedom = np.bincount(run, free).astype(np.float64)
        variance = variance * np.maximum(np.bincount(run, white**2) / np.maximum(freedom, 1.0), 1e-6)
        variance[freedom < 1.0] = np.average(variance, weights=np.maximum(freedom, 1e-9))  # unknown
        before, sizes = sizes, np.sqrt(variance / np.average(variance, weights=np.bincount(run)))
        system = replace(linear, by_run=RunSizes(sizes, freedom))
        if np.allclose(sizes, before, rtol=0.1 * SAME_SIZE):
            break
    if np.max(np.abs(np.log(sizes))) >= SAME_SIZE:
        cost = 0.5 * (len(sizes) - 1) * math.log(max(float(freedom.sum()), 1.0))
        yield NoiseHypothesis("runs", system, LOG_PRIOR["runs"] - cost, "")


def _by_place(linear: LinearSystem, left: Floats) -> Iterator[NoiseHypothesis]:
    """Yield the hypothesis of larger noise in one place: a channel of an installation, or of one of its passes.

    The odds are lowered for the choice of the place and for one more parameter.
    """
    places = _larger(linear, left)
    found = min((one for one in places if one[0].where), key=lambda one: one[0].p, default=None)
    if found is None:
        return
    place, rows = found
    size = np.where(rows, place.sd / place.elsewhere, 1.0)
    cost = np.log(len(list(_places(linear)))) + 0.5 * np.log(np.count_nonzero(rows))
    yield NoiseHypothesis(
        "place",
        replace(linear, by_place=size / np.sqrt(np.mean(size**2))),
        LOG_PRIOR["place"] - float(cost),
        message(
            f"channel {place.channel} in {place.where} scatters {place.sd / place.elsewhere:.1f} times as "
            "much as the rest: its readings get less weight"
        ),
    )


@dataclass(frozen=True)
class LocalScatter:
    """A place where readings scatter more than elsewhere: a channel, in an installation or one of its passes.

    `sd` and `elsewhere` are standard deviations, unit of the signal; `where` is empty for a whole channel. The
    p-value `p` is corrected for the number of places.
    """

    channel: str
    where: str
    sd: float
    elsewhere: float
    p: float

    @property
    def words(self) -> str:
        """The channel and the installation or pass, in words."""
        if not self.where:
            return message(f"channel {self.channel}, everywhere")
        return f"channel {self.channel}, {self.where}"


def larger_scatter(linear: LinearSystem, left: Floats) -> LocalScatter | None:
    """Return the place where residuals `left` (N,) scatter most significantly; None if none does."""
    return min((one for one, _ in _larger(linear, left)), key=lambda one: one.p, default=None)


def _larger(linear: LinearSystem, left: Floats) -> Iterator[tuple[LocalScatter, Mask]]:
    """Yield the places that scatter significantly more than all others, each with the mask (N,) of its rows."""
    places = list(_places(linear))
    oriented = linear.setting >= 0
    for channel, where, rows in places:
        inside, outside = left[rows], left[oriented & ~rows]
        sd, elsewhere = rms(inside), rms(outside)
        p = float(special.fdtrc(len(inside), len(outside), (sd / max(elsewhere, 1e-300)) ** 2)) * len(places)
        if p < HARDLY_EVER:
            yield LocalScatter(channel, where, sd, elsewhere, p), rows


def _places(linear: LinearSystem) -> Iterator[tuple[str, str, Mask]]:
    """Yield, for each place, its channel, its words, and the mask (N,) of its rows."""
    reading, conditions = linear.rows.reading, linear.conditions
    mounts = np.array([str(mount) for mount in conditions.mounts])[conditions.mount][reading]
    passes = linear.readings.pass_number[reading]
    for c, channel in enumerate(CHANNELS):
        own = (linear.setting >= 0) & (linear.rows.channel == c)
        yield channel, "", own
        for mount in dict.fromkeys(mounts[own].tolist()):
            here = own & (mounts == mount)
            yield channel, f"installation {mount}", here
            for number in dict.fromkeys(passes[here].tolist()):
                yield channel, f"installation {mount}, pass {number}", here & (passes == number)


# --- heavy tails ------------------------------------------------------------------------------------


def _with_tails(linear: LinearSystem, beside: LinearSystem, noise: NoiseSize) -> NoiseHypothesis:
    """Return the hypothesis of t-distributed noise; `beside` has the effects of the model as unknowns."""
    relative2 = linear.relative**2
    weight: Floats = np.ones(len(linear))
    scale, of_mean, square = noise.reading, weight, weight
    for _ in range(STEPS):
        white = make_whitener(replace(beside, by_row=1.0 / np.sqrt(weight)), scale, noise.setting_rad)
        variance = relative2 / weight
        left = variance * white.weigh(linear.response)
        free = np.clip(variance * white.diagonal, 0.0, 1.0)
        of_mean = left**2 / (relative2 * scale**2)
        square = of_mean + (1.0 - free) / weight
        scale *= math.sqrt(float(np.sum(weight * of_mean) / max(free.sum(), 1.0)))
        weight = (TAIL_DOF + 1.0) / (TAIL_DOF + square)
    changed = weight < 0.5 * float(np.median(weight))
    readings = len(set(linear.rows.reading[changed].tolist()))
    less = message("1 reading gets") if readings == 1 else message(f"{readings} readings get")
    return NoiseHypothesis(
        "tails",
        replace(linear, by_row=1.0 / np.sqrt(weight * float(np.mean(1.0 / weight)))),
        LOG_PRIOR["tails"] + _log_odds_of_weights(weight, of_mean, square),
        message(
            f"the noise has heavier tails than normal noise: {less} less weight, and only a "
            "reading far outside these tails counts as an outlier"
        ),
    )


def _log_odds_of_weights(weight: Floats, of_mean: Floats, square: Floats) -> float:
    """Return ln of the odds of t-distributed noise against normal noise with the row weights `weight` (N,).

    A precision t has the prior Gamma(d/2, d/2) and, with the expected `square` (N,) of its row in units of
    the noise, the posterior Gamma((d + 1)/2, (d + square)/2). The result has E ln t in place of ln of the
    weight, minus the divergence of posterior from prior (a lower bound). This bound assumes that precisions
    and fit are independent; a last term corrects for their dependence to second order. `of_mean` (N,) is the
    part of `square` that the residual from the mean of the fit contributes.
    """
    half, prior = 0.5 * (TAIL_DOF + 1.0), 0.5 * TAIL_DOF
    of_each = half - 0.5 * math.log(half) + special.gammaln(half) - special.gammaln(prior)
    bound = of_each - prior * np.log1p(square / TAIL_DOF) - prior * weight
    return float(np.sum(bound + weight**2 * (square**2 - of_mean**2) / (4.0 * half)))


def log_density(linear: LinearSystem, effects: Floats, like: NoiseGrid) -> float:
    """Return ln of the evidence with the columns `effects` (N, m) in the model.

    The noise is integrated out over the ratios and the prior of the grid `like`.
    """
    grid = make_noise_grid(linear.with_random(effects * KNOWN_SIZE), like.sigma, 0.0)
    square = np.array([np.sum((white @ (linear.response / like.sigma)) ** 2) for white in grid.white])
    of_ratio = like.log_prior + grid.log_det + grid.log_likelihood(square)
    return float(special.logsumexp(of_ratio)) + log_null(grid)


# --- slow noise ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlowNoise:
    """Slow noise (1/f) in some `channels`, independent in each, of equal standard deviation.

    `size` is its root mean square, unit of the signal; `columns` (N, k) are the changes by one standard
    deviation of each component. `evidence` is ln of the Bayes factor, averaged over sizes and alternatives;
    `cost` is `evidence` minus ln of the largest Bayes factor.
    """

    channels: tuple[int, ...]
    size: float
    evidence: float
    cost: float
    columns: Floats


def _slow(linear: LinearSystem, white: Whitener, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    found = slow_noise(linear, white, noise)
    if not found:
        return
    told = ", ".join(
        f"{quantity(one.size, linear.readings.unit)} in {' and '.join(CHANNELS[c] for c in one.channels)}"
        for one in found
    )
    system = linear.with_noise(*(one.columns for one in found))
    yield NoiseHypothesis(
        "slow",
        replace(system, slow_channels=tuple(channel for one in found for channel in one.channels)),
        LOG_PRIOR["slow"] + sum(one.cost for one in found),
        message(
            f"the readings also have slow noise, over the run {told} (root mean square): it hides smaller drifts, "
            "and the u of the coefficients includes it"
        ),
    )


def slow_noise(linear: LinearSystem, white: Whitener, noise: NoiseSize) -> tuple[SlowNoise, ...]:
    """Return slow noise that is more probable than none, common to all channels or by channel.

    The result is empty if there is none. `white` also removes the effects of the model.
    """
    waves = [_waves(linear, channel) for channel in range(3)]
    all_alike = _likeliest(linear, white, noise.reading, (0, 1, 2), np.hstack(waves))
    # a single channel pays for the choice among three
    each = (_likeliest(linear, white, noise.reading, (c,), waves[c], choices=3) for c in range(3))
    own = [one for one in each if one.evidence > 0.0]
    if all_alike.evidence > max(sum(one.evidence for one in own), 0.0):
        return (all_alike,)
    return tuple(own)


def _of_reference(linear: LinearSystem, white: Whitener, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield the hypothesis of 1/f noise in proportion to the signals.

    The noise is that of one common reference, or of one reference per meter, whichever is more probable.
    """
    signal = linear.readings.signal[linear.rows.reading, np.minimum(linear.rows.channel, 2)]
    own = [_waves(linear, channel)[:, :HALF_WAVES] * signal[:, None] for channel in range(3)]
    if any(not waves.shape[1] for waves in own):
        return
    oriented = linear.setting >= 0
    typical = rms(signal[oriented])
    every = {"one": sum(own, np.zeros_like(own[0])) / typical, "each": np.hstack(own) / typical}
    found = {
        which: _likeliest(linear, white, noise.reading, (0, 1, 2), waves, choices=2)
        for which, waves in every.items()
    }
    which, best = max(found.items(), key=lambda item: item[1].evidence)
    if best.evidence <= 0.0:
        return
    whose = message("the voltage reference of the meters") if which == "one" else (
        message("the voltage reference of each channel's meter")
    )  # fmt: skip
    told = f"{two_digits(1e6 * best.size / typical)} ppm"
    yield NoiseHypothesis(
        "reference",
        replace(linear.with_noise(best.columns), slow_reference=True),
        LOG_PRIOR["reference"] + best.cost,
        message(
            f"{whose} has 1/f noise, over the run {told} (root mean square): it hides smaller changes of the scale "
            "factors, and the u of the coefficients includes it"
        ),
    )


def _likeliest(
    linear: LinearSystem,
    white: Whitener,
    sigma: float,
    channels: tuple[int, ...],
    columns: Floats,
    choices: int = 1,
) -> SlowNoise:
    """Return the likeliest size of slow noise whose components `columns` (N, k) sum to root mean square 1.

    `choices` is the number of alternatives among which this hypothesis is chosen.
    """
    left, inside = white @ (linear.response / sigma), white @ columns
    values, vectors = np.linalg.eigh(inside.T @ inside)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ (inside.T @ left)) ** 2
    variances = np.array(SIZES) ** 2
    weight = 1.0 / (1.0 + variances[:, None] * values)
    rest = left @ left - np.sum(variances[:, None] * square * weight, axis=1)
    freedom = len(linear) - linear.fixed.shape[1]
    more = 0.5 * np.sum(np.log(weight), axis=1) - 0.5 * freedom * np.log(rest / (left @ left))
    best = int(np.argmax(more))
    # the likelihood is averaged over all sizes, and over the choices
    cost = float(special.logsumexp(more) - np.log(len(SIZES) * choices) - more[best])
    # with slow noise in the model, the white noise is smaller than `sigma`
    size = float(SIZES[best]) * sigma * math.sqrt(float(rest[best]) / freedom)
    return SlowNoise(channels, size, float(more[best]) + cost, cost, size * columns)


def _waves(linear: LinearSystem, channel: int) -> Floats:
    """Return components (N, waves + 1) of 1/f noise in a channel, of unit root mean square about its mean.

    The last is the mean over the run, as large as the slowest wave. Too few readings, or one time, give none.
    """
    own = np.flatnonzero((linear.setting >= 0) & (linear.rows.channel == channel))
    time = linear.conditions.elapsed_s[linear.rows.reading[own]]
    if len(own) < 2 * HALF_WAVES or not np.ptp(time) > 0.0:
        return np.zeros((len(linear), 0))
    waves = flicker_waves(time)
    columns = np.zeros((len(linear), HALF_WAVES + 1))
    mean = np.full((len(own), 1), np.log(10.0) ** -0.5)
    columns[own] = np.hstack([waves, mean]) / np.sqrt(np.mean(np.sum(waves**2, axis=1)))
    return columns


# --- what is said of the noise -------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseKind:
    """A departure of the noise from normal noise of one standard deviation.

    `what` is "channels", "runs", "place", "tails", "slow", "reference" or "resolution"; `words` is a sentence.
    """

    what: str
    words: str


def noise_kinds(
    linear: LinearSystem, noise: NoiseSize, digit: float, chosen: Mapping[str, str]
) -> Iterator[NoiseKind]:
    """Yield departures of the noise from normal noise of one standard deviation.

    `digit` is the step of the last digit of the signals; `chosen` maps accepted noise hypotheses to words.
    """
    unit = linear.readings.unit
    if np.any(linear.by_channel != 1.0):
        sizes = noise.reading * linear.by_channel
        told = ", ".join(f"{quantity(size, unit)} in {c}" for c, size in zip(CHANNELS, sizes, strict=True))
        most = int(np.argmax(sizes))
        times = f"{sizes[most] / rms(np.delete(sizes, most)):.1f}"
        yield NoiseKind(
            "channels", message(f"channel {CHANNELS[most]} is {times} times as noisy as the others: {told}")
        )
    if linear.by_run is not None:
        run, series_of = linear.readings.run, linear.readings.series
        each = [np.unique(series_of[run == number]).tolist() for number in np.unique(run)]
        own = ", ".join(
            message(
                f"{quantity(noise.reading * float(size), unit)} in series {', '.join(str(s) for s in series)}"
            )
            for series, size in zip(each, linear.by_run.sizes, strict=True)
        )
        yield NoiseKind(
            "runs", message(f"the noise differs between runs, and each run is weighted by its own: {own}")
        )
    yield from (NoiseKind(what, words) for what, words in chosen.items() if words)
    if is_coarse(digit, noise.reading):
        yield NoiseKind(
            "resolution",
            message(
                f"the last digit of the signals, {quantity(digit, unit)}, is coarser than their noise: repeats "
                "round to the same value, and effects smaller than the digit may stay hidden"
            ),
        )


OWN_SCATTER: Final = message("the readings' own scatter")
BENCH_FILE: Final = message("the bench file")


@dataclass(frozen=True)
class NoiseFinding:
    """Noise that is significantly larger than the bench file or the samples (`source`) state.

    `what` is "reading", "slow" (a reading with its slow noise, if white noise alone is no finding) or "setting".
    `found` and `stated`, in `unit`, are standard deviations; `factor` is their ratio. The p-value `p` of "reading"
    is corrected for the number of runs. `series` are those of the run with this noise (empty: all).
    """

    what: str
    found: float
    stated: float
    unit: str
    factor: float
    p: float
    source: str
    series: tuple[int, ...] = ()

    @property
    def words(self) -> str:
        """A sentence that compares the noise with what is stated, and names the consequence."""
        of = {
            "reading": "a reading",
            "slow": message("a reading, slow noise included,"),
            "setting": message("a setting of the head"),
        }[self.what]
        if self.series:
            of += message(f" of series {', '.join(str(number) for number in self.series)}")
        found, stated = (quantity(size, self.unit) for size in (self.found, self.stated))
        return message(
            f"the noise of {of} is {found}, {self.factor:.1f} times the {stated} that {self.source} "
            "gives: it may hide effects that the model lacks"
        )


def noise_findings(
    noise: NoiseSize,
    readings: Readings,
    stand_u: Mapping[str, float],
    typical_slope: float,
    digit: float = 0.0,
    by_run: RunSizes | None = None,
    slow: Floats | None = None,
    by_channel: Floats | None = None,
) -> tuple[NoiseFinding, ...]:
    """Return each noise that is significantly larger than stated, and by at least the factor `CLEARLY_LARGER`.

    `stand_u` has the "setting_error" (rad) and "voltmeter_error" (V) of the bench file. `typical_slope` is in the
    unit of the signal per rad; `digit` is the step of the last digit. With `by_run`, each run has its own noise.
    `slow` (n, 3, k) is one standard deviation of each component of slow noise found, unit of the signal;
    `by_channel` (3,) is the relative size of the other noise by channel (None: equal).
    """
    found = [*_of_readings(noise, readings, stand_u, digit, by_run)]
    if slow is not None and by_run is None:
        white = noise.reading * (np.ones(3) if by_channel is None else by_channel)
        found += _with_slow(white, readings, stand_u, digit, slow)
    setting = stand_u.get("setting_error", 0.0)
    if setting > 0.0:
        along = [noise.reading**2 + (size * typical_slope) ** 2 for size in (noise.setting_rad, setting)]
        freedom = noise.freedom / 3.0
        p = float(special.chdtrc(freedom, freedom * along[0] / along[1]))
        size, limit = noise.setting_rad / ARCSEC, setting / ARCSEC
        found.append(NoiseFinding("setting", size, limit, "arcsec", size / limit, p, BENCH_FILE))
    larger = [one for one in found if one.factor > CLEARLY_LARGER and one.p < HARDLY_EVER]
    white_alone = any(one.what == "reading" for one in larger)
    return tuple(one for one in larger if not (white_alone and one.what == "slow"))


def _of_readings(
    noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], digit: float, by_run: RunSizes | None
) -> Iterator[NoiseFinding]:
    """Yield the findings on the noise of readings, by run if the noise differs between runs."""
    parts = [(readings, 1.0, float(noise.freedom))]
    if by_run is not None:
        runs = [readings.select(readings.run == number) for number in range(len(by_run.sizes))]
        parts = list(zip(runs, by_run.sizes.tolist(), by_run.freedom.tolist(), strict=True))
    for own, times, freedom in parts:
        stated = max(_stated(own, stand_u, digit / np.sqrt(12.0)), default=None)
        if stated is None:
            continue
        size, known, source = stated
        factor = noise.reading * times / size
        p = min(len(parts) * float(special.fdtrc(freedom, min(known, 1e9), factor**2)), 1.0)
        series = () if by_run is None else tuple(np.unique(own.series).tolist())
        yield NoiseFinding("reading", noise.reading * times, size, own.unit, factor, p, source, series)


def _with_slow(
    white: Floats, readings: Readings, stand_u: Mapping[str, float], digit: float, slow: Floats
) -> Iterator[NoiseFinding]:
    """Yield the finding on the noisiest channel, if it has slow noise; `white` (3,) is the other noise of each."""
    for size, known, source in sorted(_stated(readings, stand_u, digit / np.sqrt(12.0)))[-1:]:
        square = np.mean(slow[readings.is_oriented] ** 2, axis=0)
        channel = int(np.argmax(white**2 + square.sum(axis=1)))
        if not square[channel].any():
            return
        found = math.hypot(float(white[channel]), math.sqrt(float(square[channel].sum())))
        freedom = float(square[channel].sum() ** 2 / np.sum(square[channel] ** 2))
        p = float(special.fdtrc(freedom, min(known, 1e9), (found / size) ** 2))
        yield NoiseFinding("slow", found, size, readings.unit, found / size, p, source)


def _stated(
    readings: Readings, stand_u: Mapping[str, float], rounding: float
) -> Iterator[tuple[float, float, str]]:
    """Yield standard deviation, freedom and source of the noise that bench file and samples state.

    The `rounding` error is added. Samples do not show an error that they share; the bench file may state it.
    """
    size = stand_u.get("voltmeter_error", 0.0)
    if size > 0.0 and readings.unit == "V":
        yield float(np.hypot(size, rounding)), np.inf, BENCH_FILE
    count = readings.samples[:, None] * np.isfinite(readings.signal_sd) * (readings.signal_sd > 0.0)
    sampled = count > 1
    if np.any(sampled & readings.is_oriented[:, None]):
        of_mean = readings.signal_sd[sampled] / np.sqrt(count[sampled])
        yield float(np.hypot(rms(of_mean), rounding)), float(np.sum(count[sampled] - 1)), OWN_SCATTER
