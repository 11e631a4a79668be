"""Weights of readings, and kinds of noise: slow, rounded, heavy-tailed, by channel; compared with repeats."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints, rms
from bench.base.numbers import quantity
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import KNOWN_SIZE, Data, Search, Whitened, total_evidence
from bench.diagnosis.linear import LinearSystem, RunSizes
from bench.diagnosis.mistakes.single_readings import BEYOND_TAILS, LEAST_VALUES, odds_of_tails
from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.noise_grid import Whitener, cells_of, is_coarse, make_whitener
from bench.diagnosis.posterior import NoiseSize, noise_size, posterior, whiten_rows
from bench.readings.table import Readings
from bench.stats.repeats_likelihood import believed_sizes

CLIP: Final = 2.5
"""Robust standard deviations beyond which a reading is weighed down."""
OF_READING: Final = 0.4
"""A row tells of the noise of readings where the fit, which has the error of its setting in it, leaves as much."""
FREEST: Final = 0.05
"""Lower limit of the fraction of a reading that the fit leaves."""
SURE_OF_WEIGHTS: Final = -0.5
"""Tails count as heavy where ln of the odds for them is more: of normal noise it is about -5."""
CLEARLY: Final = 3.0
"""An effect in a few readings is there where ln of its odds is so much above that of the tails."""
ROUNDS: Final = 8
ROBUST: Final = 1.4826
"""Median of absolute values to standard deviation, of normal noise."""


@dataclass(frozen=True)
class WeighedDown:
    """Result of weighting for heavy tails: row changes `pull` (N,), count of `readings`, ln `odds`."""

    pull: Floats
    readings: int
    odds: float


def weigh_down(
    linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize
) -> WeighedDown | None:
    """Return how readings are weighed down beside what was found; None where the noise has no heavy tails.

    What shows in a few readings alone is what tails look like: single readings are among those that are weighed
    where tails reach as far, an effect too where its evidence is not clearly above that of the tails.
    """
    few = [found for found in naming.found if _in_few(candidates, found)]
    named = [found for found in few if found.variant.named]
    few = [found for found in few if found.variant.named or found.size < BEYOND_TAILS]
    weighed = _weighed(linear, candidates, [f for f in naming.found if f not in few], noise)
    if not named or weighed is None:
        return weighed
    if sum(found.total for found in named) < weighed.odds + CLEARLY:
        return weighed
    return _weighed(linear, candidates, [f for f in naming.found if f not in few or f in named], noise)


def _in_few(candidates: Candidates, found: FoundEffect) -> bool:
    """Return whether a find shows in too few rows to be told from heavy tails."""
    rows = np.any(candidates.columns[:, list(found.variant.columns)] != 0.0, axis=1)
    return bool(np.count_nonzero(rows) < LEAST_VALUES)


def _weighed(
    linear: LinearSystem, candidates: Candidates, beside: Sequence[FoundEffect], noise: NoiseSize
) -> WeighedDown | None:
    columns = [i for found in beside for i in found.variant.columns]
    fit = _Fit.of(linear, candidates.columns[:, columns], noise)
    spread = noise.reading * linear.relative * np.sqrt(np.maximum(fit.free, FREEST))
    size = (linear.response - fit @ linear.response) / spread
    telling = fit.free > OF_READING
    by_channel = [size[telling & (linear.rows.channel == c)] for c in range(4)]
    odds = odds_of_tails(np.concatenate(_alike(by_channel)))
    if odds < SURE_OF_WEIGHTS:
        return None
    scale = np.array([_robust(of if len(of) >= LEAST_VALUES else size[telling]) for of in by_channel])
    limit = CLIP * spread * scale[linear.rows.channel]
    response = linear.response
    for _ in range(ROUNDS):
        fitted = fit @ response
        response = fitted + np.clip(linear.response - fitted, -limit, limit)
    pull = response - linear.response
    changed = np.abs(pull) > 0.1 * limit
    return WeighedDown(pull, len(set(linear.rows.reading[changed].tolist())), odds)


def _robust(values: Floats) -> float:
    """Return the standard deviation that a normal noise of the same median absolute value has."""
    return ROBUST * float(np.median(np.abs(values))) if len(values) else 1.0


def _alike(by_channel: list[Floats]) -> list[Floats]:
    """Return the values of each channel by their own root mean square; those of the moduli, few, as they are."""
    of_channels = [of / max(float(np.sqrt(np.mean(of**2))), 1e-300) for of in by_channel[:3] if len(of)]
    return [*of_channels, by_channel[3]]


@dataclass(frozen=True)
class _Fit:
    """What is fitted of responses (N,), each setting's error too; `free` (N,) is what it leaves of each row."""

    white: Whitener
    noise2: Floats
    free: Floats

    @classmethod
    def of(cls, linear: LinearSystem, effects: Floats, noise: NoiseSize) -> _Fit:
        """Fit the system with its stand angles and the effects' columns (N, m), all within their priors."""
        random = np.concatenate([linear.random, effects * KNOWN_SIZE], axis=1)
        white = make_whitener(replace(linear, random=random), noise.reading, noise.setting_rad)
        return cls(white, linear.relative**2, linear.relative**2 * white.diagonal)

    def __matmul__(self, response: Floats) -> Floats:
        # the noise of readings is what is left: its covariance by that of all, weighed
        return np.asarray(response - self.noise2 * self.white.weigh(response))


UNEQUAL_P: Final = 0.01
"""Channels have noise of different sizes where the p-value of equal sizes is below this."""


@dataclass(frozen=True)
class ChannelSizes:
    """Sizes (3,) of the channels' noise, 1 on the average of squares, and all 1 where they are alike.

    `evidence` is ln odds that they have sizes of their own against one of all, no size of it more likely before.
    """

    sizes: Floats
    evidence: float


def by_channel(left: Floats, freedom: Floats, slope: Floats, cells: Ints, floor: float) -> ChannelSizes:
    """Return the sizes of the channels' noise.

    `left` (n, 3) is what a description leaves of each setting, `freedom` (n,) how much of it the description does
    not take up, `slope` (n, 3) du/dphi: what goes along it is the setting's. `cells` (n,) number settings with
    the same slope, `floor` is the least noise that is believed, unit of the signal.
    """
    count = int(cells.max()) + 1
    free = np.bincount(cells, freedom, count)
    products = (left[:, :, None] * left[:, None, :]).reshape(-1, 9)
    scatter = _by_cell(products, cells, count)
    mean = _by_cell(slope, cells, count) / np.bincount(cells, minlength=count)[:, None]
    used = free > 1e-6
    scatter, free = scatter[used].reshape(1, -1, 3, 3), free[used]
    found = believed_sizes(scatter, free, mean[used][None], floor)
    p_equal = float(found.p_equal[0])
    # of a chi-square with two degrees of freedom half is -ln p; two sizes more cost ln n (Schwarz's criterion)
    evidence = -math.log(max(p_equal, 1e-300)) - math.log(max(float(free.sum()), 1.0))
    if p_equal > UNEQUAL_P:
        return ChannelSizes(np.ones(3), evidence)
    sizes = np.sqrt(found.variances[0, :3])
    return ChannelSizes(np.asarray(sizes / rms(sizes)), evidence)


def _by_cell(columns: Floats, cells: Ints, count: int) -> Floats:
    sums = [np.bincount(cells, column, count) for column in columns.T]
    return np.asarray(np.stack(sums, axis=1), dtype=np.float64)


def sizes_left(
    linear: LinearSystem, candidates: Candidates, whitened: Whitened, data: Data, columns: Sequence[int]
) -> ChannelSizes:
    """Return the sizes of the channels' noise from what the model leaves with these columns of what was found."""
    noise = noise_size(whitened, data, tuple(columns))
    effects = candidates.columns[:, list(columns)]
    fitted = posterior(linear, effects, noise)
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)
    rows = np.ones(len(linear), dtype=bool)
    white = whiten_rows(linear, noise, design, rows)
    free = 1.0 - np.einsum("np,pq,nq->n", white, fitted.covariance, white, optimize=True)
    oriented = linear.setting >= 0
    of_run = linear.relative_of_run
    left = ((linear.response - design @ fitted.mean) / of_run)[oriented].reshape(-1, 3)
    slope = (linear.slope / of_run)[oriented].reshape(-1, 3)
    floor = 1e-11 * float(np.max(np.abs(linear.readings.signal)))
    return by_channel(left, free[oriented].reshape(-1, 3).mean(axis=1), slope, cells_of(linear), floor)


# --- what kind of noise it is ---------------------------------------------------------------------


WAVES: Final = 16
"""Half waves over a run, the slowest of them."""
SIZES: Final = tuple(np.geomspace(0.05, 20.0, 61))
"""Trial sizes of slow noise: root mean squares in units of the noise of a reading."""
SURE: Final = 1e-3
"""Slow noise is significant where the p-value of its likelihood ratio is below this."""
BESIDE: Final = (0.25, 0.5, 1.0, 2.0)
"""Sizes of slow noise of all channels beside which what was found must hold, in units of the noise of a reading."""


@dataclass(frozen=True)
class SlowNoise:
    """Noise of a channel (0, 1, 2) that is slow: `size` its root mean square over a run, unit of the signal.

    `columns` (N, waves) are draws of unit variance of it, in the rows of the system; `odds` is ln of its
    evidence over that of none, of whatever size: its share, where it is of all channels alike. Where it is not
    `sure` it does not show by itself: it only explains the readings as well as an effect does.
    """

    channel: int
    size: float
    odds: float
    columns: Floats
    sure: bool = True


def slow_noise(linear: LinearSystem, whitened: Whitened, ratio: int) -> tuple[SlowNoise, ...]:
    """Return the slow noise of each channel that has it, beside the coefficients and the stand's errors.

    `ratio` is the number of that of the two noise sizes in the grid of `whitened`.
    """
    return tuple(_found(linear, whitened, ratio))


def _found(linear: LinearSystem, whitened: Whitened, ratio: int) -> Iterator[SlowNoise]:
    white, sigma, freedom = whitened.grid.white[ratio], whitened.grid.sigma, whitened.grid.freedom
    left = white @ (linear.response / sigma)
    for channel in range(3):
        waves = _waves(linear, channel)
        if waves is None:
            continue
        inside = white @ waves  # those of a size of sigma
        values, vectors = np.linalg.eigh(inside.T @ inside)
        values = np.maximum(values, 0.0)
        square = (vectors.T @ (inside.T @ left)) ** 2
        variances = np.array(SIZES) ** 2
        weighed = 1.0 / (1.0 + variances[:, None] * values)
        rest = left @ left - np.sum(variances[:, None] * square * weighed, axis=1)
        likelihood = 0.5 * np.sum(np.log(weighed), axis=1) - 0.5 * freedom * np.log(rest)
        best = int(np.argmax(likelihood))
        none = -0.5 * freedom * np.log(left @ left)
        more = float(likelihood[best] - none)
        # of one channel in three, of any size alike: the price that names pay for their forms, too
        odds = float(special.logsumexp(likelihood - none) - np.log(3 * len(SIZES)))
        p = 0.5 * float(special.chdtrc(1, 2.0 * max(more, 0.0)))
        if p < SURE:
            # white noise beside it is smaller than what was found without it
            size = SIZES[best] * sigma * float(np.sqrt(rest[best] / freedom))
            yield SlowNoise(channel, size, odds, size * waves)


@dataclass(frozen=True)
class SlowNoiseOdds:
    """What slow noise of all channels, of whatever size, leaves of the odds that anything is missing.

    `total` is their ln, over all sizes and none; `slow` is the noise of the likeliest size.
    """

    total: float
    slow: tuple[SlowNoise, ...]


def beside_all_sizes(
    linear: LinearSystem, whitened: Whitened, noise: float, plausible: float
) -> SlowNoiseOdds | None:
    """Return the odds that anything is missing where slow noise may be there.

    `noise` is that of a reading, unit of the signal, `plausible` what the odds of slow noise are beforehand, of all
    its sizes together. None where readings are too few to tell of it.
    """
    own = {c: waves for c in range(3) if (waves := _waves(linear, c)) is not None}
    if not own:
        return None
    units = [noise * linear.by_channel[c] * waves for c, waves in own.items()]
    whole, models = _with_courses(whitened, np.column_stack(units))
    data = whole.reduce(linear.response[:, None])
    scored = np.array([_scored(whole, data, known) for known in models])
    weight = scored[:, 0] + np.log([1.0, *np.full(len(BESIDE), plausible / len(BESIDE))])
    total = float(special.logsumexp(weight + scored[:, 1]) - special.logsumexp(weight))
    size = BESIDE[int(np.argmax(weight[1:]))]
    odds = float(special.logsumexp(weight[1:]) - weight[0]) / len(own)
    slow = (
        SlowNoise(channel, size * noise * float(linear.by_channel[channel]), odds, size * columns, sure=False)
        for channel, columns in zip(own, units, strict=True)
    )
    return SlowNoiseOdds(total, tuple(slow))


def _with_courses(whitened: Whitened, courses: Floats) -> tuple[Whitened, list[tuple[int, ...]]]:
    """Return candidates with courses (N, k) in each size beside them; the columns of no course and of each size.

    A column that a model has counts with the prior size of `KNOWN_SIZE`: as one of a course it has its own.
    """
    columns = whitened.candidates.columns
    sized = [size / KNOWN_SIZE * courses for size in BESIDE]
    grown = replace(whitened.candidates, columns=np.column_stack([columns, *sized]))
    first, many = columns.shape[1], courses.shape[1]
    starts = range(first, first + many * len(BESIDE), many)
    whole = Whitened.of(whitened.grid, grown, few_known=True)
    return whole, [(), *(tuple(range(start, start + many)) for start in starts)]


def _scored(whole: Whitened, data: Data, known: tuple[int, ...]) -> tuple[float, float]:
    """Return ln of the likelihood of a model with these columns, and ln odds that anything is missing beside it."""
    search, grid = Search.beside(whole, known), whole.grid
    square = search.left_over(data).square[:, 0]
    likelihood = special.logsumexp(
        grid.log_prior + grid.log_det + search.log_det + grid.log_likelihood(square)
    )
    return float(likelihood), float(total_evidence(search.score(data), whole)[0])


def _waves(linear: LinearSystem, channel: int) -> Floats | None:
    """Return draws of unit root mean square over the readings, (N, waves), of a course of 1/f of one channel."""
    own = np.flatnonzero((linear.setting >= 0) & (linear.rows.channel == channel))
    time = linear.conditions.elapsed_s[linear.rows.reading[own]]
    span = float(np.ptp(time))
    if len(own) < 2 * WAVES or not span > 0.0:
        return None
    k = np.arange(1, WAVES + 1)
    waves = np.cos(np.pi * k * (time[:, None] - time.min()) / span) / np.sqrt(k)
    columns = np.zeros((len(linear), WAVES))
    columns[own] = waves / np.sqrt(np.mean(np.sum(waves**2, axis=1)))
    return columns


def with_slow_noise(linear: LinearSystem, slow: Sequence[SlowNoise]) -> LinearSystem:
    """Return the system with slow noise as further `random` columns."""
    return linear.with_noise(*(one.columns for one in slow))


@dataclass(frozen=True)
class NoiseKind:
    """What the noise is: unequal "channels" or "runs", with heavy "tails", "slow", of a coarse "resolution"."""

    what: str
    words: str


def noise_kinds(
    linear: LinearSystem,
    noise: NoiseSize,
    weighed: WeighedDown | None,
    digit: float,
    slow: Sequence[SlowNoise] = (),
) -> Iterator[NoiseKind]:
    """Yield what the noise is beside normal and of one size; `digit` is the step of the signals' last digit."""
    unit = linear.readings.unit
    if np.any(linear.by_channel != 1.0):
        sizes = noise.reading * linear.by_channel
        told = ", ".join(f"{quantity(size, unit)} in {c}" for c, size in zip(CHANNELS, sizes, strict=True))
        yield NoiseKind("channels", f"the channels have noise of different sizes: {told}")
    if linear.by_run is not None:
        own = ", ".join(
            f"{quantity(noise.reading * float(size), unit)} in series {', '.join(str(s) for s in series)}"
            for series, size in zip(_series(linear), linear.by_run.sizes, strict=True)
        )
        yield NoiseKind("runs", f"the runs have noise of different sizes, and each weighs by its own: {own}")
    if weighed is not None:
        yield NoiseKind(
            "tails",
            f"the noise has heavier tails than a normal one: {weighed.readings} readings are weighed down, and an "
            "outlier is named only where it is far beyond them",
        )
    if slow:
        told = ", ".join(f"{quantity(one.size, unit)} in {CHANNELS[one.channel]}" for one in slow)
        over = f"slow noise, over the run {told} (root mean square)"
        if all(one.sure for one in slow):
            there = f"beside the noise of a reading there is {over}"
        else:
            there = f"{over}, explains the readings as well as an effect does"
        yield NoiseKind(
            "slow",
            f"{there}: a drift that is no larger stays hidden in it, and the u of the coefficients holds it",
        )
    if is_coarse(digit, noise.reading):
        yield NoiseKind(
            "resolution",
            f"the signals' last digit is {quantity(digit, unit)}, coarser than their noise: readings of a setting "
            "are rounded alike, and what is smaller than the digit may stay hidden",
        )


def _series(linear: LinearSystem) -> list[list[int]]:
    """Return the numbers of the series in each run."""
    readings = linear.readings
    return [np.unique(readings.series[readings.run == number]).tolist() for number in np.unique(readings.run)]


LARGER: Final = 2.0
"""Noise is a finding where it is more than so many times what is stated,"""
SIGNIFICANT: Final = 1e-4
"""and chance alone makes it so much larger less often than this."""

OWN_SCATTER: Final = "the readings' own scatter"
BENCH_FILE: Final = "the bench file"


@dataclass(frozen=True)
class NoiseFinding:
    """Noise of a reading ("reading") or a setting ("setting") that is larger than the `source` states.

    `found` and `stated` in `unit`, `factor` times one another; `p` is the probability of so much by chance, all
    runs counted. It is that of the run with these `series`, where runs have noise of their own.
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
        """A sentence: what, by how much, what it may mean."""
        of = "a reading" if self.what == "reading" else "a setting of the head"
        if self.series:
            of += f" of series {', '.join(str(number) for number in self.series)}"
        found, stated = (quantity(size, self.unit) for size in (self.found, self.stated))
        return (
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

    `stand_u` has the "setting_error" (rad) and the "voltmeter_error" (V) of the bench file, `typical_slope` is
    how a setting error shows in all three signals, unit of the signal per rad, `digit` the step of the signals'
    last digit: rounding to it is expected. Runs with noise of their own, `by_run`, are each held against what is
    stated of them.
    """
    of_readings = _of_readings if by_run is None else partial(_of_runs, by_run)
    found = [*of_readings(noise, readings, stand_u, digit), *_of_settings(noise, stand_u, typical_slope)]
    return tuple(one for one in found if one.factor > LARGER and one.p < SIGNIFICANT)


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
    """Return the noise of a reading as it is stated: the larger of what its samples show and the bench file says.

    Either is without that of `rounding`. An error that is fresh in each reading and alike in all its samples, as
    that of the shipped stand, only the bench file knows: its word counts where it is larger.
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
