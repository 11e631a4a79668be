"""What moves in the stand while it is used: with the head's turn, at a remount, in the course of the day."""

from __future__ import annotations

import numpy as np

from bench.base.arrays import HOUR, Floats
from bench.model.effects.base import Parameter, Seen, StandEffect, Values, angle, wave
from bench.model.effects.stand import ConstantAngle, into


class AxisWobble(StandEffect):
    """The head's axis tilts as the head goes round: w_c cos(h phi) + w_s sin(h phi), h its harmonic."""

    name = "axis_wobble"
    parameters = (
        angle("cosine", 5),
        angle("sine", 5),
        Parameter("harmonic", "1", 1.0, plausible=1.0, per_channel=False, grid=(1.0, 2.0), default=1.0),
    )
    sentence = "the head's axis wobbles: it tilts out of the plane of rotation as the head goes round"
    shown_by = "a remount turned by 90 deg (twice a turn) or 180 deg (once a turn); a mirror on the shaft"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the tilt in the column of the axis tilt, rad, shape (n, 5)."""
        phase = float(values["harmonic"]) * seen.conditions.angle_rad
        return into("axis_tilt", wave(values, phase), seen.signal)


class BracketTilt(ConstantAngle):
    """A constant tilt out of the plane of rotation, which changes at a remount: alpha1 of that mounting alone."""

    name = "bracket_tilt"
    column = "axis_tilt"
    parameters = (angle("angle", 30),)
    sentence = "what carries the block tilted by the same at all angles when the block was mounted"
    shown_by = "a return to installation 1 at the end; a remount turned by 180 deg"


class FoundationTilt(StandEffect):
    """The foundation tilts with a period P, c cos(2 pi t / P) + s sin(2 pi t / P), about the shaft and across."""

    name = "foundation_tilt"
    parameters = (
        angle("cosine", 3),
        angle("sine", 3),
        angle("across_cosine", 3),
        angle("across_sine", 3),
        Parameter(
            "period", "h", HOUR, plausible=24 * HOUR, per_channel=False,
            grid=(3 * HOUR, 4.5 * HOUR, 7 * HOUR, 12 * HOUR, 24 * HOUR), default=24 * HOUR,
        ),
    )  # fmt: skip
    sentence = "the foundation tilts to and fro in the course of hours or of the day"
    shown_by = "a level on the foundation, read with each setting; the same setting through a day"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the tilts in the columns of zero offset and axis tilt, rad, shape (n, 5).

        t counts since the start of the run.
        """
        phase = 2 * np.pi * seen.conditions.elapsed_s / float(values["period"])
        along = into("zero_offset", wave(values, phase), seen.signal)
        return along + into("axis_tilt", wave(values, phase, "across_"), seen.signal)
