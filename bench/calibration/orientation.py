"""The orientation of the block at the verification points: whether the readings agree with the stated one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask, u_of
from bench.base.languages import message
from bench.model import Block, ForwardModel
from bench.model.geometry import STAND_ANGLES
from bench.readings.corrected import EXCHANGED, REVERSED
from bench.readings.table import UNORIENTED, VERIFICATION, Readings

FARTHEST_RAD: Final = math.radians(5.0)
FARTHEST_U: Final = 10.0
"""A measured direction contradicts the stated one beyond both: this angle, rad, and this multiple of its u."""
MOST_NAMED: Final = 2
"""Largest number of explanations that a sentence names."""


@dataclass(frozen=True)
class Contradiction:
    """Verification points that contradict the stated orientation (mask `points`), and a sentence on them."""

    points: Mask
    sentence: str


@dataclass(frozen=True)
class StatedOrientation:
    """The orientations that a bench file states, and u (rad) of a direction that the block measures."""

    model: ForwardModel
    u_rad: float

    @classmethod
    def of(
        cls, model: ForwardModel, stand_u: Mapping[str, float], block: Block, covariance: Floats
    ) -> StatedOrientation | None:
        """Return what `model` states for installation V; None if no reading could contradict it.

        `stand_u` are the standard uncertainties (rad) of the stand by name, `covariance` (12, 12) is the covariance
        of the coefficients. Coefficients of free positions alone contradict no orientation: they leave the block's
        axes open, and some are zero by convention, with u = 0.
        """
        u_K = u_of(covariance)[:9].reshape(3, 3)
        if VERIFICATION not in model.installations or (u_K.any() and not u_K.all()):
            return None
        of_axes = np.linalg.norm(u_K, axis=1) / np.linalg.norm(block.K, axis=1)
        of_stand = [u for name, u in stand_u.items() if name in (*STAND_ANGLES, "setting_error")]
        return cls(replace(model, effects=()), math.hypot(float(np.max(of_axes)), *of_stand))

    def contradiction(self, rows: Readings, block: Block) -> Contradiction | None:
        """Return which of the verification `rows` contradict the stated orientation; None if none does."""
        limit_rad = max(FARTHEST_RAD, FARTHEST_U * self.u_rad)

        def off(signal: Floats, label: str) -> Floats:
            return _between(block.specific_force(signal), self._force(rows, label))

        off_rad = off(rows.signal, VERIFICATION)
        points = off_rad > limit_rad  # false for an unknown angle, which is NaN
        if not points.any():
            return None

        def agrees(signal: Floats, label: str) -> bool:
            return bool((off(signal, label)[np.isfinite(off_rad)] <= limit_rad).all())

        causes = [*self._causes(rows, agrees)][:MOST_NAMED]
        remedy = (
            message(
                f", and agree with {' or '.join(causes)}; mount and connect the block as stated, then measure "
                "them again"
            )
            if causes
            else message(
                "; check mounting and wiring, the labels and angles of all readings, and what the bench file "
                "states for V"
            )
        )
        off_deg = math.degrees(float(np.max(off_rad[points])))
        where = message(
            f"installation V: {int(points.sum())} of {len(rows)} verification points are up to {off_deg:.0f}° off "
            "the orientation in the bench file"
        )
        return Contradiction(points, f"{where}{remedy}")

    def _force(self, rows: Readings, label: str) -> Floats:
        """Return the specific force, g, that the nominal stand gives the rows in the installation `label`."""
        conditions = replace(rows, installation=np.full(len(rows), label)).conditions()
        still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
        force: Floats = self.model.specific_force(conditions, still, Block(np.eye(3), np.zeros(3)))
        return force

    def _causes(self, rows: Readings, agrees: Callable[[Floats, str], bool]) -> Iterator[str]:
        """Yield the installations and wirings with which all readings agree."""
        for label in sorted(self.model.installations.keys() - {*UNORIENTED, VERIFICATION}):
            if agrees(rows.signal, label):
                yield message(f"installation {label}")
        for wiring in (*EXCHANGED, *REVERSED):
            if agrees(rows.signal @ wiring.matrix.T, VERIFICATION):
                channels = ", ".join(axis for axis in CHANNELS if axis in wiring.channels)
                how = message("exchanged") if wiring in EXCHANGED else message("reversed")
                yield message(f"channels {channels} {how}")


def _between(one: Floats, other: Floats) -> Floats:
    """Return the angle, rad, between the vectors in corresponding rows of two arrays (n, 3)."""
    across = np.linalg.norm(np.cross(one, other), axis=1)
    angles: Floats = np.arctan2(across, np.sum(one * other, axis=1))
    return angles
