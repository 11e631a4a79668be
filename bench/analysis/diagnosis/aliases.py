"""Periods of the head's angle that look alike at the angles measured."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.model import AppliedEffect

MOST_PER_TURN: Final = 72
"""Orders looked at: 72 a turn is a mark every 5 degrees."""
ALIKE: Final = 0.01
"""Part of a wave's square that another one may leave and still look the same."""
SAME_ANGLE_DEG: Final = 0.1
ORDERS: Final = {"head_eccentricity": 1, "head_ellipticity": 2}
"""Effects that are a wave of the head's angle, and how often a turn; of others the shape `harmonic` says it."""


def looking_like(angle_rad: Floats, order: int) -> tuple[int, ...]:
    """Return the other orders whose waves look at these angles (n,) like waves of `order`; of order 0 like nothing.

    A wave that is constant at all angles is nothing: the coefficients take it up.
    """
    angles = _different(angle_rad)
    own = _waves(angles, order)
    others = (k for k in range(1, MOST_PER_TURN + 1) if k != order)
    return tuple(k for k in others if _left(_waves(angles, k), own) < ALIKE)


def order_of(applied: AppliedEffect) -> int | None:
    """Return how often a turn an effect repeats; None where it is no wave of the head's angle."""
    if applied.effect.name in ORDERS:
        return ORDERS[applied.effect.name]
    harmonic = applied.complete_values().get("harmonic")
    return None if harmonic is None else round(float(harmonic))


def _different(angle_rad: Floats) -> Floats:
    """Return the angles that differ by more than settings scatter, within a turn, rad."""
    degrees = np.sort(np.degrees(angle_rad[np.isfinite(angle_rad)]) % 360.0)
    kept = degrees[np.concatenate([[True], np.diff(degrees) > SAME_ANGLE_DEG])] if len(degrees) else degrees
    around = len(kept) > 1 and kept[0] + 360.0 - kept[-1] < SAME_ANGLE_DEG
    return np.asarray(np.radians(kept[:-1] if around else kept))


def _waves(angle_rad: Floats, order: int) -> Floats:
    """Cosine and sine of so many periods a turn, (n, 2); of none a constant, (n, 1)."""
    if order == 0:
        return np.ones((len(angle_rad), 1))
    return np.stack([np.cos(order * angle_rad), np.sin(order * angle_rad)], axis=1)


def _left(waves: Floats, own: Floats) -> float:
    """Return the largest part of a wave's square that the others leave."""
    size = np.maximum(np.sum(waves**2, axis=0), 1e-12 * len(waves))
    fitted = own @ np.linalg.lstsq(own, waves, rcond=1e-6)[0]
    return float(np.max(np.sum((waves - fitted) ** 2, axis=0) / size, initial=0.0))
