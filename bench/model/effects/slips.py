"""What was moved or changed in the course of a run, between passes as at a remount: clamps, zero, meters."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.model.effects.base import HeadEffect, Parameter, Seen, StandEffect, Values, VoltmeterEffect, angle
from bench.model.effects.stand import into

MOUNTING_ANGLES: Final = ("mounting_error", "mounting_offset", "mounting_roll")


class BlockSlip(StandEffect):
    """The three mounting angles, other than in the rest of the mounting."""

    name = "block_slip"
    parameters = tuple(angle(column, 60) for column in MOUNTING_ANGLES)
    apart = (*((column,) for column in MOUNTING_ANGLES), MOUNTING_ANGLES)
    sentence = "the block slipped or was clamped anew: its mounting angles are others in some passes"
    shown_by = (
        "a mark across block and platform, looked at in each pass; a pass repeated with the clamps tightened"
    )
    per_mount = True
    per_pass = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the angles in their columns, rad, shape (n, 5)."""
        parts = [into(column, values[column], seen.signal) for column in MOUNTING_ANGLES]
        return np.asarray(np.sum(parts, axis=0))


class HeadZeroShift(HeadEffect):
    """Another zero of the head's scale: the same angle on top of what it shows."""

    name = "head_zero_shift"
    parameters = (angle("angle", 60),)
    sentence = "the zero of the head's scale was another in some passes, as after it was set anew"
    shown_by = (
        "a level on the platform at 0 deg, read in each pass; the head's reference run before each pass"
    )
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the angle in rad, shape (n,)."""
        return np.broadcast_to(values["angle"], len(seen.conditions))


PAIRS: Final = tuple((CHANNELS[i], CHANNELS[j]) for i, j in ((0, 1), (1, 2), (2, 0)))
"""Pairs of channels, in the order of the parameters of an exchange."""


class MetersExchanged(VoltmeterEffect):
    """Two meters at each other's channels: what gain and zero differ by goes to the one and from the other."""

    name = "meters_exchanged"
    parameters = tuple(
        parameter
        for one, other in PAIRS
        for parameter in (
            Parameter(f"{one}{other}_gain", "ppm", 1e-6, plausible=30e-6, per_channel=False),
            Parameter(f"{one}{other}_zero", "uV", 1e-6, plausible=100e-6, per_channel=False),
        )
    )
    apart = (
        *((f"{one}{other}_gain", f"{one}{other}_zero") for one, other in PAIRS),
        tuple(f"{one}{other}_{what}" for one, other in PAIRS[:2] for what in ("gain", "zero")),
    )
    sentence = (
        "two voltmeters were at each other's channels in some passes: their gains and zeros are exchanged"
    )
    shown_by = "the meters' serial numbers, read in each pass; a shorted and a reference input in each pass"
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return for each pair gain U + zero in V at the first channel, less as much at the other, (n, 3)."""
        added = np.zeros_like(seen.signal)
        for one, other in PAIRS:
            gain, zero = values[f"{one}{other}_gain"], values[f"{one}{other}_zero"]
            for channel, sign in ((one, 1.0), (other, -1.0)):
                column = CHANNELS.index(channel)
                added[:, column] += sign * (gain * seen.signal[:, column] + zero)
        return added
