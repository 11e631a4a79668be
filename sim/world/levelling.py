"""The platform of a simulated bench as a level sees it: how it stands, what the level itself adds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from bench.model import Block, Conditions, ForwardModel
from bench.model.effects import Stage
from bench.model.geometry import INSTALLATION_1

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.interfaces import LevelAxis
    from sim.world.pose import Visit

_OF_THE_PLATFORM: Final = (Stage.STAND, Stage.HEAD_ANGLE)
_OF_THE_BLOCK: Final = (
    "bracket_tilt", "mounting_error", "mounting_offset", "mounting_roll", "block_slip",
)  # fmt: skip
"""Effects of how the block sits on the platform: no level on the platform shows them."""
_BLOCK: Final = Block(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class LevelSettings:
    """What is true of a level: how far its zero is off, its noise (1 σ), rad, and the error of its scale."""

    zero_along_rad: float = 0.0
    zero_across_rad: float = 0.0
    noise_rad: float = 0.0
    scale: float = 0.0

    def shown_rad(self, axis: LevelAxis, inclined_rad: float, normal: Callable[[], float]) -> float:
        """Return what it shows where its axis is inclined so much; `normal` gives a standard normal number."""
        zero_rad = self.zero_along_rad if axis == "along" else self.zero_across_rad
        return inclined_rad * (1.0 + self.scale) + zero_rad + self.noise_rad * normal()


def platform_tilt_rad(visit: Visit, model: ForwardModel) -> dict[LevelAxis, float]:
    """Return the inclination of the platform along the shaft and across it, rad, the head where it stands.

    The effects of stand and head are in it, those of how the block sits are not.
    """
    pose = visit.pose
    effects = tuple(
        applied
        for applied in model.effects
        if applied.effect.stage in _OF_THE_PLATFORM and applied.effect.name not in _OF_THE_BLOCK
    )
    bare = ForwardModel({pose.installation: replace(INSTALLATION_1, label=pose.installation)}, effects)
    conditions = Conditions.of(
        [pose.installation],
        [pose.turn.angle_rad(visit.time_s)],
        series=[pose.series],
        direction=[pose.direction or 0],
        time_s=[visit.elapsed_s],
        temperature_c=[visit.block_c],
    )
    stand_rad = pose.stand_rad.copy()[None]
    stand_rad[:, 2:] = 0.0  # the angles at which the block is mounted
    x, y, _ = bare.specific_force(conditions, stand_rad, _BLOCK, pose.setting_error_rad)[0]
    return {"along": math.asin(y), "across": math.asin(x)}
