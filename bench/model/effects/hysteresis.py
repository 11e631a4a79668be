"""Hysteresis of an accelerometer: its output depends on the way that the specific force came.

The way between two settings is the head's shortest turn; where the head arrives from the other side, it
turns past the setting first. Angles are those on the scale and installations the nominal ones: errors of
the stand within their limits do not make a branch flip.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.model.conditions import Conditions, HeadPath, head_path
from bench.model.effects.base import BlockEffect, Parameter, Seen, Values

SLOW: Final = 0.05
"""Change of specific force with angle, g/rad, below which its sign no longer counts."""


class Hysteresis(BlockEffect):
    """A signed step (no width), or a play of the given half width; saturated it is the size with its sign."""

    name = "hysteresis"
    parameters = (
        Parameter("size", "ug", 1e-6, plausible=20e-6, per_channel=True),
        Parameter(
            "width_g", "g", 1.0, plausible=0.25, per_channel=False, grid=(0.0, 0.1, 0.25, 0.5, 0.8), default=0.0
        ),
    )  # fmt: skip
    sentence = "the output of the accelerometer depends on the side from which the acceleration came"
    shown_by = "both directions of approach"
    needs_history = True
    needs_path = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii times size times the state of the channel (-1 to 1) in volts, shape (n, 3).

        Raises `ValueError` when the conditions do not say how the block sits (`Conditions.turns`).
        """
        width_g = float(values["width_g"])
        kept = seen.conditions.memory
        if (self.name, width_g) not in kept:
            kept[self.name, width_g] = state(seen.conditions, width_g)
        return np.asarray(seen.scale * values["size"] * kept[self.name, width_g])


def state(conditions: Conditions, width_g: float) -> Floats:
    """Return how far each channel is to one side of its loop, -1 to 1, shape (n, 3); +1 after a long rise.

    Rows without an angle or in an unknown installation have 0 and do not count as settings.
    """
    path = head_path(conditions)
    result = np.zeros((len(conditions), 3))
    if len(path.rows) == 0:
        return result
    # nominal force on a channel: sine part times sin(phi) + cosine part times cos(phi)
    sine, cosine = np.moveaxis(path.sits[:, :, [0, 2]], 2, 0)
    if width_g > 0.0:
        result[path.rows] = _play(path, sine, cosine, width_g)
    else:
        end = path.end[:, None]
        rate = path.direction[:, None] * (sine * np.cos(end) - cosine * np.sin(end))
        result[path.rows] = np.tanh(rate / SLOW)
    return result


def _play(path: HeadPath, sine: Floats, cosine: Floats, width_g: float) -> Floats:
    """Return the state of a play operator of half width `width_g` at the end of each path, shape (m, 3)."""
    stops = np.concatenate(
        [_extremes(path.start, path.turn, sine, cosine), _extremes(path.turn, path.end, sine, cosine)]
    )
    first = sine * np.sin(path.start)[:, None] + cosine * np.cos(path.start)[:, None]
    low, high = stops - width_g, stops + width_g
    reached = np.empty_like(first)
    slack = first[0]
    for i, begins in enumerate(path.begins):
        if begins:
            slack = first[i]
        for k in range(len(stops)):
            slack = np.minimum(np.maximum(slack, low[k, i]), high[k, i])
        reached[i] = slack
    return np.asarray((stops[-1] - reached) / width_g)


def _extremes(start: Floats, end: Floats, sine: Floats, cosine: Floats) -> Floats:
    """Return the forces at which a turn changes their sense, and at its end, in g, shape (3, m, 3).

    Between these the force only rises or only falls, and nothing else matters to a play operator. A turn of
    half a circle and a little has two extremes at most; where it has fewer, the end stands in their place.
    """
    amplitude, phase = np.hypot(sine, cosine), np.arctan2(sine, cosine)
    sense = np.sign(end - start)[:, None]
    # in half turns from an extreme, along the sense of the turn
    first = np.ceil(sense * (start[:, None] - phase) / np.pi)
    last = np.where(sense == 0.0, -np.inf, sense * (end[:, None] - phase) / np.pi)
    at_end = amplitude * np.cos(end[:, None] - phase)
    stops = [np.where(first + k <= last, amplitude * np.cos((first + k) * np.pi), at_end) for k in (0, 1)]
    return np.stack([*stops, at_end])
