"""Effects that readings could never show, and the separation of two explanations of readings."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.diagnosis.candidates import ROUND, Candidates, Variant, plausible_columns
from bench.diagnosis.evidence import KNOWN_SIZE, Search, Threshold, Whitened
from bench.diagnosis.levels import NEGLIGIBLE
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.noise_grid import make_whitener
from bench.diagnosis.posterior import NoiseSize
from bench.model.effects import CATALOGUE, AppliedEffect, Parameter
from bench.readings.table import VERIFICATION

BEYOND_BELIEF: Final = 30.0
"""An effect that must exceed this many plausible sizes to be found counts as hidden."""


def detectable(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, float]:
    """Return for each effect the size, in plausible sizes, that is found in half of all runs (infinite: never).

    The size belongs to the form of the effect that shows best.
    """
    variants = whitened.candidates.variants
    square = dict.fromkeys(CATALOGUE, 0.0)
    for group in Search.beside(whitened, ()).groups:
        largest = group.values[ratio].max(axis=1)
        for number, seen in zip(group.members.tolist(), largest.tolist(), strict=True):
            if variants[number].named:
                square[variants[number].family] = max(square[variants[number].family], seen)
    half = half_power(whitened, threshold)
    return {name: half / seen**0.5 if seen > NEGLIGIBLE else float("inf") for name, seen in square.items()}


def half_power(whitened: Whitened, threshold: Threshold) -> float:
    """Return the size (rho, units of noise) at which half of all runs find an effect of one parameter.

    At this size ln of the evidence, about rho^2/2 less a cost, equals the threshold. The cost follows from the
    numbers of parameters, forms and families.
    """
    looks = np.log(len(whitened.candidates.families)) + 1.5
    return float(np.sqrt(2.0 * max(threshold.value + looks + 2.0, 1.0)))


@dataclass(frozen=True)
class Smallest:
    """The size that is found in half of all runs, whatever direction it has among parameters of one unit.

    `size` is their norm, in the unit of the catalogue. `part` says that only some directions show; no credible
    size shows in the others.
    """

    parameters: tuple[str, ...]
    size: float
    unit: str
    part: bool = False


def smallest(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, tuple[Smallest, ...]]:
    """Return `detectable` for each effect with several sizes, as one size for each unit.

    Of its channels, mountings and shapes, those that show best count; of the directions among its parameters (such
    as the phases of a wave), the one that shows worst.
    """
    half = half_power(whitened, threshold)
    candidates = whitened.candidates
    found: dict[str, dict[str, Smallest]] = {}
    for variant in candidates.variants:
        sized = [p for p in CATALOGUE[variant.family].parameters if not p.is_shape] if variant.named else []
        for unit in dict.fromkeys(p.unit for p in sized) if len(sized) > 1 else ():
            of = {p.name: p for p in sized if p.unit == unit}
            cells: dict[object, dict[str, int]] = {}
            for column in variant.columns:
                kind = candidates.kinds[column]
                if kind.parameter in of:
                    cells.setdefault((kind.channel, kind.mounts), {})[kind.parameter] = column
            known = found.setdefault(variant.family, {})
            for own in (own for own in cells.values() if len(own) == len(of)):
                one = _smallest_of(
                    whitened.among(ratio, list(own.values())), [of[name] for name in own], half
                )
                best = known.get(unit)
                if one is not None and (best is None or (one.part, one.size) < (best.part, best.size)):
                    known[unit] = one
    return {name: tuple(of_unit.values()) for name, of_unit in found.items() if of_unit}


def _smallest_of(gram: Floats, own: Sequence[Parameter], half: float) -> Smallest | None:
    scale = np.array([p.plausible / p.si_per_unit for p in own])
    shows, directions = np.linalg.eigh(gram / np.outer(scale, scale))
    # in plausible sizes, so that a direction beyond belief is one in every unit
    reach = half / np.sqrt(np.maximum(shows, 1e-300))
    beyond = reach * np.linalg.norm(directions / scale[:, None], axis=0) > BEYOND_BELIEF
    if np.all(beyond):
        return None
    names = tuple(p.name for p in own)
    return Smallest(names, float(reach[~beyond].max()), own[0].unit, bool(beyond.any()))


def hidden(
    whitened: Whitened, threshold: Threshold, ratio: int, sizes: Mapping[str, float]
) -> dict[str, tuple[str, ...]]:
    """Return the effects that these readings could never show, in the order of the catalogue.

    With each stand the parts of which that is true, none named where it is all of them: an effect whose wave
    they show in one phase and never in the other is among them. `sizes` come from `detectable`.
    """
    candidates = whitened.candidates
    seen = np.sqrt(np.maximum(whitened.square[ratio], 0.0)) * BEYOND_BELIEF / half_power(whitened, threshold)
    best: dict[tuple[str, str, str], float] = {}
    for variant in candidates.variants:
        shape = ", ".join(f"{name} {value:g}" for name, value in variant.shape)
        for column in variant.columns if variant.named else ():
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
    """One number of an effect at its plausible size: a parameter of one channel or of all, in certain mountings."""

    family: str
    parameter: str
    shape: tuple[tuple[str, float], ...]
    mounts: tuple[str, ...]
    channel: int | None


Form = tuple[EffectPart, ...]
"""A form that an effect may have, as the tuple of its parameters."""


def form_of(candidates: Candidates, variant: Variant) -> Form:
    """Return the form of a variant, so that it can be tested in other readings."""
    kinds = [candidates.kinds[place] for place in variant.columns]
    return tuple(EffectPart(variant.family, k.parameter, variant.shape, k.mounts, k.channel) for k in kinds)


def forms_of(candidates: Candidates, family: str) -> tuple[Form, ...]:
    """Return the forms that an effect may have in the readings of these candidates."""
    return tuple(form_of(candidates, v) for v in candidates.variants if v.family == family)


def forms_everywhere(family: str, mounts: tuple[str, ...] = ()) -> tuple[Form, ...]:
    """Return the forms of an effect in every channel, of each shape, in all mountings or the given ones."""
    parameters = CATALOGUE[family].parameters
    grids = [[(p.name, value) for value in p.grid] for p in parameters if p.grid]
    return tuple(
        tuple(
            EffectPart(family, p.name, shape, mounts, channel)
            for p in parameters
            if not p.grid
            for channel in ((0, 1, 2) if p.per_channel else (None,))
        )
        for shape in itertools.product(*grids)
    )


class ReadingDesign:
    """Readings, measured or planned, in which explanations are compared.

    `noise` is the size of the noise, `others` are effects that are in the model beside what is compared, each
    known no better than the readings tell.
    """

    def __init__(self, linear: LinearSystem, noise: NoiseSize, others: Sequence[Form] = ()) -> None:
        self.linear = linear
        self._noise = noise
        self._unseen: dict[EffectPart, Floats] = {}
        self._make_free([self._column(part) * KNOWN_SIZE for form in others for part in form])

    def remounted(self, families: Sequence[str], before: Sequence[str]) -> None:
        """Give each mounting that is not in `before` its own effects of single mountings, of plausible size.

        The error of one mounting says nothing about the next one; effects that last continue.
        """
        labels = [str(m) for m in self.linear.moved.mounts if m.installation != VERIFICATION]
        effects = [CATALOGUE[family] for family in families]
        of_mounts = [effect.name for effect in effects if effect.per_mount and not effect.lasts]
        new = [
            self._column(part)
            for family in of_mounts
            for label in labels
            if label not in before
            for part in forms_everywhere(family, (label,))[0]
        ]
        self._make_free([*self._known, *new])

    def _make_free(self, known: list[Floats]) -> None:
        """Project out the coefficients, and within their priors the stand's angles and the `known` columns."""
        self._known = known
        self._seen: dict[EffectPart, Floats] = {}
        rows = self.linear.with_random(*known)
        self._white = make_whitener(rows, self._noise.reading, self._noise.setting_rad)

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
        """Return the part of a form's columns (m, numbers) that free unknowns cannot take up, for plausible
        sizes.
        """
        new = [part for part in form if part not in self._seen]
        if new:
            left = self._left(np.column_stack([self._column(part) for part in new]))
            self._seen.update(zip(new, left.T, strict=True))
        return np.column_stack([self._seen[part] for part in form])

    def divergence(self, found: Sequence[AppliedEffect], rivals: Sequence[Form]) -> float:
        """Return D, the expected ln odds, of an effect with the values found against the nearest form of a
        rival.
        """
        total = np.sum([self.linear.effect_column(applied) for applied in found], axis=0)
        one = self._left(total[:, None])[:, 0]
        least = float(one @ one)
        for form in rivals:
            other = self.seen(form)
            left = one - other @ np.linalg.lstsq(other, one, rcond=1e-9)[0]
            least = min(least, float(left @ left))
        return least / 2.0

    def visible(self, forms: Sequence[Form]) -> float:
        """Return the signal-to-noise rho of an effect of plausible size in its most visible form."""
        return max((float(np.linalg.norm(self.seen(form), 2)) for form in forms), default=0.0)

    def cosine(self, one: Form, other: Form) -> float:
        """Return the cosine of the smallest angle between the visible parts of two forms; 0 if one has none."""
        first, second = _basis(self.seen(one)), _basis(self.seen(other))
        if not (first.shape[1] and second.shape[1]):
            return 0.0
        return min(1.0, float(np.linalg.norm(first.T @ second, 2)))


def _basis(columns: Floats) -> Floats:
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, size > 1e-6 * max(1.0, size[0])]
