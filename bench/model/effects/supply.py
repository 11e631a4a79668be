"""Effects of what feeds the block."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.model.effects.base import BlockEffect, Parameter, Seen, Values

MOST_RAILS: Final = 3
"""Rails of a block, of which one is looked at after the other."""


class SupplySensitivity(BlockEffect):
    """(b_S + k_S a_i) v, v the voltage of a rail less its nominal one."""

    name = "supply_sensitivity"
    parameters = (
        Parameter("b_S", "ug/V", 1e-6, plausible=20e-6, per_channel=True),
        Parameter("k_S", "ppm/V", 1e-6, plausible=20e-6, per_channel=True),
        Parameter(
            "rail", "1", 1.0, plausible=1.0, per_channel=False,
            grid=tuple(float(number) for number in range(1, MOST_RAILS + 1)), default=1.0,
        ),
    )  # fmt: skip
    sentence = "bias and scale factor of the accelerometer follow the voltage of a rail that feeds it"
    shown_by = "the same settings with the rail a little above and a little below its nominal voltage"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii (b_S_i + k_S_i a_i) v in volts, shape (n, 3); nothing where no voltage of it is known."""
        number = round(float(values["rail"]))
        above_v = seen.conditions.above_nominal_v
        if not 1 <= number <= above_v.shape[1]:
            return np.zeros_like(seen.signal)
        return above_v[:, number - 1, None] * (seen.scale * (values["b_S"] + values["k_S"] * seen.signal))
