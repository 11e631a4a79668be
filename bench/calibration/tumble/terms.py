"""The terms of an accelerometer's output, and which of them the orientations of a tumble tell apart.

E/K1 = K0 + a_i + Ki_j a_j + Ki_k a_k + K2 a_i^2 + K3 a_i^3 + Koq a_i |a_i| + ..., i the input axis, j and k the
next two in x, y, z, x (IEEE Std 1293-2018; the forms are those of the effects of the model).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.model.conditions import Conditions
from bench.model.effects import CATALOGUE, Parameter, Seen
from bench.model.geometry import HIDDEN, Block

LINEAR: Final = ("K1", "Ki_j", "Ki_k", "K0")
"""What every tumble has: scale factor, the two cross-axis terms, bias."""

HOMES: Final = {
    "K2": "quadratic_nonlinearity",
    "K3": "cubic_nonlinearity",
    "Koq": "odd_quadratic_nonlinearity",
    "Kip": "cross_coupling",
    "Kio": "cross_coupling",
    "Kpo": "cross_coupling",
    "Kpp": "cross_quadratic",
    "Koo": "cross_quadratic",
}
"""The nonlinear terms, in the order in which they are asked for, with the effect that each is of."""

DEFAULT: Final = ("K2", "K3", "Koq")

SHOWN: Final = 1e-3
"""A share of one term in another below this is rounding and errors of the angles."""


def parameter_of(term: str) -> Parameter:
    """Return the parameter of an effect that a nonlinear term is."""
    return next(p for p in CATALOGUE[HOMES[term]].parameters if p.name == term)


def columns(force: Floats, channel: int, terms: Sequence[str], conditions: Conditions) -> Floats:
    """Return what E/K1 of a channel is linear in at specific forces (n, 3), g: `LINEAR`, then terms."""
    i, j, k = channel, (channel + 1) % 3, (channel + 2) % 3
    linear = [force[:, i], force[:, j], force[:, k], np.ones(len(force))]
    return np.column_stack([*linear, *(_nonlinear(term, force, conditions)[:, channel] for term in terms)])


def _nonlinear(term: str, force: Floats, conditions: Conditions) -> Floats:
    """Return a term of size 1 in all channels, (n, 3), by the effect that the simulation and the fit have."""
    effect = CATALOGUE[HOMES[term]]
    sizes = {p.name: np.full(3, float(p.name == term)) for p in effect.parameters}
    return effect.addition(sizes, Seen(force, conditions, Block(np.eye(3), np.zeros(3))))


@dataclass(frozen=True)
class Separable:
    """What a channel's orientations tell of the terms asked for.

    `rank` of `asked` columns; `kept` are estimated. Each of `inseparable` shows as these parts of kept terms and is
    not estimated: what is estimated of them contains so much of it. Empty parts: no reading shows it at all.
    """

    channel: str
    asked: tuple[str, ...]
    kept: tuple[str, ...]
    inseparable: dict[str, dict[str, float]]

    @property
    def rank(self) -> int:
        """How many of the terms asked for the orientations determine."""
        return len(self.kept)

    def part_in(self, name: str) -> dict[str, float]:
        """Return the terms that stand in an estimate beside its own, with their shares."""
        return {term: parts[name] for term, parts in self.inseparable.items() if name in parts}

    def sentence(self) -> str:
        """Say how many terms are determined, and what cannot be separated."""
        counted = f"channel {self.channel}: {self.rank} of {len(self.asked)} terms are determined"
        told = []
        for term, parts in self.inseparable.items():
            if not parts:
                told.append(f"{term} shows in no reading")
            else:
                shares = " and ".join(f"{share:+.3g} {name}" for name, share in parts.items())
                told.append(f"{term} cannot be separated: 1 of it looks like {shares}")
        return "; ".join([counted, *told])


def separable(force: Floats, channel: int, terms: Sequence[str], conditions: Conditions) -> Separable:
    """Judge which of `LINEAR` and the terms orientations determine, those named first before those named later.

    `force` (n, 3) in g at the nominal geometry. A term counts as determined where the part of it that those before
    it do not make up is more than `HIDDEN` of it.
    """
    asked = (*LINEAR, *terms)
    whole = columns(force, channel, terms, conditions)
    kept: list[int] = []
    lost: dict[str, dict[str, float]] = {}
    for at, name in enumerate(asked):
        column, before = whole[:, at], whole[:, kept]
        size = float(np.linalg.norm(column))
        share, *_ = np.linalg.lstsq(before, column, rcond=None) if kept else (np.zeros(0),)
        left = float(np.linalg.norm(column - before @ share))
        if size <= HIDDEN * np.sqrt(len(force)):
            lost[name] = {}
        elif left > HIDDEN * size:
            kept.append(at)
        else:
            parts = zip((asked[k] for k in kept), share.tolist(), strict=True)
            lost[name] = {part: value for part, value in parts if abs(value) > SHOWN}
    return Separable(CHANNELS[channel], asked, tuple(asked[k] for k in kept), lost)
