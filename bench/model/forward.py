"""From the state of the bench to the readings of the voltmeters, effects included, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect, Stage
from bench.model.geometry import Installation, specific_force_on_platform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ForwardModel:
    """Installations by label, and the effects that the model contains beside the paper's own terms.

    `name` is what results call it: "paper" without effects, else the name in the model file.
    """

    installations: Mapping[str, Installation]
    effects: tuple[AppliedEffect, ...] = field(default=())
    name: str = "paper"

    def specific_force(
        self,
        conditions: Conditions,
        stand_rad: Floats,
        block: Block,
        setting_error_rad: Floats | float = 0.0,
    ) -> Floats:
        """Return the specific force on block axes in g, shape (n, 3).

        `stand_rad` (mounts, 5) has a row for each of `conditions.mounts`, columns as `STAND_ANGLES`;
        `setting_error_rad` is alpha4 of each reading. Raises `KeyError` for an unknown installation.
        """
        angle = conditions.angle_rad + setting_error_rad
        angle = angle + self._additions(Stage.HEAD_ANGLE, angle, conditions, block)
        on_platform = specific_force_on_platform(angle, stand_rad[conditions.mount])
        turns = np.stack([self.installations[m.installation].block_from_platform for m in conditions.mounts])
        force: Floats = np.einsum("nij,nj->ni", turns[conditions.mount], on_platform)
        return force + self._additions(Stage.SPECIFIC_FORCE, force, conditions, block)

    def readings(
        self,
        block: Block,
        conditions: Conditions,
        stand_rad: Floats,
        setting_error_rad: Floats | float = 0.0,
    ) -> Floats:
        """Return the readings that the model predicts, in volts, shape (n, 3); arguments as above."""
        force = self.specific_force(conditions, stand_rad, block, setting_error_rad)
        output = block.output(force) + self._additions(Stage.BLOCK_OUTPUT, force, conditions, block)
        return output + self._additions(Stage.VOLTMETER_READING, output, conditions, block)

    def _additions(self, stage: Stage, signal: Floats, conditions: Conditions, block: Block) -> Floats:
        total = np.zeros_like(signal)
        for applied in self.effects:
            if applied.effect.stage is stage:
                values = applied.complete_values()
                total = total + applied.effect.addition(values, signal, conditions, block)
        return total
