"""Mistakes that are made at a bench: their names and sizes, how each changes readings, how it is put right.

One vocabulary for the early warning, which supposes them of a run that goes on, and for the diagnosis, which
supposes them of a table. Slips of the scale are those at which a person is asked to look again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from drivers.angles import SLIPS


class MistakeName(StrEnum):
    """Mistakes as results name them."""

    SWAPPED_CHANNELS = "swapped_channels"
    REVERSED_POLARITY = "reversed_polarity"
    REVERSED_ROTATION = "reversed_rotation"
    SWAPPED_INSTALLATIONS = "swapped_installations"
    SHIFTED_POINTS = "shifted_points"
    WRONG_SETTING = "wrong_setting"
    OUTLIER = "outlier"
    WRONG_UNIT = "wrong_unit"
    OTHER_MOUNTING = "other_mounting"
    """The block sat otherwise: no mistake of its own, since nothing says how; others may look like it."""


@dataclass(frozen=True)
class Wiring:
    """How the signals are wired to the channels.

    `order` has for each true signal x, y, z the channel (0, 1, 2) that shows it, `signs` by what it is to be
    multiplied then.
    """

    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def matrix(self) -> Floats:
        """What makes a triple of signals right, (3, 3)."""
        return np.diag(self.signs) @ np.eye(3)[list(self.order)]

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that do not show what they should."""
        return tuple(CHANNELS[i] for i in range(3) if self.order[i] != i or self.signs[i] < 0)

    @property
    def shown(self) -> str:
        """Say which channel shows which signal: "x shows z, y shows x, z shows y"."""
        return ", ".join(f"{CHANNELS[i]} shows {CHANNELS[self.order.index(i)]}" for i in range(3))


RIGHT: Final = Wiring()
"""As it should be."""

EXCHANGED: Final = tuple(Wiring(order) for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1), (2, 0, 1), (1, 2, 0)))
"""Two channels exchanged, or all three in turn."""

REVERSED: Final = tuple(
    Wiring(signs=signs) for signs in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0))
)
"""One channel reversed."""

OPPOSITE_RAD: Final = float(np.pi)
SLIPS_RAD: Final = {
    slip.size: float(np.radians(slip.degrees)) for slip in SLIPS if np.radians(slip.degrees) < OPPOSITE_RAD
}
"""By how much the head is off, to either side, where a line of its scale was taken for another, by its name."""


def reflected_rad(angle_rad: Floats) -> Floats:
    """By how much the head is off where 360° - φ was taken for φ, by the shorter way."""
    return np.remainder(-2 * angle_rad + np.pi, 2 * np.pi) - np.pi
