"""Effects of the dividing head and of what stands on it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects.base import Effect, Parameter, Stage

Floats = NDArray[np.float64]

ARCSEC = np.pi / 648000


class HeadEccentricity(Effect):
    """An angle error that goes round once a turn: the circle's centre is not on the shaft's axis."""

    name = "head_eccentricity"
    stage = Stage.HEAD_ANGLE
    parameters = (
        Parameter("cosine", "arcsec", ARCSEC, plausible=8 * ARCSEC, per_channel=False),
        Parameter("sine", "arcsec", ARCSEC, plausible=8 * ARCSEC, per_channel=False),
    )
    sentence = "the head's circle is off its axis: its angle is wrong by a sine that goes round once a turn"
    shown_by = "a second reading of the circle opposite the first; a polygon and autocollimator"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return e_c cos(phi) + e_s sin(phi) in rad, shape (n,)."""
        return values["cosine"] * np.cos(conditions.angle_rad) + values["sine"] * np.sin(conditions.angle_rad)
