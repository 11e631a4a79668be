"""Errors of the stand and of how the block sits on it, as angles that add to the stand angles."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from bench.base.arrays import Floats
from bench.model.effects.base import Seen, StandEffect, Values, angle
from bench.model.geometry import STAND_ANGLES


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
