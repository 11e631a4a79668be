"""Words for arrays and for the axes, once: every room has them from here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import CHANNELS

__all__ = ["ARCSEC", "CHANNELS", "Floats", "Ints", "Labels", "Mask", "Singles"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Labels = NDArray[np.str_]

ARCSEC = np.pi / 648000
"""One second of arc, rad."""
