"""Errors of the stand and of how the block sits on it, as angles that add to the stand angles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects.base import Effect, Parameter, Stage, Subsystem
from bench.model.geometry import STAND_ANGLES

HOUR = 3600.0


def _angle(name: str, plausible_arcsec: float) -> Parameter:
    return Parameter(name, "arcsec", ARCSEC, plausible_arcsec * ARCSEC, per_channel=False)


def _into(column: str, angle_rad: Floats, stand_rad: Floats) -> Floats:
    """Return an addition (n, 5) to the stand angles that changes one of them."""
    addition = np.zeros_like(stand_rad)
    addition[:, STAND_ANGLES.index(column)] = angle_rad
    return addition


class _ConstantAngle(Effect):
    """A stand angle that is larger than what the bench file allows."""

    stage = Stage.STAND
    subsystem = Subsystem.STAND
    column: ClassVar[str]

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return the angle in its column, rad, shape (n, 5)."""
        return _into(self.column, values["angle"], signal)


class AxisTilt(_ConstantAngle):
    """alpha1 beyond its limits, of the stand itself."""

    name = "axis_tilt"
    column = "axis_tilt"
    parameters = (_angle("angle", 10),)
    sentence = "the head's axis is tilted from the level by more than the bench file allows"
    shown_by = "a remount turned by 180 deg; a level on the shaft"
    per_mount = True


class ZeroOffset(_ConstantAngle):
    """alpha2 beyond its limits, of the stand itself."""

    name = "zero_offset"
    column = "zero_offset"
    parameters = (_angle("angle", 10),)
    sentence = "the zero of the head's scale is off the vertical by more than the bench file allows"
    shown_by = "both directions of approach, and installations that share an axis of the block"
    per_mount = True


class MountingError(_ConstantAngle):
    """alpha3 beyond its limits: -alpha3 sin(phi) out of the plane of rotation."""

    name = "mounting_error"
    column = "mounting_error"
    parameters = (_angle("angle", 90),)
    sentence = "the block was mounted turned out of the plane of rotation by more than the bench file allows"
    shown_by = "a remount turned by 180 deg on the platform"
    per_mount = True


class MountingOffset(_ConstantAngle):
    """A turn of the block about the shaft, from one mounting to another."""

    name = "mounting_offset"
    column = "mounting_offset"
    parameters = (_angle("angle", 90),)
    sentence = "the block was mounted turned within the plane of rotation"
    shown_by = "a remount turned by 180 deg on the platform"
    per_mount = True


class MountingRoll(_ConstantAngle):
    """alpha5, the third mounting angle: alpha5 cos(phi) out of the plane of rotation."""

    name = "mounting_roll"
    column = "mounting_roll"
    parameters = (_angle("angle", 90),)
    sentence = "the block was mounted tilted about the third axis of the platform"
    shown_by = "verification points with the block turned about x or z; a third installation"
    per_mount = True


class BracketTilt(_ConstantAngle):
    """A constant tilt out of the plane of rotation, which changes at a remount: alpha1 of that mounting alone."""

    name = "bracket_tilt"
    column = "axis_tilt"
    parameters = (_angle("angle", 30),)
    sentence = "what carries the block tilted by the same at all angles when the block was mounted"
    shown_by = "a return to installation 1 at the end; a remount turned by 180 deg"
    per_mount = True


class AxisWobble(Effect):
    """The head's axis tilts as the head goes round: w_c cos(h phi) + w_s sin(h phi), h its harmonic."""

    name = "axis_wobble"
    stage = Stage.STAND
    subsystem = Subsystem.STAND
    parameters = (
        _angle("cosine", 5),
        _angle("sine", 5),
        Parameter("harmonic", "1", 1.0, plausible=1.0, per_channel=False, grid=(1.0, 2.0), default=1.0),
    )
    sentence = "the head's axis wobbles: it tilts out of the plane of rotation as the head goes round"
    shown_by = "a remount turned by 90 deg (twice a turn) or 180 deg (once a turn); a mirror on the shaft"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return the tilt in the column of the axis tilt, rad, shape (n, 5)."""
        phase = float(values["harmonic"]) * conditions.angle_rad
        tilt = values["cosine"] * np.cos(phase) + values["sine"] * np.sin(phase)
        return _into("axis_tilt", tilt, signal)


class FoundationTilt(Effect):
    """The foundation tilts with a period P, c cos(2 pi t / P) + s sin(2 pi t / P), about the shaft and across."""

    name = "foundation_tilt"
    stage = Stage.STAND
    subsystem = Subsystem.STAND
    parameters = (
        _angle("cosine", 3),
        _angle("sine", 3),
        _angle("across_cosine", 3),
        _angle("across_sine", 3),
        Parameter(
            "period", "h", HOUR, plausible=24 * HOUR, per_channel=False,
            grid=(3 * HOUR, 4.5 * HOUR, 7 * HOUR, 12 * HOUR, 24 * HOUR), default=24 * HOUR,
        ),
    )  # fmt: skip
    sentence = "the foundation tilts to and fro in the course of hours or of the day"
    shown_by = "a level on the foundation, read with each setting; the same setting through a day"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return the tilts in the columns of zero offset and axis tilt, rad, shape (n, 5).

        t counts since the start of the run.
        """
        phase = 2 * np.pi * conditions.elapsed_s / float(values["period"])
        cosine, sine = np.cos(phase), np.sin(phase)
        along = values["cosine"] * cosine + values["sine"] * sine
        across = values["across_cosine"] * cosine + values["across_sine"] * sine
        return _into("zero_offset", along, signal) + _into("axis_tilt", across, signal)
