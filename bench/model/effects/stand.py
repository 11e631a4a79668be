"""Effects in the stand: its angles, the head, motion of the platform, slips between settings."""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from bench.base.arrays import CHANNELS, HOUR, MINUTE, Floats
from bench.model.effects.base import (
    HeadEffect,
    Parameter,
    Seen,
    StandEffect,
    Values,
    VoltmeterEffect,
    angle,
    wave,
)
from bench.model.geometry import STAND_ANGLES

# --- angles of the stand ----------------------------------------------------------------------------


def into(column: str, angle_rad: Floats, stand_rad: Floats) -> Floats:
    """Return an addition (n, 5) to the stand angles that changes one of them."""
    addition = np.zeros_like(stand_rad)
    addition[:, STAND_ANGLES.index(column)] = angle_rad
    return addition


class ConstantAngle(StandEffect):
    """A stand angle that is larger than what the bench file allows."""

    column: ClassVar[str]
    per_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the angle in its column, rad, shape (n, 5)."""
        return into(self.column, values["angle"], seen.signal)


class AxisTilt(ConstantAngle):
    """alpha1 beyond its limits, of the stand itself."""

    name = "axis_tilt"
    column = "axis_tilt"
    parameters = (angle("angle", 10),)
    sentence = "the head's axis is tilted from the level by more than the bench file allows"
    shown_by = "a remount turned by 180 deg; a level on the shaft"


class ZeroOffset(ConstantAngle):
    """alpha2 beyond its limits, of the stand itself."""

    name = "zero_offset"
    column = "zero_offset"
    parameters = (angle("angle", 10),)
    sentence = "the zero of the head's scale is off the vertical by more than the bench file allows"
    shown_by = "both directions of approach, and installations that share an axis of the block"


class MountingError(ConstantAngle):
    """alpha3 beyond its limits: -alpha3 sin(phi) out of the plane of rotation."""

    name = "mounting_error"
    column = "mounting_error"
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted turned out of the plane of rotation by more than the bench file allows"
    shown_by = "a remount turned by 180 deg on the platform"


class MountingOffset(ConstantAngle):
    """A turn of the block about the shaft, from one mounting to another."""

    name = "mounting_offset"
    column = "mounting_offset"
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted turned within the plane of rotation"
    shown_by = "a remount turned by 180 deg on the platform"


class MountingRoll(ConstantAngle):
    """alpha5, the third mounting angle: alpha5 cos(phi) out of the plane of rotation."""

    name = "mounting_roll"
    column = "mounting_roll"
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted tilted about the third axis of the platform"
    shown_by = "verification points with the block turned about x or z; a third installation"


# --- the head ---------------------------------------------------------------------------------------

MARKS_DEG: Final = tuple(range(0, 360, 15))
"""The marks of the scale that have an error of their own."""


class HeadEccentricity(HeadEffect):
    """An angle error that goes round once a turn: the circle's centre is not on the shaft's axis."""

    name = "head_eccentricity"
    parameters = (angle("cosine", 8), angle("sine", 8))
    sentence = "the head's circle is off its axis: its angle is wrong by a sine that goes round once a turn"
    shown_by = "a second reading of the circle opposite the first; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return e_c cos(phi) + e_s sin(phi) in rad, shape (n,)."""
        return wave(values, seen.conditions.angle_rad)


class HeadEllipticity(HeadEffect):
    """An angle error that goes round twice a turn."""

    name = "head_ellipticity"
    parameters = (angle("cosine", 5), angle("sine", 5))
    sentence = "the head's circle is not round: its angle is wrong by a sine that goes round twice a turn"
    shown_by = "a remount turned by 90 deg on the platform; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return e_c cos(2 phi) + e_s sin(2 phi) in rad, shape (n,)."""
        return wave(values, 2 * seen.conditions.angle_rad)


class HeadGraduation(HeadEffect):
    """An angle error of its own for each mark of the scale, in a straight line between marks."""

    name = "head_graduation"
    parameters = tuple(angle(f"at_{mark:03d}", 4) for mark in MARKS_DEG)
    sentence = "marks of the head's scale are off their places, by the same in every pass"
    shown_by = "24 angles in a turn; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the error of the mark in rad, shape (n,)."""
        errors = [float(values[p.name]) for p in self.parameters]
        return np.interp(seen.conditions.angle_rad, np.radians(MARKS_DEG), errors, period=2 * np.pi)


class Backlash(HeadEffect):
    """The angle differs by b between the two directions of approach; nothing where the direction is not known."""

    name = "backlash"
    parameters = (angle("play", 10),)
    sentence = "the head has play: its angle depends on the direction of approach"
    shown_by = "both directions of approach"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return d b / 2 in rad, shape (n,)."""
        return seen.conditions.direction * values["play"] / 2


# --- motion of the stand ----------------------------------------------------------------------------


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


# --- slips ------------------------------------------------------------------------------------------

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


class MountingCreep(StandEffect):
    """The mounting angles creep to their final values: each by exp(-t / tau), t since the first reading in it."""

    name = "mounting_creep"
    parameters = (
        *(angle(column, 20) for column in MOUNTING_ANGLES),
        Parameter(
            "tau", "min", MINUTE, plausible=40 * MINUTE, per_channel=False,
            grid=tuple(minutes * MINUTE for minutes in (20, 35, 60, 90)), default=35 * MINUTE,
        ),
    )  # fmt: skip
    apart = BlockSlip.apart
    sentence = "the block creeps on the platform after it was clamped: its mounting angles settle with time"
    shown_by = "a pass repeated at once in the same mounting; a longer wait after clamping makes it smaller"
    per_mount = True
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return what is left of the angles in their columns, rad, shape (n, 5)."""
        left = np.exp(-seen.conditions.since_mounting_s / float(values["tau"]))
        parts = [into(column, values[column] * left, seen.signal) for column in MOUNTING_ANGLES]
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
