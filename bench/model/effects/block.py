"""Effects of the block itself, per channel, in units of its scale factor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects.base import Effect, Parameter, Stage

Floats = NDArray[np.float64]


class QuadraticNonlinearity(Effect):
    """K2 a_i^2 (IEEE Std 1293-2018): the output grows with the square of the input along the own axis."""

    name = "quadratic_nonlinearity"
    stage = Stage.BLOCK_OUTPUT
    parameters = (Parameter("K2", "ug/g^2", 1e-6, plausible=30e-6, per_channel=True),)
    sentence = "the output of the accelerometer has a part that grows with the square of the acceleration"
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return K_ii K2_i a_i^2 in volts, shape (n, 3)."""
        return np.diag(block.K) * values["K2"] * signal**2
