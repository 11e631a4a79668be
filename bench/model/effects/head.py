"""Errors of the angle that the dividing head's scale shows."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.model.effects.base import HeadEffect, Seen, Values, angle, wave

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
