"""Coefficients and effects together, once it is settled which effects the model has; and what they predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import KNOWN_SIZE, LOG_SIZE_WEIGHTS, SIZES, Data, Search, Whitened
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.base.arrays import Floats, Mask

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
