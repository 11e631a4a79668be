"""Coefficients and effects together once the effects are settled; what they predict."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, Literal

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.diagnosis.candidates import Candidates, Column, Variant
from bench.diagnosis.evidence import KNOWN_SIZE, LOG_SIZE_WEIGHTS, SIZES, Data, Search, Whitened
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import Naming
from bench.model.effects import CATALOGUE, AppliedEffect

AVERAGED: Final = 5
"""Parts over whose sizes is averaged: of one run no more are found, of many the least sure count."""


@dataclass(frozen=True)
class NoiseSize:
    """Noise of a reading (unit of the signal), setting error (rad), and the freedom they were found with."""

    reading: float
    setting_rad: float
    freedom: int

    @property
    def setting_arcsec(self) -> float:
        """The setting error in seconds of arc."""
        return self.setting_rad * 648000 / np.pi


@dataclass(frozen=True)
class Posterior:
    """Estimates of coefficients (less the first guess), stand and effects, with covariance, unit of the priors.

    Order: 12 coefficients of each block in their units; the columns of `LinearSystem.random`; the effects' columns.
    """

    mean: Floats
    covariance: Floats
    effects: int

    @property
    def amplitudes(self) -> Floats:
        """Of the effects' columns."""
        return self.mean[len(self.mean) - self.effects :]

    @property
    def amplitude_covariance(self) -> Floats:
        """Their covariance."""
        first = len(self.mean) - self.effects
        return self.covariance[first:, first:]


def noise_size(whitened: Whitened, data: Data, known: tuple[int, ...]) -> NoiseSize:
    """Return the most probable noise sizes when the `known` columns are in the model."""
    search = Search.beside(whitened, known)
    left = search.left_over(data)
    grid = whitened.grid
    weight = grid.log_prior + grid.log_det + search.log_det + grid.log_likelihood(left.square[:, 0])
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    freedom = grid.freedom - len(known)
    sigma2 = left.square[:, 0] / freedom
    if grid.known:
        sigma2 = np.maximum(sigma2, 1.0)
    setting2 = sigma2 * grid.setting_rad_per_noise**2
    return NoiseSize(
        float(grid.sigma * np.sqrt(weight @ sigma2)), float(grid.sigma * np.sqrt(weight @ setting2)), freedom
    )


def posterior(linear: LinearSystem, effects: Floats, noise: NoiseSize, rows: Mask | None = None) -> Posterior:
    """Estimate from `rows` (all by default) with the effects' columns (N, m), one prior size each."""
    extra = effects.shape[1]
    normal, right = _normal(linear, effects, noise, rows)
    covariance = _inverse(normal + np.diag(_at_the_end(np.full(extra, 1.0 / KNOWN_SIZE**2), len(normal))))
    return Posterior(covariance @ right, covariance, extra)


def fit_found(linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize) -> Posterior:
    """Estimate with all that was found, averaged over the sizes that effects may have.

    What the readings do not tell of an effect (how it divides between mountings, say) is as uncertain as effects
    of such sizes are, each size with the probability that the prior of the search (`evidence.SIZES`) and the
    readings give it. Mean and covariance are those of the mixture. All else is normal given the effects, so that
    it is eliminated once.
    """
    columns = candidates.columns[:, list(naming.columns)]
    extra = columns.shape[1]
    normal, right = _normal(linear, columns, noise)
    if not extra:
        covariance = _inverse(normal)
        return Posterior(covariance @ right, covariance, 0)
    rest = len(normal) - extra
    free = _inverse(normal[:rest, :rest])
    gain = free @ normal[:rest, rest:]
    mean, spread = _of_any_size(
        normal[rest:, rest:] - normal[rest:, :rest] @ gain,
        right[rest:] - gain.T @ right[:rest],
        [mine for _, mine in naming.parts()],
    )
    follows = np.vstack([-gain, np.eye(extra)])
    covariance = follows @ spread @ follows.T
    covariance[:rest, :rest] += free
    whole = follows @ mean
    whole[:rest] += free @ right[:rest]
    return Posterior(whole, covariance, extra)


def _of_any_size(precision: Floats, right: Floats, parts: Sequence[slice]) -> tuple[Floats, Floats]:
    """Return mean (m,) and covariance (m, m) of amplitudes, averaged over the size of each part of them.

    `precision` (m, m) and `right` (m,) are what the readings say of them, without a prior.
    """
    log_weights, means, spreads = zip(
        *(
            _of_sizes(precision, right, parts, sizes)
            for sizes in product(*_plausible_sizes(precision, right, parts))
        ),
        strict=True,
    )
    weight = np.exp(np.array(log_weights) - max(log_weights))
    weight /= weight.sum()
    mean = weight @ np.array(means)
    apart = np.array(means) - mean
    return mean, np.einsum("s,sij->ij", weight, np.array(spreads)) + (apart.T * weight) @ apart


def _plausible_sizes(precision: Floats, right: Floats, parts: Sequence[slice]) -> list[tuple[int, ...]]:
    """Return the sizes over which each part is averaged: all, but of many parts the surest have the likeliest."""
    every = tuple(range(len(SIZES)))
    if len(parts) <= AVERAGED:
        return [every] * len(parts)
    likeliest = [len(SIZES) - 1] * len(parts)
    surety = np.empty(len(parts))
    for number in range(len(parts)):
        before, after = likeliest[:number], likeliest[number + 1 :]
        logs = np.array([_of_sizes(precision, right, parts, (*before, k, *after))[0] for k in every])
        likeliest[number] = int(np.argmax(logs))
        surety[number] = 1.0 / np.sum(np.exp(logs - logs.max()))
    open_parts = set(np.argsort(surety)[:AVERAGED].tolist())
    return [every if number in open_parts else (size,) for number, size in enumerate(likeliest)]


def _of_sizes(
    precision: Floats, right: Floats, parts: Sequence[slice], sizes: Sequence[int]
) -> tuple[float, Floats, Floats]:
    """Return ln of the probability of these sizes of the parts, and mean and covariance of amplitudes then."""
    prior = np.ones(len(right))
    for size, mine in zip(sizes, parts, strict=True):
        prior[mine] = 1.0 / SIZES[size] ** 2
    spread = _inverse(precision + np.diag(prior))
    mean = spread @ right
    log_det = np.linalg.slogdet(spread)[1] + np.sum(np.log(prior))
    return sum(LOG_SIZE_WEIGHTS[size] for size in sizes) + 0.5 * float(log_det + right @ mean), mean, spread


def _normal(
    linear: LinearSystem, effects: Floats, noise: NoiseSize, rows: Mask | None = None
) -> tuple[Floats, Floats]:
    """Return normal matrix and right side with the priors of the stand, none of the effects' columns (N, m)."""
    mine = np.ones(len(linear), dtype=bool) if rows is None else rows
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)[mine]
    white = whiten_rows(linear, noise, np.column_stack([design, linear.response[mine]]), mine)
    normal = white[:, :-1].T @ white[:, :-1]
    first, random = linear.fixed.shape[1], linear.random.shape[1]
    normal[range(first, first + random), range(first, first + random)] += 1.0
    return normal, white[:, :-1].T @ white[:, -1]


def _at_the_end(values: Floats, length: int) -> Floats:
    return np.concatenate([np.zeros(length - len(values)), values])


def _inverse(normal: Floats) -> Floats:
    """Return the inverse of a positive matrix whose rows have units of their own."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale))


def whiten_rows(linear: LinearSystem, noise: NoiseSize, columns: Floats, rows: Mask) -> Floats:
    """Return R^(-1/2) times columns of the given rows; whole settings must be among them."""
    relative = linear.relative[rows][:, None]
    columns = columns / relative
    slope = linear.slope[rows][:, None] / relative
    setting = linear.setting[rows]
    factor = (noise.setting_rad / noise.reading) ** 2
    oriented = setting >= 0
    d = slope[oriented].reshape(-1, 3)
    length2 = np.sum(d**2, axis=1)
    shrink = (1 - 1 / np.sqrt(1 + factor * length2)) / np.maximum(length2, 1e-300)
    block = columns[oriented].reshape(len(d), 3, columns.shape[1])
    along = np.einsum("ni,nip->np", d, block) * shrink[:, None]
    white = columns / noise.reading
    white[oriented] -= (d[:, :, None] * along[:, None, :]).reshape(-1, columns.shape[1]) / noise.reading
    return white


def predicted_error(
    linear: LinearSystem, effects: Floats, noise: NoiseSize, fitted: Posterior, rows: Mask
) -> tuple[Floats, float]:
    """Return measured less predicted in rows that were not used (n,), and its chi-square.

    The covariance is that of the noise and of all that was estimated.
    """
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)[rows]
    error = linear.response[rows] - design @ fitted.mean
    white = whiten_rows(linear, noise, np.column_stack([design, error]), rows)
    spread = np.eye(len(error)) + white[:, :-1] @ fitted.covariance @ white[:, :-1].T
    return error, float(white[:, -1] @ np.linalg.solve(spread, white[:, -1]))


ADDED: Final = ("warm_up", "bias_drift", "thermal_bias", "turn_on_shift")
"""Effects that add to the signals whatever the acceleration is."""
EQUAL: Final = 0.05
"""Probability above which three sizes in volts count as equal,"""
SEEN: Final = 4.0
"""where each is so many standard uncertainties large: three that are hardly there are always equal."""


def common_volts(naming: Naming, fitted: Posterior, linear: LinearSystem) -> Iterator[str]:
    """Yield a sentence for each effect of the three accelerometers that is the same in volts in all of them."""
    # one prior size of each channel's column is the same part of its K_ii
    scale = np.diag(linear.block.K)
    apart = np.diff(np.eye(3), axis=0)
    for found, mine in naming.parts():
        variant = found.variant
        if variant.family not in ADDED or len(variant.columns) != 3 or len(variant.channels) != 3:
            continue
        volts = fitted.amplitudes[mine] * scale
        covariance = fitted.amplitude_covariance[mine, mine] * np.outer(scale, scale)
        between = apart @ volts
        chi2 = float(between @ np.linalg.solve(apart @ covariance @ apart.T, between))
        seen = np.all(np.abs(volts) > SEEN * np.sqrt(np.diag(covariance)))
        if seen and special.chdtrc(2, chi2) > EQUAL:
            yield (
                f"{variant.family} is the same voltage in all three channels within its u: that points at what "
                "they share (the voltmeters' zero, the supply, the wiring), not at three accelerometers; a shorted "
                "input in each pass tells"
            )


FAR_BETTER: Final = 0.25
"""A sum or difference is stated when its u is no more than this part of that of either value."""


@dataclass(frozen=True)
class KnownTogether:
    """The sum or difference of a parameter `of` two channels or mountings, with u, in the catalogue's unit."""

    parameter: str
    combination: Literal["sum", "difference"]
    of: tuple[str, str]
    value: float
    u: float
    unit: str


def known_together(
    candidates: Candidates, variant: Variant, value: Floats, covariance: Floats
) -> tuple[KnownTogether, ...]:
    """Return the sums and differences of two values of a parameter that are far better known than either.

    `value` (m,) and `covariance` (m, m) are in plausible sizes, as the variant's columns. So the third mounting
    angle of both installations: verification points tell the sum, nothing tells the difference, which is a turn
    of the block's axes.
    """
    return tuple(_pairs(candidates, variant, value, covariance))


def _pairs(
    candidates: Candidates, variant: Variant, value: Floats, covariance: Floats
) -> Iterator[KnownTogether]:
    kinds = [candidates.kinds[column] for column in variant.columns]
    parameters = {parameter.name: parameter for parameter in CATALOGUE[variant.family].parameters}
    for i, j in itertools.combinations(range(len(kinds)), 2):
        if kinds[i].parameter != kinds[j].parameter:
            continue
        sign = -1.0 if covariance[i, j] > 0.0 else 1.0
        u = np.sqrt(max(covariance[i, i] + covariance[j, j] + 2.0 * sign * covariance[i, j], 0.0))
        if u > FAR_BETTER * np.sqrt(min(covariance[i, i], covariance[j, j])):
            continue
        parameter = parameters[kinds[i].parameter]
        size = candidates.scale[variant.columns[i]] / parameter.si_per_unit
        yield KnownTogether(
            parameter.name,
            "sum" if sign > 0 else "difference",
            (_place(kinds[i]), _place(kinds[j])),
            float((value[i] + sign * value[j]) * size),
            float(u * size),
            parameter.unit,
        )


def _place(kind: Column) -> str:
    """Return what a column is of: "z", "installation 1", "z in installation 1"."""
    channel = "" if kind.channel is None else CHANNELS[kind.channel]
    mounts = f"installation {'+'.join(kind.mounts)}" if kind.mounts else ""
    return " in ".join(filter(None, (channel, mounts)))


def applied_of(
    candidates: Candidates, variant: Variant, value: Floats, u: Floats
) -> tuple[AppliedEffect, ...]:
    """Return an effect with estimated values in SI, once for each set of mountings with its own values.

    `value` (m,) and `u` (m,) are in plausible sizes, as the variant's columns.
    """
    channels = tuple(CHANNELS[c] for c in variant.channels)
    kinds = [candidates.kinds[column] for column in variant.columns]
    applied = []
    for mounts in dict.fromkeys(kind.mounts for kind in kinds):
        values: dict[str, Floats] = {name: np.asarray(size) for name, size in variant.shape}
        sizes: dict[str, Floats] = {}
        for place, (column, kind) in enumerate(zip(variant.columns, kinds, strict=True)):
            if kind.mounts != mounts:
                continue
            at = () if kind.channel is None else kind.channel
            for numbers, number in ((values, value[place]), (sizes, u[place])):
                numbers.setdefault(kind.parameter, np.zeros(() if kind.channel is None else 3))
                numbers[kind.parameter][at] = number * candidates.scale[column]
        applied.append(AppliedEffect(CATALOGUE[variant.family], values, channels, sizes, mounts))
    return tuple(applied)
