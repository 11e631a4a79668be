"""The columns in which a readings file has what a level showed of the platform."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, HOUR, Floats, Labels
from bench.base.numbers import read_number
from bench.base.visible import shortened

ANGLES: Final = ("alpha1_arcsec", "alpha2_arcsec", "u_alpha1_arcsec", "u_alpha2_arcsec")
"""The columns of a levelling: the platform's angles while the block is mounted, and their u."""
DRIFTS: Final = ("drift_alpha1_arcsec_h", "drift_alpha2_arcsec_h")
"""How fast the platform moved where it was read again, root mean square: the same in all rows of a run."""
LEVEL_COLUMNS: Final = (*ANGLES, *DRIFTS)


def level_rad(extra: Mapping[str, Labels], rows: int) -> Floats | None:
    """Return α1, α2 and their u of each row, rad, shape (rows, 4), NaN where not known; None for no such column.

    Raises `ValueError` for a cell that is no number, and for an angle without its u.
    """
    if not all(name in extra for name in ANGLES):
        return None
    columns = [
        [float(cell) if cell.strip() else math.nan for cell in extra[name].tolist()] for name in ANGLES
    ]
    found = np.array(columns, dtype=np.float64).reshape(4, rows).T * ARCSEC
    whole = np.isfinite(found).all(axis=1)
    if np.any(np.isfinite(found).any(axis=1) & ~whole) or np.any(found[whole, 2:] <= 0.0):
        raise ValueError(f"{', '.join(ANGLES)} stand together, and u is more than nothing")
    return found


def drift_rad_s(extra: Mapping[str, Labels]) -> tuple[float, float] | None:
    """Return how fast the platform was seen to move, rad/s; None where nobody looked again."""
    if not all(name in extra for name in DRIFTS):
        return None
    rates = [[float(cell) for cell in extra[name].tolist() if cell.strip()] for name in DRIFTS]
    if not all(rates):
        return None
    one, two = (math.sqrt(sum(r**2 for r in own) / len(own)) * ARCSEC / HOUR for own in rates)
    return one, two


def wrong_level_cell(text: Mapping[str, str]) -> tuple[str, str] | None:
    """Return column and mistake of a row that no level showed; None for a good one."""
    for name in LEVEL_COLUMNS:
        cell = text.get(name, "").strip()
        try:
            good = not cell or math.isfinite(read_number(cell))
        except ValueError:
            good = False
        if not good:
            return name, f"expected a number of arcsec, got {shortened(cell)!r}"
    given = [name for name in ANGLES if text.get(name, "").strip()]
    for name in ANGLES if given else ():
        if name not in given or (name.startswith("u_") and float(text[name]) <= 0.0):
            return name, f"expected a number: {', '.join(ANGLES)} stand together, and u is more than nothing"
    return None
