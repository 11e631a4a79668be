"""Hysteresis of an accelerometer: its output depends on the way that the specific force came.

The way between two settings is the head's shortest turn; where the head arrives from the other side, it
turns past the setting first. Angles are those on the scale and installations the nominal ones: errors of
the stand within their limits do not make a branch flip.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats
from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects.base import Effect, Parameter, Stage, Subsystem

PAST_RAD: Final = np.radians(5.0)
"""How far the head turns past a setting to come to it from the other side."""

SAME_RAD: Final = 1e-3
"""Settings closer than this are the same: the head was not turned."""

SLOW: Final = 0.05
"""Change of specific force with angle, g/rad, below which its sign no longer counts."""


class Path(NamedTuple):
    """How the head came to each of m settings, rad, shape (m,): from `start` to `turn` to `end`.

    `direction` is +1 or -1, 0 where not known; `begins` where the block was mounted just before.
    """

    start: Floats
    turn: Floats
    end: Floats
    direction: Floats
    begins: NDArray[np.bool_]


class Hysteresis(Effect):
    """A signed step (no width), or a play of the given half width; saturated it is the size with its sign."""

    name = "hysteresis"
    stage = Stage.BLOCK_OUTPUT
    subsystem = Subsystem.BLOCK
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

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return K_ii times size times the state of the channel (-1 to 1) in volts, shape (n, 3).

        Raises `ValueError` when the conditions do not say how the block sits (`Conditions.turns`).
        """
        return np.diag(block.K) * values["size"] * state(conditions, float(values["width_g"]))


def state(conditions: Conditions, width_g: float) -> Floats:
    """Return how far each channel is to one side of its loop, -1 to 1, shape (n, 3); +1 after a long rise.

    Rows without an angle or in an unknown installation have 0 and do not count as settings.
    """
    if conditions.turns is None:
        raise ValueError(
            "hysteresis follows the path of the head: the conditions need the installations' turns"
        )
    result = np.zeros((len(conditions), 3))
    sits = np.isfinite(conditions.turns[:, 0, 0])[conditions.mount]
    rows = np.flatnonzero(sits & np.isfinite(conditions.angle_rad))
    if len(rows) == 0:
        return result
    path = path_of(conditions.mount[rows], conditions.angle_rad[rows], conditions.direction[rows])
    # nominal force on a channel: sine part times sin(phi) + cosine part times cos(phi)
    sine, cosine = np.moveaxis(conditions.turns[conditions.mount[rows]][:, :, [0, 2]], 2, 0)
    if width_g > 0.0:
        result[rows] = _play(path, sine, cosine, width_g)
    else:
        end = path.end[:, None]
        rate = path.direction[:, None] * (sine * np.cos(end) - cosine * np.sin(end))
        result[rows] = np.tanh(rate / SLOW)
    return result


def path_of(mount: NDArray[np.int64], angle_rad: Floats, direction: NDArray[np.int64]) -> Path:
    """Return the path to the settings (m,), in the order of measurement.

    After a mounting the head comes from just before the setting. A direction that is not known is that of
    the turn; without a turn it is the one before.
    """
    begins = np.concatenate([[True], mount[1:] != mount[:-1]])
    change = np.diff(angle_rad, prepend=angle_rad[:1])
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    change[begins] = 0.0
    moved = np.where(np.abs(change) > SAME_RAD, np.sign(change), 0.0)
    arrived = np.where(direction != 0, direction, moved)
    last = np.maximum.accumulate(np.where((arrived != 0) | begins, np.arange(len(arrived)), 0))
    arrived = arrived[last]
    before = np.where(begins, 0.0, np.roll(arrived, 1))
    straight = np.where(moved != 0, moved == arrived, arrived == before)
    start = np.where(begins, angle_rad - arrived * PAST_RAD, angle_rad - change)
    turn = np.where(straight | begins, start, angle_rad - arrived * PAST_RAD)
    return Path(start, turn, angle_rad, arrived, begins)


def _play(path: Path, sine: Floats, cosine: Floats, width_g: float) -> Floats:
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
    played: Floats = (stops[-1] - reached) / width_g
    return played


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
