"""What an effect is: one small class that the simulator applies, the fit estimates, the report names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Mask
from bench.model.conditions import Conditions
from bench.model.geometry import Block


class Stage(StrEnum):
    """Where in the chain an effect acts, in the order of the chain.

    The signal that `Effect.addition` sees and adds to: the stand angles of each row in rad (n, 5), columns
    as `STAND_ANGLES`; the head's angle in rad (n,); the specific force on block axes in g (n, 3), of which
    an effect at BLOCK_OUTPUT makes volts (n, 3); the voltage at the meter's terminals in V (n, 3).
    """

    STAND = "stand"
    HEAD_ANGLE = "head angle"
    SPECIFIC_FORCE = "specific force"
    BLOCK_OUTPUT = "block output"
    VOLTMETER_READING = "voltmeter reading"


class Subsystem(StrEnum):
    """What an effect belongs to. Of two explanations in the same one, the plainer is preferred."""

    BLOCK = "block"
    STAND = "stand"
    VOLTMETER = "voltmeter"
    SITE = "site"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: the unit it is written in, its SI size, a plausible 1-sigma size in SI.

    `per_channel` parameters have a value for each of x, y, z (zero where a channel has none of it). One with
    a `grid` (SI) is a shape (a time constant, a width, a harmonic): the readings are not linear in it, so a
    fit holds it fixed and the naming tries the grid. It is `default` where nobody states it; a size is zero.
    """

    name: str
    unit: str
    si_per_unit: float
    plausible: float
    per_channel: bool
    grid: tuple[float, ...] = ()
    default: float = 0.0

    @property
    def is_shape(self) -> bool:
        """Whether it says what form the effect has, not how large it is."""
        return bool(self.grid)


Values = Mapping[str, Floats]
"""Values of an effect's parameters by name, SI: shape (3,) for a per-channel parameter, () else."""


@dataclass(frozen=True)
class Seen:
    """What an effect sees: the `signal` that its stage receives (see `Stage`), the rows it is of, the block."""

    signal: Floats
    conditions: Conditions
    block: Block

    @property
    def scale(self) -> Floats:
        """Scale factors K_ii of the channels along their own axes, V/g, shape (3,)."""
        return np.diag(self.block.K)


class Effect(ABC):
    """An effect of the forward model. Stateless: its parameters' values are passed in.

    `sentence` says what it is, `shown_by` what measurement would show it. A `per_mount` effect may be of
    one mounting alone; one that `lasts` stays from that mounting on to the end of
    the run. A `per_pass` effect may be of some passes
    of a mounting alone; it may go on through remounts where it `outlasts_mount`. `apart` are sets of parameters
    that it may have without the others, where they are not as their names tell. `needs_history` is true where a
    reading depends on the rows before it, `needs_path` where it depends on how the head came there.
    """

    name: str
    stage: Stage
    subsystem: Subsystem
    parameters: tuple[Parameter, ...]
    sentence: str
    shown_by: str
    per_mount: bool = False
    lasts: bool = False
    per_pass: bool = False
    outlasts_mount: bool = False
    apart: tuple[tuple[str, ...], ...] = ()
    needs_history: bool = False
    needs_path: bool = False

    @abstractmethod
    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return what the effect adds at its stage, in the unit of the stage's output, for what it has seen.

        `values` holds an array for each parameter: shape (3,) per channel, else shape ().
        """


class BlockEffect(Effect):
    """Of the accelerometers themselves: from the specific force, g, what is added to their signals, V."""

    stage = Stage.BLOCK_OUTPUT
    subsystem = Subsystem.BLOCK


class StandEffect(Effect):
    """Of the stand: what is added to its angles, rad."""

    stage = Stage.STAND
    subsystem = Subsystem.STAND


class HeadEffect(Effect):
    """Of the head and its scale: what is added to its angle, rad."""

    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND


class VoltmeterEffect(Effect):
    """Of the voltmeters: what is added to the voltages at their terminals, V."""

    stage = Stage.VOLTMETER_READING
    subsystem = Subsystem.VOLTMETER


def angle(name: str, plausible_arcsec: float) -> Parameter:
    """Return a parameter that is an angle, the same for all channels, with its plausible size."""
    return Parameter(name, "arcsec", ARCSEC, plausible_arcsec * ARCSEC, per_channel=False)


def wave(values: Values, phase: Floats, prefix: str = "") -> Floats:
    """Return c cos(phase) + s sin(phase), c and s the parameters `cosine` and `sine` after a prefix."""
    return values[f"{prefix}cosine"] * np.cos(phase) + values[f"{prefix}sine"] * np.sin(phase)


PASS: Final = " pass "
"""Between a mounting and the number of a pass, in what names one pass of it."""


def pass_label(mounting: str, number: int) -> str:
    """Return what names a pass of a mounting: "2 pass 1"."""
    return f"{mounting}{PASS}{number}"


def rows_of(installations: Sequence[str], conditions: Conditions) -> Mask:
    """Return which rows are of these mountings, or passes of one, shape (n,)."""
    has = np.array([str(mount) in installations for mount in conditions.mounts], dtype=bool)
    rows: Mask = has[conditions.mount]
    if any(PASS in label for label in installations):
        cells = list(zip(conditions.mount.tolist(), conditions.pass_number.tolist(), strict=True))
        named = {
            cell: pass_label(str(conditions.mounts[cell[0]]), cell[1]) in installations for cell in set(cells)
        }
        rows = rows | np.array([named[cell] for cell in cells], dtype=bool)
    return rows


@dataclass(frozen=True)
class AppliedEffect:
    """An effect with values, as a bench or a model file states it.

    `values` are SI: shape (3,) for a per-channel parameter, () else; a size left out is zero, a shape its
    default. `u` are their standard uncertainties where they are known. `installations` are the mountings
    that have the effect, as `str(Mount)`: "2", in series 3 "2/3", or single passes of them: "2 pass 1"
    (`pass_label`); none named is all of them. `either_of` are the names of which nobody could say which it is,
    its own among them; empty where its name stands alone.
    """

    effect: Effect
    values: Values
    channels: tuple[str, ...] = CHANNELS
    u: Values = field(default_factory=dict)
    installations: tuple[str, ...] = ()
    either_of: tuple[str, ...] = ()

    def complete_values(self) -> dict[str, Floats]:
        """Return the values of all parameters, zeros and default shapes filled in."""
        return {
            p.name: np.asarray(
                self.values[p.name]
                if p.name in self.values
                else np.full(3 if p.per_channel else (), p.default),
                dtype=np.float64,
            )
            for p in self.effect.parameters
        }

    def shapes_text(self) -> str:
        """Return its shapes as written in files, such as "tau 20 min"; empty for an effect without."""
        values = self.complete_values()
        shapes = [p for p in self.effect.parameters if p.is_shape]
        units = {p.name: "" if p.unit == "1" else f" {p.unit}" for p in shapes}
        return ", ".join(f"{p.name} {float(values[p.name]) / p.si_per_unit:g}{units[p.name]}" for p in shapes)

    def rows(self, conditions: Conditions) -> Mask:
        """Return where the effect acts, shape (n,)."""
        if not self.installations:
            return np.ones(len(conditions), dtype=bool)
        rows = rows_of(self.installations, conditions)
        if not self.effect.lasts:
            return rows
        began_s = np.zeros(len(rows)) if conditions.began_s is None else conditions.began_s
        for began in np.unique(began_s):
            run = began_s == began
            rows[run] = np.logical_or.accumulate(rows[run])
        return rows

    def addition(self, seen: Seen) -> Floats:
        """Return what the effect adds with its values, zero outside its mountings (see `Effect.addition`)."""
        added = self.effect.addition(self.complete_values(), seen)
        if not self.installations:
            return added
        rows = self.rows(seen.conditions)
        return np.where(rows.reshape(-1, *(1,) * (added.ndim - 1)), added, 0.0)


# --- the open part of a shape -----------------------------------------------------------------------
# A warm-up found with a time constant of 20 min may have others in part. The readings determine some sums of these
# parts and leave others open. Each open sum is an effect of one size with standard deviation 1.

PART: Final = "part"
"""The one parameter: how much of the sum there is."""


@dataclass(frozen=True)
class InPart(Effect):
    """A sum of effects of one stage with fixed values, `parts`, times its size; `of` is what it belongs to."""

    name: str
    of: str
    parts: tuple[AppliedEffect, ...]
    parameters: tuple[Parameter, ...] = (Parameter(PART, "1", 1.0, plausible=1.0, per_channel=False),)

    def __post_init__(self) -> None:
        """Take over what the parts have. Raises `ValueError` for parts that cannot be added to each other."""
        effects = [applied.effect for applied in self.parts]
        if len({effect.stage for effect in effects}) != 1:
            raise ValueError("the parts of a shape act at one stage of the model")
        told = {
            "stage": effects[0].stage,
            "subsystem": effects[0].subsystem,
            "sentence": f"what the readings do not tell of the shape of {self.of}",
            "shown_by": effects[0].shown_by,
            "needs_history": any(effect.needs_history or effect.lasts for effect in effects),
            "needs_path": any(effect.needs_path for effect in effects),
        }
        for name, value in told.items():
            object.__setattr__(self, name, value)

    @property
    def title(self) -> str:
        """What results call its size: "warm_up in other shapes (1)"."""
        return f"{self.of} in other shapes ({self.name.rpartition('_')[2]})"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the size times the sum of the parts (see `Effect.addition`)."""
        whole = np.sum([applied.addition(seen) for applied in self.parts], axis=0)
        return np.asarray(values[PART] * whole)


def in_part(of: str, number: int, parts: tuple[AppliedEffect, ...], value: float, u: float) -> AppliedEffect:
    """Return one way in which the shape of an effect is open, with its size and the u of that."""
    effect = InPart(f"{of}_shape_{number}", of, parts)
    return AppliedEffect(effect, {PART: np.asarray(value)}, u={PART: np.asarray(u)})
