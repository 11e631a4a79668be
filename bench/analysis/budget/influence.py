"""How an error acts on readings: the same pattern wherever its draw is shared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.base.arrays import Floats, Ints


@dataclass(frozen=True)
class Influence:
    """What one unit of an error does to the signals of n readings.

    `pattern` (n, 3) is in V per unit of the error; entries with the same number in `group` (n, 3), counted
    from 0 to `draws` - 1, share one draw of it.
    """

    pattern: Floats
    group: Ints
    draws: int

    @classmethod
    def of(cls, pattern: Floats, group: Ints) -> Influence:
        """Build from a pattern (n, 3) and labels that broadcast to it: equal labels share a draw."""
        labels, numbers = np.unique(np.broadcast_to(group, pattern.shape), return_inverse=True)
        return cls(pattern, numbers.reshape(pattern.shape), len(labels))

    def through(self, functionals: Floats) -> Floats:
        """Return what each draw, one unit large, adds to m linear functionals (m, n, 3) of the readings.

        Shape (m, draws).
        """
        m = len(functionals)
        flat: Floats = (functionals * self.pattern).reshape(m, -1)
        group = self.group.ravel()
        if self.draws == flat.shape[1] and np.array_equal(group, np.arange(self.draws)):
            return flat
        shared = np.zeros((flat.shape[1], self.draws))
        shared[np.arange(len(group)), group] = 1.0
        return flat @ shared

    def on_readings(self, drawn: Floats) -> Floats:
        """Return the errors (…, n, 3) of the readings for drawn errors (…, draws)."""
        return drawn[..., self.group] * self.pattern
