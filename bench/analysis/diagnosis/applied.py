"""Columns of what was found, as effects with values: what goes into the forward model."""

from __future__ import annotations

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Variant
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE, AppliedEffect


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
