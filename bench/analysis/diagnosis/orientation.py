"""How the block stood at the verification points: as its own signals say it, whatever the bench file states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.model import STAND_ANGLES, ForwardModel, Installation
from bench.model.geometry import specific_force_on_platform
from bench.readings.table import VERIFICATION, Readings

CONTRADICTS_RAD: Final = float(np.radians(0.5))
"""A turn from what the bench file states that no signature notices; a larger one is told and taken up."""
OF_LIMITS: Final = 5.0
"""So many standard uncertainties of the stand's angles are no contradiction either."""
ONE_MOUNTING: Final = 0.01
"""Root mean square by which directions may miss those of one mounting, rad."""
LEAST_APART: Final = 0.05
"""Second singular value of the directions, per point, from which they tell an orientation."""


@dataclass(frozen=True)
class Orientation:
    """The verification points' `block_from_platform` (3, 3) as the signals give it, and how it differs.

    `off_rad` is the turn from what the bench file states, about `axis` of the block (3,); `missed_rad` the root
    mean square of what is left of the directions.
    """

    block_from_platform: Floats
    off_rad: float
    axis: Floats
    missed_rad: float
    contradicts: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what a result says of it."""
        return {
            "off_deg": float(np.degrees(self.off_rad)),
            "axis": self.axis.tolist(),
            "contradicts_bench_file": self.contradicts,
        }

    def in_words(self) -> str:
        """Say what contradicts the bench file, and what to do."""
        axis = ", ".join(f"{part:+.2f}" for part in self.axis)
        return (
            f"the verification points contradict the bench file: by their signals the block is turned by "
            f"{np.degrees(self.off_rad):.2g}° about ({axis}) of its axes from the orientation that installation V "
            "states; the signals are believed here; correct 'installations: V' in the bench file, or name the "
            "right one with --bench"
        )


def orientation_of(
    model: ForwardModel, readings: Readings, force: Floats, stand_u: Mapping[str, float]
) -> Orientation | None:
    """Return how the block stood at the verification points of a table; None where they do not tell it.

    `force` (n, 3) is the specific force that the signals of the table give. Source of the fit: Wahba's problem,
    solved by singular values (Markley, 1988).
    """
    rows = np.flatnonzero((readings.installation == VERIFICATION) & np.isfinite(readings.angle_rad))
    if VERIFICATION not in model.installations or len(rows) < 2:
        return None
    platform = specific_force_on_platform(readings.angle_rad[rows], np.zeros((len(rows), len(STAND_ANGLES))))
    seen = force[rows] / np.linalg.norm(force[rows], axis=1, keepdims=True)
    left, sizes, right = np.linalg.svd(seen.T @ platform)
    if sizes[1] < LEAST_APART * len(rows):
        return None
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    missed = float(np.sqrt(np.mean(np.sum((seen - platform @ turn.T) ** 2, axis=1))))
    if missed > ONE_MOUNTING:
        return None
    stated = model.installations[VERIFICATION].block_from_platform
    off, axis = _turn(turn @ stated.T)
    limits = np.linalg.norm([stand_u.get(name, 0.0) for name in STAND_ANGLES])
    contradicts = off > max(CONTRADICTS_RAD, OF_LIMITS * float(limits))
    return Orientation(turn, off, axis, missed, contradicts)


def as_measured(model: ForwardModel, orientation: Orientation | None) -> ForwardModel:
    """Return the model with the verification points where their signals have them, if the bench file is wrong."""
    if orientation is None or not orientation.contradicts:
        return model
    measured = Installation(VERIFICATION, orientation.block_from_platform)
    return replace(model, installations={**model.installations, VERIFICATION: measured})


def _turn(matrix: Floats) -> tuple[float, Floats]:
    """Return angle (rad) and unit axis (3,) of a rotation."""
    twice_sine = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    angle = float(np.arctan2(np.linalg.norm(twice_sine), np.trace(matrix) - 1.0))
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    axis = vectors[:, int(np.argmax(values))]
    return angle, np.asarray(axis * (1.0 if axis @ twice_sine >= 0 else -1.0))
