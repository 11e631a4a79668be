"""Hypotheses on the noise, compared by evidence: by channel, heavy-tailed, slow; and noise larger than stated.

A hypothesis changes the covariance of the readings. So hypotheses on the noise and on missing effects explain the
same numbers. For heavy tails each row has its own precision, with the prior that makes its noise t-distributed
(Tipping and Lawrence, Neurocomputing 69 (2005) 123). The evidence of heavy tails is the bound of that paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints, Mask, rms
from bench.base.languages import message
from bench.base.numbers import quantity
from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.levels import HARDLY_EVER
from bench.diagnosis.linear import LinearSystem, RunSizes
from bench.diagnosis.noise_grid import (
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

LOG_PRIOR: Final = dict.fromkeys(("channels", "place", "tails", "slow"), math.log(0.1))
"""ln of the prior odds of each kind of noise against noise that is normal and of one size."""
TAIL_DOF: Final = 4.0
"""Degrees of freedom of the t distribution of heavy tails."""
ROUNDS: Final = 8
"""Rounds of the fit with heavy tails; the bound is at rest by then."""
FREEST: Final = 0.05
"""Lower limit of the part of a row that the fit leaves."""
LIGHT: Final = 0.4
"""A row counts as weighed down where its weight is below this part of the usual one."""
WAVES: Final = 16
"""Half waves over a run that slow noise has at most."""
SIZES: Final = tuple(np.geomspace(0.05, 20.0, 61))
"""Sizes of slow noise, root mean squares in units of the noise of a reading, alike in their prior probability."""


@dataclass(frozen=True)
class NoiseHypothesis:
    """A hypothesis on the kind of noise: the system with this noise, and ln of its prior odds, with the cost of its
    sizes.

    `what` is "channels", "place", "tails" or "slow". `words` describe it for people.
    """

    what: str
    linear: LinearSystem
    log_odds: float
    words: str


def noise_hypotheses(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield the hypotheses on the noise, each with its likeliest sizes given the m columns of the effects (N,
    m).
    """
    yield from _by_channel(linear, effects, noise)
    yield from _by_place(linear, effects, noise)
    yield from _with_tails(linear, effects, noise)
    yield from _slow(linear, effects, noise)


def log_null(grid: NoiseGrid) -> float:
    """Return the part of ln of the evidence that depends on the unit of the noise, so that different grids can be
    compared.
    """
    return -grid.freedom * math.log(grid.sigma)


# --- channels with noise of their own -------------------------------------------------------------


def _by_channel(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    fitted = posterior(linear, effects, noise)
    design = linear.design(effects)
    white = whiten_rows(linear, noise, design)
    free = 1.0 - np.einsum("np,pq,nq->n", white, fitted.covariance, white, optimize=True)
    oriented = linear.setting >= 0
    other = linear.relative / linear.relative_of_channel
    left = ((linear.response - design @ fitted.mean) / other)[oriented].reshape(-1, 3)
    slope = (linear.slope / other)[oriented].reshape(-1, 3)
    floor = 1e-11 * float(np.max(np.abs(linear.readings.signal)))
    freedom = free[oriented].reshape(-1, 3).mean(axis=1)
    sizes = sizes_by_channel(left, freedom, slope, cells_of(linear), floor)
    if np.max(np.abs(np.log(sizes / linear.by_channel))) < SAME_SIZE:
        return
    cost = 0.0 if np.any(linear.by_channel != 1.0) else -math.log(max(float(freedom.sum()), 1.0))
    prior = 0.0 if np.any(linear.by_channel != 1.0) else LOG_PRIOR["channels"]
    yield NoiseHypothesis("channels", replace(linear, by_channel=sizes), prior + cost, "")


SAME_SIZE: Final = 0.1
"""Relative difference within which sizes of noise count as the same."""


def sizes_by_channel(left: Floats, freedom: Floats, slope: Floats, cells: Ints, floor: float) -> Floats:
    """Return the relative sizes (3,) of the channels' noise, 1 on the average of squares.

    `left` (n, 3) are the residuals of each setting. `freedom` (n,) is the part of a setting that the fit leaves.
    `slope` (n, 3) is du/dphi, the direction of a setting error. `cells` (n,) number settings with the same slope,
    `floor` is the least noise that is believed, unit of the signal.
    """
    count = int(cells.max()) + 1
    free = np.bincount(cells, freedom, count)
    products = (left[:, :, None] * left[:, None, :]).reshape(-1, 9)
    scatter = _by_cell(products, cells, count)
    mean = _by_cell(slope, cells, count) / np.bincount(cells, minlength=count)[:, None]
    used = free > 1e-6
    scatter, free = scatter[used].reshape(1, -1, 3, 3), free[used]
    sizes = np.sqrt(believed_sizes(scatter, free, mean[used][None], floor).variances[0, :3])
    return np.asarray(sizes / rms(sizes))


def _by_cell(columns: Floats, cells: Ints, count: int) -> Floats:
    sums = [np.bincount(cells, column, count) for column in columns.T]
    return np.asarray(np.stack(sums, axis=1), dtype=np.float64)


def _by_place(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield noise that is larger in one place: a channel in an installation, or in one of its passes."""
    found = None
    if linear.by_place is None:
        found = relative_by_place(linear, residuals(linear, effects, noise))
    if found is None:
        return
    place, relative, cost = found
    yield NoiseHypothesis(
        "place",
        replace(linear, by_place=relative),
        LOG_PRIOR["place"] + cost,
        message(
            f"channel {place.channel} in {place.where} scatters {place.sd / place.elsewhere:.1f} times as "
            f"much as the "
            "rest: its readings weigh less"
        ),
    )


SCATTER_P: Final = 1e-3
"""A place is named if its scatter has a probability by chance, corrected for all places, below this."""
LEAST_ROWS: Final = 4
EVERYWHERE: Final = "everywhere"
MORE_SCATTER: Final = 1.5
"""Least ratio of the scatter in a place to the scatter elsewhere for which the place is named."""


@dataclass(frozen=True)
class LocalScatter:
    """A place where readings scatter more: the standard deviations there and elsewhere, unit of the signal."""

    channel: str
    where: str
    sd: float
    elsewhere: float
    p: float

    @property
    def words(self) -> str:
        """The place in words."""
        return f"channel {self.channel}, {self.where}"


def residuals(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Floats:
    """Return the residuals (N,) after a fit of effects' columns (N, m), without the setting error, in signal units.

    They are divided by the relative noise of their rows.
    """
    fitted = posterior(linear, effects, noise)
    left = linear.response - linear.design(effects) @ fitted.mean
    return noise.reading * whiten_rows(linear, noise, left[:, None])[:, 0]


def larger_scatter(linear: LinearSystem, left: Floats) -> LocalScatter | None:
    """Return the place whose residuals `left` (N,) scatter most in excess of the others; None if there is none."""
    return max(_larger(linear, left), key=lambda found: -found[0].p, default=(None, None))[0]


def relative_by_place(linear: LinearSystem, left: Floats) -> tuple[LocalScatter, Floats, float] | None:
    """Return the place in an installation that scatters most, the relative noise (N,) with it, and ln of its cost.

    The mean square of the relative noise is 1. The cost counts the choice of one place among all, and one more
    size. None if no place scatters significantly more.
    """
    places = (one for one in _larger(linear, left) if one[0].where != EVERYWHERE)
    found = max(places, key=lambda one: -one[0].p, default=None)
    if found is None:
        return None
    scatter, rows = found
    size = np.where(rows, scatter.sd / scatter.elsewhere, 1.0)
    cost = -np.log(len(list(_places(linear)))) - 0.5 * np.log(np.count_nonzero(rows))
    return scatter, size / np.sqrt(np.mean(size**2)), float(cost)


def _larger(linear: LinearSystem, left: Floats) -> Iterator[tuple[LocalScatter, Mask]]:
    """Yield the places that scatter significantly more than elsewhere, each with its rows (N,)."""
    places = list(_places(linear))
    oriented = linear.setting >= 0
    for channel, where, rows in places:
        others = oriented & ~rows
        inside, outside = int(rows.sum()), int(others.sum())
        if inside < LEAST_ROWS or outside < LEAST_ROWS:
            continue
        sd, elsewhere = (float(np.sqrt(np.mean(left[of] ** 2))) for of in (rows, others))
        if sd <= MORE_SCATTER * elsewhere:
            continue
        p = float(special.fdtrc(inside, outside, (sd / elsewhere) ** 2)) * len(places)
        if p < SCATTER_P:
            yield LocalScatter(channel, where, sd, elsewhere, p), rows


def _places(linear: LinearSystem) -> Iterator[tuple[str, str, Mask]]:
    """Yield channel, words and rows (N,) of each place."""
    rows, readings = linear.rows, linear.readings
    oriented = linear.setting >= 0
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    passes = readings.pass_number[rows.reading]
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        yield channel, EVERYWHERE, own
        for mount in dict.fromkeys(mounts[own].tolist()):
            here = own & (mounts == mount)
            yield channel, f"installation {mount}", here
            for number in dict.fromkeys(passes[here].tolist()):
                yield channel, f"installation {mount}, pass {number}", here & (passes == number)


# --- heavy tails ------------------------------------------------------------------------------------


def _with_tails(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    """Yield noise with the tails of a t distribution, as a precision of each row (`by_row`)."""
    if linear.by_row is not None:
        return
    random = np.concatenate([linear.random, effects * KNOWN_SIZE], axis=1)
    relative2 = linear.relative**2
    weight: Floats = np.ones(len(linear))
    scale, of_mean, square = noise.reading, weight, weight
    for _ in range(ROUNDS):
        rows = replace(linear, random=random, by_row=1.0 / np.sqrt(weight))
        white = make_whitener(rows, scale, noise.setting_rad)
        variance = relative2 / weight
        left = variance * white.weigh(linear.response)
        free = np.clip(variance * white.diagonal, FREEST, 1.0)
        of_mean = left**2 / (relative2 * scale**2)
        square = of_mean + (1.0 - free) / weight
        scale *= math.sqrt(float(np.sum(weight * of_mean) / max(free.sum(), 1.0)))
        weight = (TAIL_DOF + 1.0) / (TAIL_DOF + square)
    changed = weight < LIGHT * float(np.median(weight))
    readings = len(set(linear.rows.reading[changed].tolist()))
    yield NoiseHypothesis(
        "tails",
        replace(linear, by_row=1.0 / np.sqrt(weight * float(np.mean(1.0 / weight)))),
        LOG_PRIOR["tails"] + _log_odds_of_weights(weight, of_mean, square),
        message(
            f"the noise has heavier tails than a normal one: {readings} readings are weighed down, and an "
            f"outlier is "
            "named only where it is far beyond them"
        ),
    )


def _log_odds_of_weights(weight: Floats, of_mean: Floats, square: Floats) -> float:
    """Return what the evidence of rows with these weights (N,) lacks to that of t-distributed noise.

    A precision t has the prior Gamma(d/2, d/2) and, with the expected `square` (N,) of its row in units of the
    noise, the posterior Gamma((d + 1)/2, (d + square)/2). The bound has E ln t instead of ln of the weight,
    less the divergence of posterior and prior. It takes precisions and fit for independent; the last term corrects
    this to second order. `of_mean` (N,) is the part of the square that the mean of the fit leaves.
    """
    half, prior = 0.5 * (TAIL_DOF + 1.0), 0.5 * TAIL_DOF
    of_each = half - 0.5 * math.log(half) + special.gammaln(half) - special.gammaln(prior)
    bound = of_each - prior * np.log1p(square / TAIL_DOF) - prior * weight
    return float(np.sum(bound + weight**2 * (square**2 - of_mean**2) / (4.0 * half)))


def log_density(linear: LinearSystem, effects: Floats, like: NoiseGrid) -> float:
    """Return ln of the evidence of a system with effects' columns (N, m), the sizes of its noise integrated over.

    Their priors are those of the grid `like`.
    """
    random = np.concatenate([linear.random, effects * KNOWN_SIZE], axis=1)
    grid = make_noise_grid(replace(linear, random=random), like.sigma, 0.0)
    square = np.array([np.sum((white @ (linear.response / like.sigma)) ** 2) for white in grid.white])
    of_ratio = like.log_prior + grid.log_det + grid.log_likelihood(square)
    return float(special.logsumexp(of_ratio)) + log_null(grid)


# --- slow noise ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlowNoise:
    """Slow noise of `channels` (0, 1, 2), independent in each: `size` is its root mean square over a run.

    The size is in the unit of the signal. `columns` (N, waves) are draws of this noise in the rows of the system.
    `evidence` is ln of the mean likelihood over all sizes, against no slow noise. `cost` is ln of this mean over
    the largest likelihood.
    """

    channels: tuple[int, ...]
    size: float
    evidence: float
    cost: float
    columns: Floats


def _slow(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Iterator[NoiseHypothesis]:
    if linear.slow_channels:
        return
    found = slow_noise(linear, effects, noise)
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
            f"beside the noise of a reading there is slow noise, over the run {told} (root mean square): a drift "
            "that is no larger stays hidden in it, and the u of the coefficients holds it"
        ),
    )


def slow_noise(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[SlowNoise, ...]:
    """Return the slow noise that is likelier than none, given the columns of the effects (N, m).

    It is empty if there is none. It has one size in all channels, or a size in each channel that has it, whichever
    has more evidence.
    """
    random = np.concatenate([linear.random, effects * KNOWN_SIZE], axis=1)
    white = make_whitener(replace(linear, random=random), noise.reading, noise.setting_rad)
    left = white @ (linear.response / noise.reading)
    waves = [_waves(linear, channel) for channel in range(3)]
    sets = [(0, 1, 2), *((channel,) for channel in range(3))]
    all_alike, *each = (
        _in_channels(linear, white, left, noise.reading, channels, [waves[c] for c in channels])
        for channels in sets
    )
    own = [one for one in each if one.evidence > 0.0]
    if all_alike.evidence > max(sum(one.evidence for one in own), 0.0):
        return (all_alike,)
    return tuple(own)


def _in_channels(
    linear: LinearSystem,
    white: Whitener,
    left: Floats,
    sigma: float,
    channels: tuple[int, ...],
    waves: Sequence[Floats],
) -> SlowNoise:
    """Return the likeliest slow noise of one size in some channels; `waves` are those of each channel."""
    columns = np.concatenate(waves, axis=1)
    inside = white @ columns
    values, vectors = np.linalg.eigh(inside.T @ inside)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ (inside.T @ left)) ** 2
    variances = np.array(SIZES) ** 2
    weight = 1.0 / (1.0 + variances[:, None] * values)
    rest = left @ left - np.sum(variances[:, None] * square * weight, axis=1)
    freedom = len(linear) - linear.fixed.shape[1]
    more = 0.5 * np.sum(np.log(weight), axis=1) - 0.5 * freedom * np.log(rest / (left @ left))
    best = int(np.argmax(more))
    # the mean over all sizes, and of one channel one of three
    cost = float(special.logsumexp(more) - np.log(len(SIZES) * (3 if len(channels) == 1 else 1)) - more[best])
    # white noise beside it is smaller than what was found without it
    size = float(SIZES[best]) * sigma * math.sqrt(float(rest[best]) / freedom)
    return SlowNoise(channels, size, float(more[best]) + cost, cost, size * columns)


def _waves(linear: LinearSystem, channel: int) -> Floats:
    """Return draws of unit root mean square over the readings, (N, waves), of a course of 1/f of one channel.

    There are no draws where the channel has too few readings, or all at one time.
    """
    own = np.flatnonzero((linear.setting >= 0) & (linear.rows.channel == channel))
    time = linear.conditions.elapsed_s[linear.rows.reading[own]]
    span = float(np.ptp(time))
    if len(own) < 2 * WAVES or not span > 0.0:
        return np.zeros((len(linear), 0))
    k = np.arange(1, WAVES + 1)
    waves = np.cos(np.pi * k * (time[:, None] - time.min()) / span) / np.sqrt(k)
    columns = np.zeros((len(linear), WAVES))
    columns[own] = waves / np.sqrt(np.mean(np.sum(waves**2, axis=1)))
    return columns


# --- what is said of the noise -------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseKind:
    """How the noise departs from normal: "channels", "runs", "place", "tails", "slow" or "resolution"."""

    what: str
    words: str

    @property
    def headline(self) -> str:
        """The first words of the kind of noise, before the colon, for a headline."""
        return self.words.partition(":")[0]


def noise_kinds(
    linear: LinearSystem, noise: NoiseSize, digit: float, chosen: Mapping[str, str]
) -> Iterator[NoiseKind]:
    """Yield how the noise differs from normal noise of one size; `digit` is the step of the signals' last digit.

    `chosen` are the words of the noise hypotheses that were chosen by evidence.
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
        own = ", ".join(
            message(
                f"{quantity(noise.reading * float(size), unit)} in series {', '.join(str(s) for s in series)}"
            )
            for series, size in zip(_series(linear), linear.by_run.sizes, strict=True)
        )
        yield NoiseKind(
            "runs", message(f"the runs have noise of different sizes, and each weighs by its own: {own}")
        )
    yield from (NoiseKind(what, words) for what, words in chosen.items() if words)
    if is_coarse(digit, noise.reading):
        yield NoiseKind(
            "resolution",
            message(
                f"the signals' last digit is {quantity(digit, unit)}, coarser than their noise: readings of "
                f"a setting "
                "are rounded alike, and what is smaller than the digit may stay hidden"
            ),
        )


def _series(linear: LinearSystem) -> list[list[int]]:
    """Return the numbers of the series in each run."""
    readings = linear.readings
    return [np.unique(readings.series[readings.run == number]).tolist() for number in np.unique(readings.run)]


LARGER: Final = 2.0
"""Least ratio of found to stated noise of a finding."""

OWN_SCATTER: Final = message("the readings' own scatter")
BENCH_FILE: Final = message("the bench file")


@dataclass(frozen=True)
class NoiseFinding:
    """Noise of a reading ("reading") or a setting ("setting") that is larger than the `source` states.

    `found` and `stated` are in `unit`, and `factor` is their ratio. `p` is the probability of this ratio by
    chance, all runs counted. It is that of the run with these `series`, where runs have noise of their own.
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
        """A sentence with the kind of noise, its ratio to the stated noise, and the consequence."""
        of = "a reading" if self.what == "reading" else message("a setting of the head")
        if self.series:
            of += message(f" of series {', '.join(str(number) for number in self.series)}")
        found, stated = (quantity(size, self.unit) for size in (self.found, self.stated))
        return message(
            f"the noise of {of} is {found}, {self.factor:.1f} times the {stated} that {self.source} "
            f"{'say' if self.source == OWN_SCATTER else 'says'}: what the model lacks may hide in it"
        )


class _Stated(NamedTuple):
    size: float
    freedom: float
    source: str


def noise_findings(
    noise: NoiseSize,
    readings: Readings,
    stand_u: Mapping[str, float],
    typical_slope: float,
    digit: float = 0.0,
    by_run: RunSizes | None = None,
) -> tuple[NoiseFinding, ...]:
    """Return where the noise found is larger than stated, significantly and by more than a factor of two.

    `stand_u` has the "setting_error" (rad) and the "voltmeter_error" (V) of the bench file. `typical_slope` is
    the length of du/dphi, unit of the signal per rad. `digit` is the step of the signals' last digit. Runs with
    noise of their own, `by_run`, are each held against what is stated of them.
    """
    of_readings = _of_readings if by_run is None else partial(_of_runs, by_run)
    found = [*of_readings(noise, readings, stand_u, digit), *_of_settings(noise, stand_u, typical_slope)]
    return tuple(one for one in found if one.factor > LARGER and one.p < HARDLY_EVER)


def _of_readings(
    noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], digit: float
) -> Iterator[NoiseFinding]:
    """Yield a finding where the noise of readings exceeds its stated value."""
    stated = _stated(readings, stand_u, digit / np.sqrt(12.0))
    if stated is not None:
        factor = noise.reading / stated.size
        p = float(special.fdtrc(noise.freedom, min(stated.freedom, 1e9), factor**2))
        yield NoiseFinding("reading", noise.reading, stated.size, readings.unit, factor, p, stated.source)


def _of_runs(
    by_run: RunSizes, noise: NoiseSize, readings: Readings, stand_u: Mapping[str, float], digit: float
) -> Iterator[NoiseFinding]:
    """Yield the findings on the noise of readings for each run by itself."""
    runs = len(by_run.sizes)
    for number in range(runs):
        own = readings.select(readings.run == number)
        size = noise.reading * float(by_run.sizes[number])
        of_run = replace(noise, reading=size, freedom=max(round(float(by_run.freedom[number])), 1))
        series = tuple(int(one) for one in np.unique(own.series))
        for found in _of_readings(of_run, own, stand_u, digit):
            yield replace(found, p=min(runs * found.p, 1.0), series=series)


def _of_settings(
    noise: NoiseSize, stand_u: Mapping[str, float], typical_slope: float
) -> Iterator[NoiseFinding]:
    """Yield a finding where the setting error exceeds the value in the bench file."""
    setting = stand_u.get("setting_error", 0.0)
    if setting > 0.0:
        along = [noise.reading**2 + (size * typical_slope) ** 2 for size in (noise.setting_rad, setting)]
        freedom = noise.freedom / 3.0
        p = float(special.chdtrc(freedom, freedom * along[0] / along[1]))
        found, limit = noise.setting_rad / ARCSEC, setting / ARCSEC
        yield NoiseFinding("setting", found, limit, "arcsec", found / limit, p, BENCH_FILE)


def _stated(readings: Readings, stand_u: Mapping[str, float], rounding: float) -> _Stated | None:
    """Return the stated noise of a reading: the larger of that of its samples and that of the bench file.

    Either is without that of `rounding`. Samples do not show an error that they share; the bench file may state
    it.
    """
    stated = []
    size = stand_u.get("voltmeter_error", 0.0)
    if size > 0.0 and readings.unit == "V":
        stated.append(_Stated(float(np.hypot(size, rounding)), np.inf, BENCH_FILE))
    count = readings.samples[:, None] * np.isfinite(readings.signal_sd) * (readings.signal_sd > 0.0)
    sampled = count > 1
    if np.any(sampled & readings.is_oriented[:, None]):
        of_mean = readings.signal_sd[sampled] / np.sqrt(count[sampled])
        shown = float(np.hypot(rms(of_mean), rounding))
        stated.append(_Stated(shown, float(np.sum(count[sampled] - 1)), OWN_SCATTER))
    return max(stated, key=lambda each: each.size, default=None)
