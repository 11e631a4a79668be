"""A cable that winds up as the head turns, and pulls at the block."""

from __future__ import annotations

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.model.effects.base import Parameter, Seen, StandEffect, Values
from bench.model.geometry import STAND_ANGLES


class CablePull(StandEffect):
    """An addition to alpha3 that grows with the angle of the head."""

    name = "cable_pull"
    parameters = (Parameter("per_turn", "arcsec", ARCSEC, 20 * ARCSEC, per_channel=False),)
    sentence = "a cable pulls at the block as the head turns"
    shown_by = "turning beyond 360 deg; routing the cable differently"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the turn in the column of the mounting error, rad, shape (n, 5)."""
        addition = np.zeros_like(seen.signal)
        turns = seen.conditions.angle_rad / (2 * np.pi)
        addition[:, STAND_ANGLES.index("mounting_error")] = values["per_turn"] * turns
        return addition
