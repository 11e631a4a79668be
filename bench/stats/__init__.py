"""Statistics that know nothing of a bench; here: the adjustment of p-values for several tests.

Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6 (1979) 65.
"""

from __future__ import annotations

import numpy as np

from bench.base.arrays import Floats


def holm(p: Floats) -> Floats:
    """Return probabilities (m,) adjusted for m tests: p_(k) times (m - k), never falling, at most 1."""
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted
