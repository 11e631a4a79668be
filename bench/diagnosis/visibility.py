"""Effects that readings could never show, and how well readings distinguish two explanations."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.diagnosis.candidates import ROUND, Candidates, Variant, plausible_columns
from bench.diagnosis.evidence import BEYOND_BELIEF, KNOWN_SIZE, Search, Threshold, Whitened
from bench.diagnosis.levels import NEGLIGIBLE
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.noise_grid import Whitener, make_whitener
from bench.diagnosis.posterior import NoiseSize
from bench.model.effects import CATALOGUE, AppliedEffect, Parameter
from bench.readings.table import VERIFICATION


def detectable(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, float]:
    """Return the size of each effect that half of all runs find, in plausible sizes, for its best form.

    It is infinite if no size is ever found; `ratio` is the index of the noise ratio.
    """
    variants = whitened.candidates.variants
    square = dict.fromkeys(CATALOGUE, 0.0)
    for group in Search.beside(whitened, ()).groups:
        largest = group.values[ratio].max(axis=1)
        for number, seen in zip(group.members.tolist(), largest.tolist(), strict=True):
            if variants[number].named and not variants[number].starts:
                square[variants[number].family] = max(square[variants[number].family], seen)
    half = half_power(whitened, threshold.value)
    return {name: half / seen**0.5 if seen > NEGLIGIBLE else float("inf") for name, seen in square.items()}


def half_power(whitened: Whitened, threshold: float) -> float:
    """Return the signal-to-noise ratio rho at which half of all runs find an effect of one parameter.

    ln of the evidence, about rho^2/2 minus a cost of parameters, forms and families, then equals `threshold`.
    """
    looks = np.log(len(whitened.candidates.families)) + 1.5
    return float(np.sqrt(2.0 * max(threshold + looks + 2.0, 1.0)))


@dataclass(frozen=True)
class Smallest:
    """The root of the sum of squares of parameters of a `unit` that is found in half of all runs.

    If `part`, some proportions of the parameters show at no credible size.
    """

    parameters: tuple[str, ...]
    size: float
    unit: str
    part: bool = False


def smallest(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, tuple[Smallest, ...]]:
    """Return, for effects with several parameters of size, the size found in half of all runs, by unit.

    It is for the best channel, mounting and shape, and the worst proportions (such as the phase of a wave).
    """
    half = half_power(whitened, threshold.value)
    candidates = whitened.candidates
    found: dict[str, dict[str, Smallest]] = {}
    seen: set[tuple[int, ...]] = set()
    for variant in candidates.variants:
        sized = [p for p in CATALOGUE[variant.family].parameters if p.is_size] if variant.named else []
        for unit in dict.fromkeys(p.unit for p in sized) if len(sized) > 1 else ():
            of = {p.name: p for p in sized if p.unit == unit}
            cells: dict[object, dict[str, int]] = {}
            for column in variant.sizes:
                kind = candidates.kinds[column]
                if kind.parameter in of:
                    cells.setdefault((kind.channel, kind.mounts), {})[kind.parameter] = column
            known = found.setdefault(variant.family, {})
            for own in (own for own in cells.values() if len(own) == len(of)):
                columns = tuple(own.values())
                if columns in seen:
                    continue  # another variant has the same parameters in this channel
                seen.add(columns)
                one = _smallest_of(whitened.among(ratio, columns), [of[name] for name in own], half)
                best = known.get(unit)
                if one is not None and (best is None or (one.part, one.size) < (best.part, best.size)):
                    known[unit] = one
    return {name: tuple(of_unit.values()) for name, of_unit in found.items() if of_unit}


def _smallest_of(gram: Floats, own: Sequence[Parameter], half: float) -> Smallest | None:
    scale = np.array([p.plausible / p.si_per_unit for p in own])
    shows, directions = np.linalg.eigh(gram / np.outer(scale, scale))
    # in plausible sizes, so that the judgement does not depend on the unit
    reach = half / np.sqrt(np.maximum(shows, 1e-300))
    beyond = reach * np.linalg.norm(directions / scale[:, None], axis=0) > BEYOND_BELIEF
    if np.all(beyond):
        return None
    names = tuple(p.name for p in own)
    return Smallest(names, float(reach[~beyond].max()), own[0].unit, bool(beyond.any()))


def hidden(
    whitened: Whitened, threshold: Threshold, ratio: int, sizes: Mapping[str, float]
) -> dict[str, tuple[str, ...]]:
    """Return the effects that these readings could not show, each with the hidden parts; empty: wholly.

    A part is one phase of a wave. `sizes` are the result of `detectable`; `ratio` is the index of the noise
    ratio.
    """
    candidates = whitened.candidates
    seen = (
        np.sqrt(np.maximum(whitened.products.square[ratio], 0.0))
        * BEYOND_BELIEF
        / half_power(whitened, threshold.value)
    )
    best: dict[tuple[str, str, str], float] = {}
    for variant in candidates.variants:
        shape = ", ".join(f"{name} {value:g}" for name, value in variant.shape)
        for column in variant.sizes if variant.named else ():
            key = (variant.family, candidates.kinds[column].parameter, f" ({shape})" if shape else "")
            best[key] = max(best.get(key, 0.0), float(seen[column]))
    unseen: dict[str, tuple[str, ...]] = {}
    for name in CATALOGUE:
        parts = [(of, shape) for (family, of, shape), size in best.items() if family == name and size < 1.0]
        if sizes[name] > BEYOND_BELIEF:
            unseen[name] = ()
        elif any(parameter.endswith(ROUND) for parameter, _ in parts):
            unseen[name] = tuple(parameter + shape for parameter, shape in parts)
    return unseen


class EffectPart(NamedTuple):
    """One parameter at its plausible size, in a channel and mountings (None, empty: all), for a `shape` in SI."""

    family: str
    parameter: str
    shape: tuple[tuple[str, float], ...]
    mounts: tuple[str, ...]
    channel: int | None


Form = tuple[EffectPart, ...]
"""A form that an effect may have, as the tuple of its parameters."""


def form_of(candidates: Candidates, variant: Variant) -> Form:
    """Return a variant as a form, which does not depend on these readings and can be tested in others."""
    kinds = [candidates.kinds[place] for place in variant.sizes]
    return tuple(EffectPart(variant.family, k.parameter, variant.shape, k.mounts, k.channel) for k in kinds)


def forms_of(candidates: Candidates, family: str) -> tuple[Form, ...]:
    """Return every form that a family has among the candidates."""
    return tuple(form_of(candidates, v) for v in candidates.variants if v.family == family)


def forms_everywhere(family: str, mounts: tuple[str, ...] = ()) -> tuple[Form, ...]:
    """Return a form for each shape of an effect, in all channels and in `mounts` (empty: all)."""
    parameters = CATALOGUE[family].parameters
    grids = [[(p.name, value) for value in p.grid] for p in parameters if p.grid]
    return tuple(
        tuple(
            EffectPart(family, p.name, shape, mounts, channel)
            for p in parameters
            if p.is_size
            for channel in ((0, 1, 2) if p.per_channel else (None,))
        )
        for shape in itertools.product(*grids)
    )


class ReadingDesign:
    """Readings, measured or planned, in which two explanations are compared beside `others`, of wide prior."""

    def __init__(self, linear: LinearSystem, noise: NoiseSize, others: Sequence[Form] = ()) -> None:
        self.linear = linear
        self._noise = noise
        self._unseen: dict[EffectPart, Floats] = {}
        self._seen: dict[EffectPart, Floats] = {}
        self._known = [self._column(part) * KNOWN_SIZE for form in others for part in form]

    def remounted(self, families: Sequence[str], before: Sequence[str]) -> None:
        """Add, for each mounting not in `before`, an unknown error of plausible size of `families`.

        Only effects that differ between mountings count. Call it before `seen`.
        """
        labels = [str(m) for m in self.linear.moved.mounts if m.installation != VERIFICATION]
        effects = [CATALOGUE[family] for family in families]
        of_mounts = [effect.name for effect in effects if effect.per_mount and not effect.lasts]
        self._known += [
            self._column(part)
            for family in of_mounts
            for label in labels
            if label not in before
            for part in forms_everywhere(family, (label,))[0]
        ]

    @cached_property
    def _white(self) -> Whitener:
        """The map that projects out the coefficients and, up to their priors, stand angles and known columns."""
        rows = self.linear.with_random(*self._known)
        return make_whitener(rows, self._noise.reading, self._noise.setting_rad)

    def _left(self, columns: Floats) -> Floats:
        """Return the whitened columns (N, m) with the free columns projected out."""
        return self._white @ (columns / self._noise.reading)

    def _column(self, part: EffectPart) -> Floats:
        if part not in self._unseen:
            effect = CATALOGUE[part.family]
            parameter = next(p for p in effect.parameters if p.name == part.parameter)
            columns = plausible_columns(self.linear, effect, parameter, part.shape, part.mounts)
            for channel, column in columns.items():
                self._unseen[part._replace(channel=channel)] = column
        return self._unseen[part]

    def seen(self, form: Form) -> Floats:
        """Return the changes by each part of a form in units of the noise, free unknowns projected out."""
        new = [part for part in dict.fromkeys(form) if part not in self._seen]
        if new:
            left = self._left(np.column_stack([self._column(part) for part in new]))
            self._seen.update(zip(new, left.T, strict=True))
        return np.array([self._seen[part] for part in form]).T

    def divergence(self, found: Sequence[AppliedEffect], rivals: Sequence[Form]) -> float:
        """Return the divergence D of an effect `found`, expected ln of odds, from the most similar rival."""
        total = np.sum([self.linear.effect_column(applied) for applied in found], axis=0)
        one = self._left(total[:, None])[:, 0]
        least = float(one @ one)
        self.seen(tuple(part for form in rivals for part in form))
        for form in rivals:
            other = self.seen(form)
            left = one - other @ np.linalg.lstsq(other, one, rcond=1e-9)[0]
            least = min(least, float(left @ left))
        return least / 2.0

    def visible(self, *forms: Form) -> float:
        """Return the norm of a plausible size, in noise, that free unknowns leave, in the best of `forms`."""
        return max(float(np.linalg.norm(self.seen(form), 2)) for form in forms)
