"""Joint estimate of coefficients and effects found, and parts of these that the readings do not determine.

These open parts are other shapes, other channels and starting states. The u of the coefficients includes them, and
a model file states them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Final, Literal, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.calibration.noise import without_setting
from bench.diagnosis.candidates import Candidates, Column, Variant, plausible_columns
from bench.diagnosis.evidence import KNOWN_SIZE, LOG_SIZE_WEIGHTS, SIZES, Data, Search, Whitened
from bench.diagnosis.levels import BY_CHANCE, CLEARLY_LARGER, HARDLY_EVER, NEGLIGIBLE, OFTEN, UNSEEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import MOST_EFFECTS, Naming, Scored
from bench.model.effects import CATALOGUE, AppliedEffect, Effect
from bench.model.effects.base import InPart, in_part
from bench.model.effects.voltmeter import NORMAL_V


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

    The order is: changes of the 12 coefficients of each block; amplitudes of `LinearSystem.random`, in prior
    standard deviations; amplitudes of the `effects` columns found, in plausible sizes.
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
        """Return rho of the amplitudes in a slice, and its p-value (chi-square distribution).

        With the amplitudes b and their covariance C, rho^2 = b^T C^-1 b.
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


def posterior(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Posterior:
    """Return the estimates for a known noise.

    The amplitudes of `effects` (N, m) have normal priors of `KNOWN_SIZE` plausible sizes.
    """
    extra = effects.shape[1]
    normal, right = _normal(linear, effects, noise)
    normal[np.arange(-extra, 0), np.arange(-extra, 0)] += 1.0 / KNOWN_SIZE**2
    covariance = _inverse(normal)
    return Posterior(covariance @ right, covariance, extra)


def fit_found(linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize) -> Posterior:
    """Return the estimates with all effects found, averaged over the prior standard deviations of the amplitudes.

    Each prior (`evidence.SIZES`) has its posterior probability as weight. Where the readings do not determine
    amplitudes, such as those of single mountings, u thus follows from the prior.
    """
    columns = candidates.columns[:, list(naming.columns)]
    extra = columns.shape[1]
    normal, right = _normal(linear, columns, noise)
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
    """Return mean and covariance of amplitudes, averaged over their prior standard deviations.

    `precision` (m, m) and `right` (m,) are the information matrix and the right-hand side of the amplitudes, with
    all other unknowns eliminated, and without these priors. Each slice in `parts` has amplitudes of one prior
    standard deviation.
    """
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
    """Return, for each part, the indices of the prior standard deviations over which to average.

    If there are many parts, only the `MOST_EFFECTS` least certain ones have all indices; each other one has only
    its likeliest index.
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
    """Return ln of the probability of the priors `sizes`, and mean and covariance of the amplitudes."""
    prior = np.ones(len(right))
    for size, mine in zip(sizes, parts, strict=True):
        prior[mine] = 1.0 / SIZES[size] ** 2
    spread = _inverse(precision + np.diag(prior))
    mean = spread @ right
    log_det = np.linalg.slogdet(spread)[1] + np.sum(np.log(prior))
    return sum(LOG_SIZE_WEIGHTS[size] for size in sizes) + 0.5 * float(log_det + right @ mean), mean, spread


def _normal(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[Floats, Floats]:
    """Return normal matrix and right-hand side of a fit, in which the columns `effects` (N, m) have no prior."""
    white = whiten_rows(linear, noise, np.column_stack([linear.design(effects), linear.response]))
    normal = white[:, :-1].T @ white[:, :-1]
    first, random = linear.fixed.shape[1], linear.random.shape[1]
    normal[range(first, first + random), range(first, first + random)] += 1.0
    return normal, white[:, :-1].T @ white[:, -1]


def _inverse(normal: Floats) -> Floats:
    """Return the inverse of a positive matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale))


def whiten_rows(linear: LinearSystem, noise: NoiseSize, columns: Floats) -> Floats:
    """Return `columns` (N, m) with independent noise of variance 1."""
    relative, oriented = linear.relative[:, None], linear.setting >= 0
    white = columns / (noise.reading * relative)
    slope = (linear.slope[:, None] / relative)[oriented].reshape(-1, 3)
    settings = white[oriented].reshape(-1, 3, white.shape[1])
    white[oriented] = without_setting(settings, slope, noise.setting_rad / noise.reading).reshape(
        -1, white.shape[1]
    )
    return white


ADDED: Final = ("warm_up", "bias_drift", "thermal_bias", "turn_on_shift")
"""Effects that add to the signals independently of the acceleration."""


def common_volts(naming: Naming, fitted: Posterior, linear: LinearSystem) -> Iterator[str]:
    """Yield a sentence for each effect whose values in the three channels, as voltages, agree within u."""
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
            yield message(
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


def known_together(
    candidates: Candidates, variant: Variant, value: Floats, covariance: Floats
) -> tuple[KnownTogether, ...]:
    """Return the sums and differences of two values of `variant` that are far better known than either value.

    The u of either value is at least `CLEARLY_LARGER` squared times that of the sum or difference.
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
        if CLEARLY_LARGER**2 * u > np.sqrt(min(covariance[i, i], covariance[j, j])):
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

    `value` and `u` (p,) are in plausible sizes; `either_of` names the effects of which one is present;
    `effect`, if given, replaces the effect of the catalogue.
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


# --- parts that the readings leave open --------------------------------------------------------------

PART: Final = 0.5
"""Prior 1 sigma of the size of another shape, as a fraction of the size found."""
WIDE: Final = 1.5
"""If the ratio of two neighbours in a grid exceeds this, another shape is put between them."""

Shape = tuple[tuple[str, float], ...]


def other_shapes(effect: Effect, found: Shape) -> Iterator[Shape]:
    """Yield the shape `found` with another value of one parameter, for each parameter that has a unit.

    The values are those of the parameter's grid, values between these, and values just beyond its ends.
    """
    for place, (name, value) in enumerate(found):
        parameter = next(p for p in effect.parameters if p.name == name)
        if parameter.unit == "1":
            continue  # an order is one or the other: there is nothing between
        grid = sorted(one for one in parameter.grid if one > 0.0)
        zero = [0.0] if 0.0 in parameter.grid else []
        whole = [grid[0] / CLEARLY_LARGER, *grid, grid[-1] * CLEARLY_LARGER]
        between = [np.sqrt(a * b) for a, b in pairwise(whole) if b > WIDE * a]
        for one in (*zero, *sorted([*whole, *map(float, between)])):
            if one != value:
                yield (*found[:place], (name, one), *found[place + 1 :])


def beside(
    candidates: Candidates, naming: Naming, sized: Posterior, channels: Mapping[int, Floats] | None = None
) -> tuple[tuple[AppliedEffect, ...], ...]:
    """Return, for each effect found, effects of other shapes or in other channels that may be a part of it.

    Their values are zero. Their prior u, SI, follow from the amplitudes in `sized`; `channels` has the result of
    `channels_of`.
    """
    return tuple(
        tuple(_of(candidates, found.variant, sized.amplitudes[mine], (channels or {}).get(number)))
        for number, (found, mine) in enumerate(naming.sizes())
    )


def channels_of(whitened: Whitened, data: Data, naming: Naming) -> dict[int, Floats]:
    """Return, for the index of each named effect, the probabilities (3,) that it acts in x, y and z."""
    plausible = {}
    for number, one in enumerate(naming.found):
        if not one.variant.named:
            continue
        others = [c for i, f in enumerate(naming.found) if i != number for c in f.variant.columns]
        scored = Scored.beside(whitened, data, others)
        members = whitened.candidates.of_family(one.variant.family)
        has = np.array([[c in whitened.candidates.variants[m].channels for c in range(3)] for m in members])
        plausible[number] = np.asarray(special.softmax(scored.log_odds_of(members)) @ has)
    return plausible


def _of(
    candidates: Candidates, variant: Variant, amplitudes: Floats, plausible: Floats | None
) -> Iterator[AppliedEffect]:
    if not variant.named:
        return
    effect = CATALOGUE[variant.family]
    others = list(other_shapes(effect, variant.shape))
    # as much in all, however many there are
    part = PART * np.sqrt(_steps(effect, variant.shape) / len(others)) if others else 0.0
    for shape in others:
        of_shape = variant._replace(shape=shape)
        yield from applied_of(candidates, of_shape, 0.0 * amplitudes, part * np.abs(amplitudes))
    if plausible is not None and any(p.per_channel for p in effect.parameters):
        yield from _in_other_channels(candidates, variant, np.abs(amplitudes), plausible)
    if effect.name == "voltmeter_nonlinearity":
        # where its curve is zero is a convention: at no voltage with no slope, or at the ends of the range
        size = float(np.max(np.abs(amplitudes * candidates.scale[list(variant.sizes)])))
        yield AppliedEffect(
            CATALOGUE["voltmeter_gain"], {"gain": np.zeros(())}, u={"gain": np.asarray(size / NORMAL_V)}
        )


def _steps(effect: Effect, shape: Shape) -> int:
    """Return the number of shapes in the catalogue's grids and just beyond them, except the shape found."""
    grids = [p.grid for name, _ in shape for p in effect.parameters if p.name == name and p.unit != "1"]
    return sum(len(grid) + 1 for grid in grids)


def _in_other_channels(
    candidates: Candidates, variant: Variant, sizes: Floats, plausible: Floats
) -> Iterator[AppliedEffect]:
    """Yield the effect, in the shape found, for other channels; its u is weighted by their probability."""
    others = [c for c in range(3) if c not in variant.channels and plausible[c] > BY_CHANCE]
    share = np.array([np.sqrt(plausible[c]) if c in others else 0.0 for c in range(3)])
    for one in applied_of(candidates, variant, 0.0 * sizes, sizes):
        u = {name: np.max(of) * share for name, of in one.u.items() if np.ndim(of)}
        if others and u:
            values = {name: value for name, value in one.values.items() if name in u or name not in one.u}
            yield replace(one, values=values, channels=tuple(CHANNELS[c] for c in others), u=u)


def with_other_shapes(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> LinearSystem:
    """Return the system with further unknowns: the parts of other shapes `others`, with their prior u."""
    columns = [piece.column for piece in pieces(linear, others)]
    return linear.with_random(*columns) if columns else linear


class OpenSize(NamedTuple):
    """An amplitude of which only the prior is known, in a channel (None: common to all).

    `column` (N,) is the change of the rows by one prior u.
    """

    applied: AppliedEffect
    parameter: str
    channel: int | None
    column: Floats


def pieces(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> Iterator[OpenSize]:
    """Yield every amplitude of the effects `others` that has a prior u and changes any of these rows."""
    for applied in others:
        shape = tuple(
            (p.name, float(applied.values[p.name])) for p in applied.effect.parameters if p.is_shape
        )
        for name, u in applied.u.items():
            parameter = next(p for p in applied.effect.parameters if p.name == name)
            of = plausible_columns(linear, applied.effect, parameter, shape, applied.installations)
            for channel, column in of.items():
                size = float(u[() if channel is None else channel]) / parameter.plausible
                if size > 0.0 and np.any(column):
                    yield OpenSize(applied, name, channel, column * size)


def sizes_alone(
    linear: LinearSystem, others: tuple[AppliedEffect, ...], first: int
) -> Iterator[AppliedEffect]:
    """Yield each amplitude of `others` that has a prior u as a part (`InPart`), numbered from `first`.

    A fit would estimate the other parameters of these effects too, although the effects found lack them.
    """
    for number, piece in enumerate(pieces(linear, others), first):
        yield in_part(piece.applied.effect.name, number, tuple(_applied([piece], np.ones(1))), 0.0, 1.0)


def left_open(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    others: Sequence[tuple[AppliedEffect, ...]],
    fitted: Posterior,
    noise: NoiseSize,
) -> tuple[AppliedEffect, ...]:
    """Return the parts (`InPart`) of the effects found that the readings leave uncertain, for a model file.

    `others` are the possible parts of each effect (`beside`). In `fitted`, they follow the random columns of
    `linear`.
    """
    start = linear.fixed.shape[1] + linear.random.shape[1]
    first = len(fitted.mean) - fitted.effects
    found: list[AppliedEffect] = []
    for (one, mine), of_find in zip(naming.sizes(), others, strict=True):
        rest = list(pieces(linear, of_find))
        places = np.arange(start, start + len(rest))
        start += len(rest)
        if not rest:
            continue
        own = np.arange(first + mine.start, first + mine.stop)
        follows = _follows(fitted.covariance, own, places)
        shown = np.column_stack([piece.column for piece in rest])
        shown = shown + candidates.columns[:, list(one.variant.sizes)] @ follows
        directions = _directions(fitted.covariance[np.ix_(places, places)], shown / noise.reading)
        sizes, *_ = np.linalg.lstsq(directions, fitted.mean[places], rcond=None)
        for direction, size in zip(directions.T, sizes, strict=True):
            change = follows @ direction
            own_part = applied_of(candidates, one.variant, change, np.zeros_like(change))
            parts = (*(replace(a, u={}) for a in own_part), *_applied(rest, direction))
            found.append(in_part(one.variant.family, _next(found, one.variant), parts, float(size), 1.0))
    return tuple(found)


def _next(parts: Sequence[AppliedEffect], variant: Variant) -> int:
    """Return the number of a further part of the family of `variant`: 1 more than it has in `parts`."""
    own = (one.effect for one in parts if isinstance(one.effect, InPart))
    return 1 + sum(effect.of == variant.family for effect in own)


def starting_states(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    sized: Posterior,
    begun: Sequence[AppliedEffect] = (),
) -> tuple[AppliedEffect, ...]:
    """Return the starting state of each mounting and channel as a part (`InPart`) of the effect found.

    The prior u follows from the amplitude in `sized`. The value is zero unless equal approaches of the head
    give equal states (`Effect.start_repeats`). The parts are numbered after the parts `begun`.
    """
    states: list[AppliedEffect] = []
    for found, mine in naming.sizes():
        variant = found.variant
        if not variant.starts:
            continue
        size = sized.amplitudes[mine]
        effect = CATALOGUE[variant.family]
        start = next(p for p in effect.parameters if p.start_of)
        spread = effect.start_spread(linear.conditions)
        (whole,) = applied_of(candidates, variant, size, 0.0 * size)
        of_size = whole.values[start.start_of]
        values = {name: value for name, value in whole.values.items() if name != start.start_of}
        for place, column in enumerate(variant.columns[len(variant.sizes) :], mine.stop):
            kind = candidates.kinds[column]
            assert kind.channel is not None  # noqa: S101 - a state has a channel
            own = np.where(np.arange(3) == kind.channel, of_size * spread, 0.0)
            estimate = sized.amplitudes[place] * candidates.scale[column] / own[kind.channel]
            part = replace(
                whole,
                values=values | {start.name: own},
                channels=(CHANNELS[kind.channel],),
                u={},
                installations=kind.mounts,
            )
            number = _next([*begun, *states], variant)
            value = float(np.clip(estimate, -2.0, 2.0)) if effect.start_repeats else 0.0
            states.append(in_part(variant.family, number, (part,), value, 1.0))
    return tuple(states)


def _follows(covariance: Floats, own: Floats, places: Floats) -> Floats:
    """Return the coefficients (own, others) of a regression of the amplitudes found on the open ones."""
    of_others = covariance[np.ix_(places, places)]
    return np.asarray(np.linalg.lstsq(of_others, covariance[np.ix_(places, own)], rcond=NEGLIGIBLE)[0].T)


def _directions(covariance: Floats, shown: Floats) -> Floats:
    """Return a square root (m, k) of a covariance, by decreasing change of the readings.

    `shown` (N, m) is the change by each amplitude, in units of noise; negligible columns are left out.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, sizes, turned = np.linalg.svd(shown @ root, full_matrices=False)
    return np.asarray((root @ turned.T)[:, sizes > UNSEEN])


def _applied(rest: Sequence[OpenSize], sizes: Floats) -> Iterator[AppliedEffect]:
    """Yield the effects of other shapes with amplitudes `sizes`, each a multiple of its prior u."""
    by_effect: dict[int, tuple[AppliedEffect, dict[str, Floats]]] = {}
    for piece, size in zip(rest, sizes, strict=True):
        _, values = by_effect.setdefault(id(piece.applied), (piece.applied, {}))
        u = np.asarray(piece.applied.u[piece.parameter], dtype=np.float64)
        at = () if piece.channel is None else piece.channel
        values.setdefault(piece.parameter, np.zeros_like(u))[at] = size * u[at]
    for applied, values in by_effect.values():
        shape = {p.name: applied.values[p.name] for p in applied.effect.parameters if p.is_shape}
        yield AppliedEffect(
            applied.effect, shape | values, applied.channels, installations=applied.installations
        )
