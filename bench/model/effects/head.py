"""Errors of the angle that the dividing head's scale shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects.base import Effect, Parameter, Stage, Subsystem

MARKS_DEG: Final = tuple(range(0, 360, 15))
"""The marks of the scale that have an error of their own."""


def _angle(name: str, plausible_arcsec: float) -> Parameter:
    return Parameter(name, "arcsec", ARCSEC, plausible_arcsec * ARCSEC, per_channel=False)


class HeadEccentricity(Effect):
    """An angle error that goes round once a turn: the circle's centre is not on the shaft's axis."""

    name = "head_eccentricity"
    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND
    parameters = (_angle("cosine", 8), _angle("sine", 8))
    sentence = "the head's circle is off its axis: its angle is wrong by a sine that goes round once a turn"
    shown_by = "a second reading of the circle opposite the first; a polygon and autocollimator"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return e_c cos(phi) + e_s sin(phi) in rad, shape (n,)."""
        return values["cosine"] * np.cos(conditions.angle_rad) + values["sine"] * np.sin(conditions.angle_rad)


class HeadEllipticity(Effect):
    """An angle error that goes round twice a turn."""

    name = "head_ellipticity"
    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND
    parameters = (_angle("cosine", 5), _angle("sine", 5))
    sentence = "the head's circle is not round: its angle is wrong by a sine that goes round twice a turn"
    shown_by = "a remount turned by 90 deg on the platform; a polygon and autocollimator"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return e_c cos(2 phi) + e_s sin(2 phi) in rad, shape (n,)."""
        twice = 2 * conditions.angle_rad
        return values["cosine"] * np.cos(twice) + values["sine"] * np.sin(twice)


class HeadGraduation(Effect):
    """An angle error of its own for each mark of the scale, in a straight line between marks."""

    name = "head_graduation"
    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND
    parameters = tuple(_angle(f"at_{mark:03d}", 4) for mark in MARKS_DEG)
    sentence = "marks of the head's scale are off their places, by the same in every pass"
    shown_by = "24 angles in a turn; a polygon and autocollimator"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return the error of the mark in rad, shape (n,)."""
        errors = [float(values[p.name]) for p in self.parameters]
        return np.interp(conditions.angle_rad, np.radians(MARKS_DEG), errors, period=2 * np.pi)


class Backlash(Effect):
    """The angle differs by b between the two directions of approach; nothing where the direction is not known."""

    name = "backlash"
    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND
    parameters = (_angle("play", 10),)
    sentence = "the head has play: its angle depends on the direction of approach"
    shown_by = "both directions of approach"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return d b / 2 in rad, shape (n,)."""
        return conditions.direction * values["play"] / 2
