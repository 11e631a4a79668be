"""How a bench error is distributed: normal with a coverage factor, or rectangular limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Distribution:
    """A bench error with zero mean, in SI.

    `limit` is the half-width of a rectangular distribution, or `k` standard deviations of a normal one.
    Source: JCGM 100:2008, 4.3.4-4.3.7.
    """

    limit: float
    shape: Literal["normal", "rectangular"] = "normal"
    k: float = 1.0

    @property
    def u(self) -> float:
        """Standard uncertainty, in the unit of `limit`."""
        return self.limit / (self.k if self.shape == "normal" else float(np.sqrt(3.0)))

    def draw(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        if self.shape == "normal":
            return float(rng.normal(0.0, self.u))
        return float(rng.uniform(-self.limit, self.limit))


ZERO = Distribution(0.0)
