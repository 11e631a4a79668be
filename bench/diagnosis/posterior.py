"""Joint estimate of the coefficients and the effects found."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, Literal

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.calibration.noise import without_setting
from bench.diagnosis.candidates import Candidates, Column, Variant
from bench.diagnosis.evidence import KNOWN_SIZE, LOG_SIZE_WEIGHTS, SIZES, Data, Search, Whitened
from bench.diagnosis.levels import HARDLY_EVER, OFTEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import MOST_EFFECTS, Naming
from bench.model.effects import CATALOGUE, AppliedEffect, Effect


@dataclass(frozen=True)
class NoiseSize:
    """The noise of a reading, unit of the signal, with its degrees of freedom, and the setting error, rad."""

    reading: float
    setting_rad: float
    freedom: int

    @property
    def setting_arcsec(self) -> float:
        """The setting error in seconds of arc."""
        return self.setting_rad * 648000 / np.pi


@dataclass(frozen=True)
class Posterior:
    """Joint estimates of all unknowns, `mean`, with their `covariance`.

    The unknowns are, in this order: the changes of the 12 coefficients of each block from the first guess, each
    in the unit of the coefficient; the amplitudes of the columns `LinearSystem.random`, each as a multiple of
    its prior standard deviation; the amplitudes of the m columns of the effects found, each as a multiple of its
    plausible size. `effects` is m.
    """

    mean: Floats
    covariance: Floats
    effects: int

    @property
    def amplitudes(self) -> Floats:
        """The amplitudes (m,) of the effects' columns, each as a multiple of its plausible size."""
        return self.mean[len(self.mean) - self.effects :]

    @property
    def amplitude_covariance(self) -> Floats:
        """The covariance matrix (m, m) of `amplitudes`."""
        first = len(self.mean) - self.effects
        return self.covariance[first:, first:]

    def significance(self, of: slice) -> tuple[float, float]:
        """Return the size rho of the amplitudes b in a slice in units of u, and its p-value (chi-square).

        With their covariance C, rho^2 = b^T C^-1 b.
        """
        amplitudes, covariance = self.amplitudes[of], self.amplitude_covariance[of, of]
        square = float(amplitudes @ _inverse(covariance) @ amplitudes)
        return float(np.sqrt(max(square, 0.0))), float(special.chdtrc(len(amplitudes), square))


def noise_size(whitened: Whitened, data: Data, known: tuple[int, ...]) -> NoiseSize:
    """Return the noise with the columns `known` in the model, averaged over the probable noise ratios."""
    search = Search.beside(whitened, known)
    left = search.left_over(data)
    grid = whitened.grid
    logs = grid.log_prior + grid.log_det + search.log_det + grid.log_likelihood(left.square[:, 0])
    weight = special.softmax(logs)
    freedom = grid.freedom - len(known)
    sigma2 = left.square[:, 0] / freedom
    if grid.known:
        sigma2 = np.maximum(sigma2, 1.0)
    setting2 = sigma2 * grid.setting_rad_per_noise**2
    return NoiseSize(
        float(grid.sigma * np.sqrt(weight @ sigma2)), float(grid.sigma * np.sqrt(weight @ setting2)), freedom
    )


def posterior(linear: LinearSystem, effects: Floats, noise: NoiseSize, rows: Mask | None = None) -> Posterior:
    """Return the estimates from the rows in the mask `rows` (None: all), for a known noise.

    The amplitudes of `effects` (N, m) have normal priors of `KNOWN_SIZE` plausible sizes.
    """
    extra = effects.shape[1]
    normal, right = _normal(linear, effects, noise, rows)
    normal[np.arange(-extra, 0), np.arange(-extra, 0)] += 1.0 / KNOWN_SIZE**2
    covariance = _inverse(normal)
    return Posterior(covariance @ right, covariance, extra)


def fit_found(linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize) -> Posterior:
    """Return the estimates with all effects found, as a mixture over their prior sizes.

    Where readings do not determine an effect, as between mountings, u follows from the prior, of which each
    size (`evidence.SIZES`) has its posterior probability.
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
    """Return mean and covariance of amplitudes over the prior sizes; `precision` (m, m) is without a prior."""
    log_weights, means, spreads = zip(
        *(
            _of_sizes(precision, right, parts, sizes)
            for sizes in product(*_plausible_sizes(precision, right, parts))
        ),
        strict=True,
    )
    weight = special.softmax(log_weights)
    mean = weight @ np.array(means)
    apart = np.array(means) - mean
    return mean, np.einsum("s,sij->ij", weight, np.array(spreads)) + (apart.T * weight) @ apart


def _plausible_sizes(precision: Floats, right: Floats, parts: Sequence[slice]) -> list[tuple[int, ...]]:
    """Return, for each part, the indices of the prior sizes over which to average.

    Of many parts, only the `MOST_EFFECTS` least certain have all indices, each other its likeliest.
    """
    every = tuple(range(len(SIZES)))
    if len(parts) <= MOST_EFFECTS:
        return [every] * len(parts)
    likeliest = [len(SIZES) - 1] * len(parts)
    surety = np.empty(len(parts))
    for number in range(len(parts)):
        before, after = likeliest[:number], likeliest[number + 1 :]
        logs = np.array([_of_sizes(precision, right, parts, (*before, k, *after))[0] for k in every])
        likeliest[number] = int(np.argmax(logs))
        surety[number] = 1.0 / np.sum(np.exp(logs - logs.max()))
    open_parts = set(np.argsort(surety)[:MOST_EFFECTS].tolist())
    return [every if number in open_parts else (size,) for number, size in enumerate(likeliest)]


def _of_sizes(
    precision: Floats, right: Floats, parts: Sequence[slice], sizes: Sequence[int]
) -> tuple[float, Floats, Floats]:
    """Return ln of the probability of the prior `sizes`, and mean and covariance of the amplitudes for them."""
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
    """Return normal matrix and right-hand side of a fit, in which the columns `effects` (N, m) have no prior."""
    mine = slice(None) if rows is None else rows
    columns = np.column_stack([linear.design(effects), linear.response])[mine]
    white = whiten_rows(linear, noise, columns, rows)
    normal = white[:, :-1].T @ white[:, :-1]
    first, random = linear.fixed.shape[1], linear.random.shape[1]
    normal[range(first, first + random), range(first, first + random)] += 1.0
    return normal, white[:, :-1].T @ white[:, -1]


def _inverse(normal: Floats) -> Floats:
    """Return the inverse of a positive matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale))


def whiten_rows(linear: LinearSystem, noise: NoiseSize, columns: Floats, rows: Mask | None = None) -> Floats:
    """Return the columns of all rows, or those in a mask of whole settings, as independent unit noise."""
    chosen = slice(None) if rows is None else rows
    relative, oriented = linear.relative[chosen][:, None], linear.setting[chosen] >= 0
    white = columns / (noise.reading * relative)
    slope = (linear.slope[chosen][:, None] / relative)[oriented].reshape(-1, 3)
    settings = white[oriented].reshape(-1, 3, white.shape[1])
    white[oriented] = without_setting(settings, slope, noise.setting_rad / noise.reading).reshape(
        -1, white.shape[1]
    )
    return white


ADDED: Final = ("warm_up", "bias_drift", "thermal_bias", "turn_on_shift")
"""Effects that add to the signals independently of the acceleration."""


def common_volts(naming: Naming, fitted: Posterior, linear: LinearSystem) -> Iterator[str]:
    """Yield a sentence for each effect whose sizes in the three channels, in volts, agree within u."""
    # one prior size of each channel's column is the same part of its K_ii
    scale = np.diag(linear.block.K)
    apart = np.diff(np.eye(3), axis=0)
    for found, mine in naming.sizes():
        variant = found.variant
        if variant.family not in ADDED or len(variant.sizes) != 3 or len(variant.channels) != 3:
            continue
        volts = fitted.amplitudes[mine] * scale
        covariance = fitted.amplitude_covariance[mine, mine] * np.outer(scale, scale)
        between = apart @ volts
        chi2 = float(between @ np.linalg.solve(apart @ covariance @ apart.T, between))
        # three insignificant sizes are always equal
        each = special.chdtrc(1, volts**2 / np.diag(covariance))
        if np.all(each < HARDLY_EVER) and special.chdtrc(2, chi2) > OFTEN:
            yield (
                f"{variant.family} is the same voltage in all three channels within its u: that points at what "
                "they share (the voltmeters' zero, the supply, the wiring), not at three accelerometers; a shorted "
                "input in each pass tells"
            )


@dataclass(frozen=True)
class KnownTogether:
    """The sum or difference of a parameter's values in two channels or mountings, with its u.

    `of` are the two channels or mountings in words. `value` and `u` are in `unit`, the unit of the catalogue.
    """

    parameter: str
    combination: Literal["sum", "difference"]
    of: tuple[str, str]
    value: float
    u: float
    unit: str


FAR_BETTER: Final = 0.25
"""A sum or difference of two values is stated if its u is at most this fraction of either's u."""


def known_together(
    candidates: Candidates, variant: Variant, value: Floats, covariance: Floats
) -> tuple[KnownTogether, ...]:
    """Return the sums and differences of two sizes of `variant` that are far better known than either.

    `value` (p,) and `covariance` (p, p) are in plausible sizes. Example: third mounting angles of two
    installations, whose difference is a rotation of the axes.
    """
    kinds = [candidates.kinds[column] for column in variant.sizes]
    parameters = {parameter.name: parameter for parameter in CATALOGUE[variant.family].parameters}
    found = []
    for i, j in itertools.combinations(range(len(kinds)), 2):
        if kinds[i].parameter != kinds[j].parameter:
            continue
        sign = -1.0 if covariance[i, j] > 0.0 else 1.0
        u = np.sqrt(max(covariance[i, i] + covariance[j, j] + 2.0 * sign * covariance[i, j], 0.0))
        if u > FAR_BETTER * np.sqrt(min(covariance[i, i], covariance[j, j])):
            continue
        parameter = parameters[kinds[i].parameter]
        size = candidates.scale[variant.columns[i]] / parameter.si_per_unit
        places = (_place(kinds[i]), _place(kinds[j]))
        what: Literal["sum", "difference"] = "sum" if sign > 0 else "difference"
        both = float((value[i] + sign * value[j]) * size)
        found.append(KnownTogether(parameter.name, what, places, both, float(u * size), parameter.unit))
    return tuple(found)


def _place(kind: Column) -> str:
    channel = "" if kind.channel is None else CHANNELS[kind.channel]
    mounts = f"installation {'+'.join(kind.mounts)}" if kind.mounts else ""
    return " in ".join(filter(None, (channel, mounts)))


def applied_of(
    candidates: Candidates,
    variant: Variant,
    value: Floats,
    u: Floats,
    either_of: tuple[str, ...] = (),
    effect: Effect | None = None,
) -> tuple[AppliedEffect, ...]:
    """Return an effect with its estimated values in SI, one entry for each set of mountings.

    `value` and `u` (p,) are in plausible sizes; `either_of` names the effect and its ties; `effect` is of the
    catalogue unless given.
    """
    effect = effect or CATALOGUE[variant.family]
    channels = tuple(CHANNELS[c] for c in variant.channels)
    kinds = [candidates.kinds[column] for column in variant.sizes]
    applied = []
    for mounts in dict.fromkeys(kind.mounts for kind in kinds):
        values: dict[str, Floats] = {name: np.asarray(size) for name, size in variant.shape}
        sizes: dict[str, Floats] = {}
        for place, (column, kind) in enumerate(zip(variant.sizes, kinds, strict=True)):
            if kind.mounts != mounts:
                continue
            at = () if kind.channel is None else kind.channel
            for numbers, number in ((values, value[place]), (sizes, u[place])):
                numbers.setdefault(kind.parameter, np.zeros(() if kind.channel is None else 3))
                numbers[kind.parameter][at] = number * candidates.scale[column]
        applied.append(AppliedEffect(effect, values, channels, sizes, mounts, either_of))
    return tuple(applied)
