"""How the head came to each setting, for effects that depend on its turns: hysteresis, the torque of a cable.

The way between two settings is the head's shortest turn; where the head arrives from the other side, it
turns past the setting first. Angles are those on the scale.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.model.conditions import Conditions
from bench.model.geometry import within_half_turn

PAST_RAD: Final = np.radians(5.0)
"""How far the head turns past a setting to come to it from the other side."""

SAME_RAD: Final = 1e-3
"""Settings closer than this are the same: the head was not turned."""


class HeadPath(NamedTuple):
    """How the head came to each of m settings, rad, shape (m,): from `start` to `turn` to `end`.

    `rows` are their places among the conditions, `sits` (m, 3, 3) how the block sits (`block_from_platform`);
    `direction` is +1 or -1, 0 where not known; `begins` where the block was mounted just before.
    """

    rows: Ints
    sits: Floats
    start: Floats
    turn: Floats
    end: Floats
    direction: Floats
    begins: Mask


def head_path(conditions: Conditions) -> HeadPath:
    """Return the path to the settings among the conditions: rows with an angle, in a known installation.

    After a mounting the head comes from just before the setting. A direction that is not known is that of
    the turn; without a turn it is the one before. Raises `ValueError` when the conditions do not say how the
    block sits: the forward model says it to an effect that `needs_path`.
    """
    if conditions.turns is None:
        raise ValueError("the path of the head needs conditions with the installations' turns")
    known = np.isfinite(conditions.turns[:, 0, 0])[conditions.mount] & np.isfinite(conditions.angle_rad)
    rows: Ints = np.flatnonzero(known)
    mount, end, direction = conditions.mount[rows], conditions.angle_rad[rows], conditions.direction[rows]
    begins = np.concatenate([np.ones(min(len(rows), 1), dtype=bool), mount[1:] != mount[:-1]])
    change = within_half_turn(np.diff(end, prepend=end[:1]))
    change[begins] = 0.0
    moved = np.where(np.abs(change) > SAME_RAD, np.sign(change), 0.0)
    arrived = np.where(direction != 0, direction, moved)
    last = np.maximum.accumulate(np.where((arrived != 0) | begins, np.arange(len(arrived)), 0))
    arrived = arrived[last]
    before = np.where(begins, 0.0, np.roll(arrived, 1))
    straight = np.where(moved != 0, moved == arrived, arrived == before)
    start = np.where(begins, end - arrived * PAST_RAD, end - change)
    turn = np.where(straight | begins, start, end - arrived * PAST_RAD)
    return HeadPath(rows, conditions.turns[mount], start, turn, end, arrived, begins)
