"""Effects of the stand: its angles, the head, motion of the platform, slips between settings."""

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
    """Return an array (n, 5) of stand angles with `angle_rad` (n,) in the named column and zeros elsewhere."""
    addition = np.zeros_like(stand_rad)
    addition[:, STAND_ANGLES.index(column)] = angle_rad
    return addition


class ConstantAngle(StandEffect):
    """A constant stand angle, larger than the bench file allows.

    `column` is the name of the angle in `STAND_ANGLES`, by default the name of the effect.
    """

    column: ClassVar[str] = ""
    per_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return into(self.column or self.name, values["angle"], seen.signal)


class AxisTilt(ConstantAngle):
    """The tilt of the head's axis, alpha1, beyond its limits."""

    name = "axis_tilt"
    shows_on = ("foundation", "shaft")
    parameters = (angle("angle", 10),)
    sentence = "the head's axis is tilted from the level by more than the bench file allows"
    shown_by = "a remount turned by 180 deg; a level on the shaft"


class ZeroOffset(ConstantAngle):
    """The zero offset of the head's scale, alpha2, beyond its limits."""

    name = "zero_offset"
    shows_on = ("foundation", "platform")
    parameters = (angle("angle", 10),)
    sentence = "the zero of the head's scale is off the vertical by more than the bench file allows"
    shown_by = "both directions of approach, and installations that share an axis of the block"


class MountingError(ConstantAngle):
    """The mounting error alpha3 beyond its limits: a tilt of -alpha3 sin(phi) out of the plane of rotation."""

    name = "mounting_error"
    shows_on = ("bracket",)
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted turned out of the plane of rotation by more than the bench file allows"
    shown_by = "a remount turned by 180 deg on the platform"


class MountingOffset(ConstantAngle):
    """A rotation of the block about the shaft that differs between mountings."""

    name = "mounting_offset"
    shows_on = ("bracket",)
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted turned within the plane of rotation"
    shown_by = "a remount turned by 180 deg on the platform"


class MountingRoll(ConstantAngle):
    """The third mounting angle alpha5: a tilt of alpha5 cos(phi) out of the plane of rotation."""

    name = "mounting_roll"
    shows_on = ("bracket",)
    parameters = (angle("angle", 90),)
    sentence = "the block was mounted tilted about the third axis of the platform"
    shown_by = "verification points with the block turned about x or z; a third installation"


# --- the head ---------------------------------------------------------------------------------------

MARKS_DEG: Final = tuple(range(0, 360, 15))
"""The angles of the scale marks, each of which has an error."""


class HeadEccentricity(HeadEffect):
    """An angle error e_c cos(phi) + e_s sin(phi): the circle's centre is off the shaft's axis."""

    name = "head_eccentricity"
    order = 1
    parameters = (angle("cosine", 8), angle("sine", 8))
    sentence = "the head's circle is off its axis: its angle is wrong by a sine with one period a turn"
    shown_by = "a second reading of the circle opposite the first; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return wave(values, seen.conditions.angle_rad)


class HeadEllipticity(HeadEffect):
    """An angle error e_c cos(2 phi) + e_s sin(2 phi): the circle is not round."""

    name = "head_ellipticity"
    order = 2
    parameters = (angle("cosine", 5), angle("sine", 5))
    sentence = "the head's circle is not round: its angle is wrong by a sine with two periods a turn"
    shown_by = "a remount turned by 90 deg on the platform; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return wave(values, 2 * seen.conditions.angle_rad)


class HeadGraduation(HeadEffect):
    """An angle error of each scale mark, linearly interpolated between marks."""

    name = "head_graduation"
    parameters = tuple(angle(f"at_{mark:03d}", 4) for mark in MARKS_DEG)
    apart = (tuple(parameter.name for parameter in parameters),)  # the errors of marks occur together only
    sentence = "marks of the head's scale are displaced, equally in every pass"
    shown_by = "24 angles in a turn; a polygon and autocollimator"

    def addition(self, values: Values, seen: Seen) -> Floats:
        errors = [float(values[p.name]) for p in self.parameters]
        return np.interp(seen.conditions.angle_rad, np.radians(MARKS_DEG), errors, period=2 * np.pi)


class Backlash(HeadEffect):
    """Backlash b: the angles of the two directions of approach differ by b; no effect for an unknown direction."""

    name = "backlash"
    parameters = (angle("play", 10),)
    sentence = "the head has play: its angle depends on the direction of approach"
    shown_by = "both directions of approach"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.conditions.direction * values["play"] / 2


# --- motion of the stand ----------------------------------------------------------------------------


class AxisWobble(StandEffect):
    """A tilt of the axis that varies with the head angle: w_c cos(h phi) + w_s sin(h phi), with harmonic h."""

    name = "axis_wobble"
    shows_on = ("shaft",)
    parameters = (
        angle("cosine", 5),
        angle("sine", 5),
        Parameter("harmonic", "1", 1.0, plausible=1.0, per_channel=False, grid=(1.0, 2.0), default=1.0),
    )
    sentence = "the head's axis wobbles: it tilts out of the plane of rotation as the head turns"
    shown_by = "a remount turned by 90 deg (twice a turn) or 180 deg (once a turn); a mirror on the shaft"

    def addition(self, values: Values, seen: Seen) -> Floats:
        phase = float(values["harmonic"]) * seen.conditions.angle_rad
        return into("axis_tilt", wave(values, phase), seen.signal)


class BracketTilt(ConstantAngle):
    """A tilt alpha1 out of the plane of rotation, constant during a mounting; each remount changes it."""

    name = "bracket_tilt"
    shows_on = ("platform", "bracket")
    column = "axis_tilt"
    parameters = (angle("angle", 30),)
    sentence = "the bracket tilted when the block was mounted, equally at all angles"
    shown_by = "a return to installation 1 at the end; a remount turned by 180 deg"


class FoundationTilt(StandEffect):
    """A periodic tilt of the foundation about the shaft and across it: c cos(2 pi t / P) + s sin(2 pi t / P).

    t is the time since the start of the run.
    """

    name = "foundation_tilt"
    shows_on = ("foundation",)
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
    sentence = "the foundation tilts to and fro over hours or the day"
    shown_by = "a level on the foundation, read with each setting; the same setting through a day"

    def addition(self, values: Values, seen: Seen) -> Floats:
        phase = 2 * np.pi * seen.conditions.elapsed_s / float(values["period"])
        along = into("zero_offset", wave(values, phase), seen.signal)
        return along + into("axis_tilt", wave(values, phase, "across_"), seen.signal)


# --- slips ------------------------------------------------------------------------------------------

MOUNTING_ANGLES: Final = ("mounting_error", "mounting_offset", "mounting_roll")


class BlockSlip(StandEffect):
    """A change of the three mounting angles in some passes of a mounting."""

    name = "block_slip"
    shows_on = ("bracket",)
    parameters = tuple(angle(column, 60) for column in MOUNTING_ANGLES)
    apart = (*((column,) for column in MOUNTING_ANGLES), MOUNTING_ANGLES)
    sentence = "the block slipped or was clamped again: its mounting angles changed between passes"
    shown_by = (
        "a mark across block and platform, checked in each pass; a pass repeated with the clamps tightened"
    )
    per_mount = True
    per_pass = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        parts = [into(column, values[column], seen.signal) for column in MOUNTING_ANGLES]
        return np.asarray(np.sum(parts, axis=0))


class MountingCreep(StandEffect):
    """The mounting angles settle as exp(-t / tau), with t since the first reading of the mounting."""

    name = "mounting_creep"
    shows_on = ("bracket",)
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
        left = np.exp(-seen.conditions.since_mounting_s / float(values["tau"]))
        parts = [into(column, values[column] * left, seen.signal) for column in MOUNTING_ANGLES]
        return np.asarray(np.sum(parts, axis=0))


class HeadZeroShift(HeadEffect):
    """A shift of the zero of the head's scale: the same angle added to every scale reading."""

    name = "head_zero_shift"
    parameters = (angle("angle", 60),)
    sentence = "the zero of the head's scale changed between passes, as after setting it again"
    shown_by = (
        "a level on the platform at 0 deg, read in each pass; the head's reference run before each pass"
    )
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.broadcast_to(values["angle"], len(seen.conditions))


PAIRS: Final = tuple((CHANNELS[i], CHANNELS[j]) for i, j in ((0, 1), (1, 2), (2, 0)))
"""Pairs of channels, in the order of the parameters of `MetersExchanged`."""


class MetersExchanged(VoltmeterEffect):
    """The exchange of two voltmeters: their gains differ by `gain`, their zeros by `zero`.

    `gain` times the voltage plus `zero` is added in one channel of the pair, and subtracted in the other.
    """

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
    sentence = "two voltmeters were swapped in some passes, and so were their gains and zeros"
    shown_by = "the meters' serial numbers, read in each pass; a shorted and a reference input in each pass"
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        added = np.zeros_like(seen.signal)
        for one, other in PAIRS:
            gain, zero = values[f"{one}{other}_gain"], values[f"{one}{other}_zero"]
            for channel, sign in ((one, 1.0), (other, -1.0)):
                column = CHANNELS.index(channel)
                added[:, column] += sign * (gain * seen.signal[:, column] + zero)
        return added
