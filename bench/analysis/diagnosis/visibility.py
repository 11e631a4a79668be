"""What these readings could never show, and how large each effect would have to be to be found."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import ROUND
from bench.analysis.diagnosis.evidence import Search, Whitened
from bench.analysis.diagnosis.threshold import Threshold
from bench.base.arrays import Floats
from bench.model import CATALOGUE, Parameter

BEYOND_BELIEF: Final = 30.0
"""An effect that would have to be so many plausible sizes large to be found is hidden."""


def detectable(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, float]:
    """Return for each effect the size, in plausible sizes, that is found in half of all runs (infinite: never).

    Of the forms that an effect may have, the one that shows best.
    """
    variants = whitened.candidates.variants
    half = half_power(whitened, threshold)
    best = dict.fromkeys(CATALOGUE, 0.0)
    for group in Search.beside(whitened, ()).groups:
        largest = np.sqrt(group.values[ratio].max(axis=1))
        for number, seen in zip(group.members.tolist(), largest.tolist(), strict=True):
            if variants[number].named:
                best[variants[number].family] = max(best[variants[number].family], seen)
    return {name: half / seen if seen > NOTHING_SEEN else float("inf") for name, seen in best.items()}


@dataclass(frozen=True)
class Smallest:
    """The size that is found in half of all runs, whatever direction it has among parameters of one unit.

    `size` is their norm, in the unit of the catalogue. `part` says that it is that of the directions which show:
    another, beyond belief large, would not.
    """

    parameters: tuple[str, ...]
    size: float
    unit: str
    part: bool = False


def smallest(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, tuple[Smallest, ...]]:
    """Return for each effect with several sizes what `detectable` says of one with one, a size for each unit.

    Of channels, mountings and shapes that it may have those that show best; of the directions among its parameters
    (the phases of a wave) the one that shows worst.
    """
    half = half_power(whitened, threshold)
    best: dict[tuple[str, str], Smallest] = {}
    for variant in whitened.candidates.variants:
        sized = [p for p in CATALOGUE[variant.family].parameters if not p.is_shape] if variant.named else []
        if len(sized) < 2:
            continue
        kinds = [(whitened.candidates.kinds[column], column) for column in variant.columns]
        for unit in dict.fromkeys(p.unit for p in sized):
            of = {p.name: p for p in sized if p.unit == unit}
            for cell in {(kind.channel, kind.mounts) for kind, _ in kinds}:
                own = {
                    k.parameter: i for k, i in kinds if (k.channel, k.mounts) == cell and k.parameter in of
                }
                if len(own) < len(of):
                    continue
                gram = whitened.among(ratio, list(own.values()))
                one = _smallest_of(gram, own, of, half)
                known = best.get((variant.family, unit))
                if one is not None and (known is None or (one.part, one.size) < (known.part, known.size)):
                    best[variant.family, unit] = one
    found: dict[str, tuple[Smallest, ...]] = {}
    for (name, _), one in best.items():
        found[name] = (*found.get(name, ()), one)
    return found


def _smallest_of(
    gram: Floats, own: Collection[str], of: Mapping[str, Parameter], half: float
) -> Smallest | None:
    scale = np.array([of[name].plausible / of[name].si_per_unit for name in own])
    shows, directions = np.linalg.eigh(gram / np.outer(scale, scale))
    # in plausible sizes, so that a direction beyond belief is one in every unit
    reach = half / np.sqrt(np.maximum(shows, 1e-300))
    beyond = reach * np.linalg.norm(directions / scale[:, None], axis=0) > BEYOND_BELIEF
    if np.all(beyond):
        return None
    return Smallest(tuple(own), float(reach[~beyond].max()), next(iter(of.values())).unit, bool(beyond.any()))


NOTHING_SEEN: Final = 1e-6
"""In units of noise, for a plausible size: rounding, no signal."""


def half_power(whitened: Whitened, threshold: Threshold) -> float:
    """Return the size (rho, units of noise) of an effect of one parameter that is found in half of all runs.

    There ln of its evidence, about rho^2/2 less its price, equals the threshold; the price of one
    parameter and of the forms and families looked at is taken from their number.
    """
    candidates = whitened.candidates
    looks = np.log(len(candidates.families)) + 1.5
    return float(np.sqrt(2.0 * max(threshold.value + looks + 2.0, 1.0)))


def hidden(
    whitened: Whitened, threshold: Threshold, ratio: int, sizes: Mapping[str, float]
) -> dict[str, tuple[str, ...]]:
    """Return the effects that these readings could never show, in the order of the catalogue.

    With each stand the parts of which that is true, none named where it is all of them: an effect whose wave
    they show in one phase and never in the other is among them. `sizes` come from `detectable`.
    """
    parts = _hidden_parts(whitened, half_power(whitened, threshold), ratio)
    unseen: dict[str, tuple[str, ...]] = {}
    for name in CATALOGUE:
        if sizes[name] > BEYOND_BELIEF:
            unseen[name] = ()
        elif any(parameter.endswith(ROUND) for parameter, _ in parts.get(name, ())):
            unseen[name] = tuple(text for _, text in parts[name])
    return unseen


def _hidden_parts(whitened: Whitened, half: float, ratio: int) -> dict[str, list[tuple[str, str]]]:
    candidates = whitened.candidates
    seen = np.sqrt(np.maximum(whitened.square[ratio], 0.0))
    best: dict[tuple[str, str, str], float] = {}
    for variant in candidates.variants:
        if variant.named:
            shape = ", ".join(f"{name} {value:g}" for name, value in variant.shape)
            for column in variant.columns:
                key = (variant.family, candidates.kinds[column].parameter, shape)
                best[key] = max(best.get(key, 0.0), float(seen[column]))
    parts: dict[str, list[tuple[str, str]]] = {}
    for (family, parameter, shape), size in best.items():
        if half > BEYOND_BELIEF * size:
            parts.setdefault(family, []).append((parameter, f"{parameter} ({shape})" if shape else parameter))
    return parts
