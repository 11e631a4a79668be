"""From the state of the bench to the readings of the voltmeters, effects included, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bench.base.arrays import Floats
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect, Seen, Stage
from bench.model.geometry import Block, Installation, specific_force_on_platform

_UNKNOWN_TURN = np.full((3, 3), np.nan)


@dataclass(frozen=True)
class ForwardModel:
    """Installations by label, and the effects that the model contains beside the paper's own terms.

    `name` is what results call it: "paper" without effects, else the name in the model file. Rows of
    `conditions` stand in the order of measurement, since effects may look back along them.
    """

    installations: Mapping[str, Installation]
    effects: tuple[AppliedEffect, ...] = field(default=())
    name: str = "paper"

    @property
    def needs_history(self) -> bool:
        """Whether a reading depends on those before it."""
        return any(applied.effect.needs_history for applied in self.effects)

    def specific_force(
        self, conditions: Conditions, stand_rad: Floats, block: Block, setting_error_rad: Floats | float = 0.0
    ) -> Floats:
        """Return the specific force on block axes in g, shape (n, 3).

        `stand_rad` (mounts, 5) has a row for each of `conditions.mounts`, columns as `STAND_ANGLES`;
        `setting_error_rad` is alpha4 of each reading. Raises `KeyError` for an unknown installation.
        """
        unknown = {mount.installation for mount in conditions.mounts} - set(self.installations)
        if unknown:
            raise KeyError(", ".join(sorted(unknown)))
        force = self._force_of_stand(conditions, stand_rad, block, setting_error_rad)
        return force + self._additions(Stage.SPECIFIC_FORCE, force, conditions, block)

    def readings(
        self, block: Block, conditions: Conditions, stand_rad: Floats, setting_error_rad: Floats | float = 0.0
    ) -> Floats:
        """Return the readings that the model predicts, in volts, shape (n, 3); arguments as above."""
        force = self.specific_force(conditions, stand_rad, block, setting_error_rad)
        return self.voltmeter_readings(self.output(force, conditions, block), conditions, block)

    def readings_in_order(
        self,
        block: Block,
        conditions: Conditions,
        stand_rad: Floats,
        setting_error_rad: Floats | float = 0.0,
        *,
        force: Floats | None = None,
        voltage_v: Floats | None = None,
    ) -> Floats:
        """Return the readings of rows of all kinds, so that effects look back along what was really read.

        Where `force` (n, 3) is not NaN it is the specific force, in g, in place of that of the installation;
        where `voltage_v` (n, 3) is not NaN it is at the inputs, in place of the block's signals. Other
        arguments as above; a row in an unknown installation for which neither is given reads NaN.
        """
        acting = self._force_of_stand(conditions, stand_rad, block, setting_error_rad)
        if force is not None:
            acting = np.where(np.isnan(force), acting, force)
        acting = acting + self._additions(Stage.SPECIFIC_FORCE, acting, conditions, block)
        at_inputs = self.output(acting, conditions, block)
        if voltage_v is not None:
            at_inputs = np.where(np.isnan(voltage_v), at_inputs, voltage_v)
        return self.voltmeter_readings(at_inputs, conditions, block)

    def readings_at(self, force: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the readings for rows whose orientation is not known but whose specific force is given.

        `force` (n, 3) in g on block axes, as local gravity is believed to be; volts, shape (n, 3).
        """
        force = force + self._additions(Stage.SPECIFIC_FORCE, force, conditions, block)
        return self.voltmeter_readings(self.output(force, conditions, block), conditions, block)

    def output(self, force: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the voltages at the meters' terminals for the force (n, 3) that acts, V, shape (n, 3)."""
        return block.output(force) + self._additions(Stage.BLOCK_OUTPUT, force, conditions, block)

    def voltmeter_readings(self, voltage_v: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return what the meters read of voltages (n, 3) at their terminals, from the block or any source.

        A shorted input has 0 V there, a reference its voltage; rows of both kinds may stand among others.
        """
        return voltage_v + self._additions(Stage.VOLTMETER_READING, voltage_v, conditions, block)

    def _force_of_stand(
        self, conditions: Conditions, stand_rad: Floats, block: Block, setting_error_rad: Floats | float
    ) -> Floats:
        """Return gravity on block axes in g, shape (n, 3), NaN in an unknown installation."""
        stand = stand_rad[conditions.mount]
        stand = stand + self._additions(Stage.STAND, stand, conditions, block)
        angle = conditions.angle_rad + setting_error_rad
        angle = angle + self._additions(Stage.HEAD_ANGLE, angle, conditions, block)
        on_platform = specific_force_on_platform(angle, stand)
        return np.asarray(np.einsum("nij,nj->ni", self._turns(conditions)[conditions.mount], on_platform))

    def _additions(
        self, stage: Stage, signal: Floats, conditions: Conditions, block: Block
    ) -> Floats | float:
        total: Floats | float = 0.0
        for applied in self.effects:
            if applied.effect.stage is stage:
                rows = self._with_turns(conditions) if applied.effect.needs_path else conditions
                total = total + applied.addition(Seen(signal, rows, block))
        return total

    def _with_turns(self, conditions: Conditions) -> Conditions:
        """Return the conditions with how the block sits in them; the same object as before for the same bench."""
        kept: tuple[object, Conditions] | None = conditions.memory.get("turned")
        if kept is None or kept[0] is not self.installations:
            kept = self.installations, replace(conditions, turns=self._turns(conditions))
            conditions.memory["turned"] = kept
        return kept[1]

    def _turns(self, conditions: Conditions) -> Floats:
        """Return how the block sits in each mounting, shape (mounts, 3, 3), NaN where it is not known."""
        kept: tuple[object, Floats] | None = conditions.memory.get("turns")
        if kept is None or kept[0] is not self.installations:
            known = [self.installations.get(mount.installation) for mount in conditions.mounts]
            turns = np.stack([_UNKNOWN_TURN if i is None else i.block_from_platform for i in known])
            kept = conditions.memory["turns"] = self.installations, turns
        return kept[1]
