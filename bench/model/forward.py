"""The forward model: from the state of the bench to voltmeter readings, stage by stage, with effects."""

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
    """A forward model: the paper's model, with installations by label and additional effects.

    `name` labels the model in results: "paper" without effects, else the name in the model file. The rows of
    `conditions` must be in the order of measurement, because an effect may depend on earlier rows.
    """

    installations: Mapping[str, Installation]
    effects: tuple[AppliedEffect, ...] = field(default=())
    name: str = "paper"

    @property
    def needs_history(self) -> bool:
        """Whether a reading depends on earlier readings."""
        return any(applied.effect.needs_history for applied in self.effects)

    def specific_force(
        self, conditions: Conditions, stand_rad: Floats, block: Block, setting_error_rad: Floats | float = 0.0
    ) -> Floats:
        """Return the specific force on block axes in g, shape (n, 3).

        `stand_rad` (mounts, 5) holds the stand angles of each of `conditions.mounts`, columns as `STAND_ANGLES`.
        `setting_error_rad` is alpha4 of each reading. Raises `KeyError` for an unknown installation.
        """
        unknown = {mount.installation for mount in conditions.mounts} - set(self.installations)
        if unknown:
            raise KeyError(", ".join(sorted(unknown)))
        rows, angle_rad = stand_rad[conditions.mount], conditions.angle_rad + setting_error_rad
        static = self.static_force(conditions, *self.angles(conditions, rows, angle_rad, block))
        return self.force(static, conditions, block)

    def readings(
        self, block: Block, conditions: Conditions, stand_rad: Floats, setting_error_rad: Floats | float = 0.0
    ) -> Floats:
        """Return the predicted readings in volts, shape (n, 3); the arguments are those of `specific_force`."""
        force = self.specific_force(conditions, stand_rad, block, setting_error_rad)
        return self.voltmeter_readings(self.output(force, conditions, block), conditions, block)

    def readings_at(self, force: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the predicted readings in volts, shape (n, 3), for given specific forces instead of orientations.

        `force` (n, 3) is on block axes, in g of the bench's stated local gravity.
        """
        force = self.force(force, conditions, block)
        return self.voltmeter_readings(self.output(force, conditions, block), conditions, block)

    def output(self, force: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the voltages at the meters' terminals, V, shape (n, 3), for the acting `force` (n, 3), g."""
        return block.output(force) + self.added_to_output(force, conditions, block)

    def added_to_output(self, force: Floats, conditions: Conditions, block: Block) -> Floats | float:
        """Return what effects add to the output of the block, V, shape (n, 3), for the acting `force` (n, 3), g."""
        return self._additions(Stage.BLOCK_OUTPUT, force, conditions, block)

    def voltmeter_readings(self, voltage_v: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the meter readings, V, shape (n, 3), for the voltages `voltage_v` (n, 3) at the meters' terminals.

        The voltages may come from the block, from a short (0 V) or from a reference, in any mixture of rows.
        """
        return voltage_v + self._additions(Stage.VOLTMETER_READING, voltage_v, conditions, block)

    def angles(
        self, conditions: Conditions, stand_rad: Floats, angle_rad: Floats, block: Block
    ) -> tuple[Floats, Floats]:
        """Return stand angles (n, 5) and head angles (n,) of each reading, rad, with all effects added."""
        stand = stand_rad + self._additions(Stage.STAND, stand_rad, conditions, block)
        return stand, angle_rad + self._additions(Stage.HEAD_ANGLE, angle_rad, conditions, block)

    def force(self, static: Floats, conditions: Conditions, block: Block) -> Floats:
        """Return the acting force (n, 3), g: the `static` force (n, 3) with the additions of all effects."""
        return static + self._additions(Stage.SPECIFIC_FORCE, static, conditions, block)

    def static_force(self, conditions: Conditions, stand_rad: Floats, angle_rad: Floats) -> Floats:
        """Return the static specific force on block axes in g, shape (n, 3), NaN in an unknown installation.

        `stand_rad` (n, 5) and `angle_rad` (n,) are the stand and head angles of each reading, all effects included.
        """
        on_platform = specific_force_on_platform(angle_rad, stand_rad)
        _, turns = self._turned(conditions)
        return np.asarray(np.einsum("nij,nj->ni", turns[conditions.mount], on_platform))

    def _additions(
        self, stage: Stage, signal: Floats, conditions: Conditions, block: Block
    ) -> Floats | float:
        total: Floats | float = 0.0
        for applied in self.effects:
            if applied.effect.stage is stage:
                total = total + self.addition(applied, signal, conditions, block)
        return total

    def addition(
        self, applied: AppliedEffect, signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return what one effect adds at its stage to the `signal` there (see `Stage`)."""
        rows = self._turned(conditions)[0] if applied.effect.needs_path else conditions
        return applied.addition(Seen(signal, rows, block))

    def _turned(self, conditions: Conditions) -> tuple[Conditions, Floats]:
        """Return the conditions with `turns` filled in, and `turns`; a second call returns the same objects."""
        kept: tuple[object, Conditions, Floats] | None = conditions.memory.get("turned")
        if kept is None or kept[0] is not self.installations:
            known = [self.installations.get(mount.installation) for mount in conditions.mounts]
            turns = np.stack([_UNKNOWN_TURN if i is None else i.block_from_platform for i in known])
            kept = self.installations, replace(conditions, turns=turns), turns
            conditions.memory["turned"] = kept
        return kept[1:]


class Stages:
    """The forward model from stand to readings, evaluated once; the results of all stages are kept.

    After a change of one effect or of the block, only the later stages are evaluated again.

    `readings` are the predicted readings in V, shape (n, 3), for a mixture of signal, shorted and reference rows in
    the order of measurement. Where `force` (n, 3), in g, is not NaN, it replaces the force of the installation.
    Where `voltage_v` (n, 3) is not NaN, it replaces the block's signal at the meter inputs. A row in an unknown
    installation is NaN unless `force` or `voltage_v` is given for it. Other arguments are as for
    `ForwardModel.specific_force`.
    """

    def __init__(
        self,
        model: ForwardModel,
        block: Block,
        conditions: Conditions,
        stand_rad: Floats,
        setting_error_rad: Floats | float = 0.0,
        *,
        force: Floats | None = None,
        voltage_v: Floats | None = None,
    ) -> None:
        self.model, self._given = model, (conditions, block)
        self._known_force, self._known_v = force, voltage_v
        rows, angle_rad = stand_rad[conditions.mount], conditions.angle_rad + setting_error_rad
        self._stand, self._angle = model.angles(conditions, rows, angle_rad, block)
        static = self._static(self._stand, self._angle)
        self._force = model.force(static, *self._given)
        self._in_output = model.added_to_output(self._force, *self._given)
        self._voltage_v = block.output(self._force) + self._in_output
        self._signals = {
            Stage.STAND: rows,
            Stage.HEAD_ANGLE: angle_rad,
            Stage.SPECIFIC_FORCE: static,
            Stage.BLOCK_OUTPUT: self._force,
            Stage.VOLTMETER_READING: _unless_known(voltage_v, self._voltage_v),
        }
        self._own: dict[int, Floats] = {}
        self.readings = self._read(self._voltage_v)

    def of(self, block: Block) -> Floats:
        """Return the readings in V, shape (n, 3), of another block at the same specific force."""
        conditions, own = self._given
        same = np.array_equal(np.diag(block.K), np.diag(own.K))  # all that effects see of a block
        added = self._in_output if same else self.model.added_to_output(self._force, conditions, block)
        voltage_v = _unless_known(self._known_v, block.output(self._force) + added)
        return self.model.voltmeter_readings(voltage_v, conditions, block)

    def instead(self, old: AppliedEffect | None, new: AppliedEffect) -> Floats:
        """Return the readings in V, shape (n, 3), after the effect `new` replaces the effect `old`.

        Both act at the same stage; `old` is an effect of the model, or None to add `new` to the model.
        """
        model, stage = self.model, new.effect.stage
        change = model.addition(new, self._signals[stage], *self._given)
        if old is not None:
            if id(old) not in self._own:
                self._own[id(old)] = model.addition(old, self._signals[stage], *self._given)
            change = change - self._own[id(old)]
        if stage is Stage.VOLTMETER_READING:
            return self.readings + change
        if stage is Stage.BLOCK_OUTPUT:
            return self._read(self._voltage_v + change)
        if stage is Stage.SPECIFIC_FORCE:
            force = self._force + change
        else:
            stand = self._stand + change if stage is Stage.STAND else self._stand
            angle = self._angle + change if stage is Stage.HEAD_ANGLE else self._angle
            force = model.force(self._static(stand, angle), *self._given)
        return self._read(model.output(force, *self._given))

    def _static(self, stand_rad: Floats, angle_rad: Floats) -> Floats:
        static = self.model.static_force(self._given[0], stand_rad, angle_rad)
        return _unless_known(self._known_force, static)

    def _read(self, voltage_v: Floats) -> Floats:
        return self.model.voltmeter_readings(_unless_known(self._known_v, voltage_v), *self._given)


def _unless_known(known: Floats | None, computed: Floats) -> Floats:
    """Return `known` where it is given and not NaN, elsewhere `computed`."""
    return computed if known is None else np.where(np.isnan(known), computed, known)
