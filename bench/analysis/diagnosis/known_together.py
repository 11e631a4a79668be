"""Sums and differences of an effect's values that the readings tell better than the values."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Column, Variant
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE

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
