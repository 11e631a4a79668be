"""What an effect is: one small class that the simulator applies, the fit estimates, the report names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bench.model.block import Block
from bench.model.conditions import Conditions

Floats = NDArray[np.float64]
CHANNELS = ("x", "y", "z")


class Stage(StrEnum):
    """Where in the chain an effect acts, in the order of the chain.

    The signal that `Effect.addition` sees and adds to: the head's angle in rad (n,); the specific force
    on block axes in g (n, 3), of which an effect at BLOCK_OUTPUT makes volts (n, 3); the voltage at the
    meter's terminals in V (n, 3).
    """

    HEAD_ANGLE = "head angle"
    SPECIFIC_FORCE = "specific force"
    BLOCK_OUTPUT = "block output"
    VOLTMETER_READING = "voltmeter reading"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: the unit it is written in, its SI size, a plausible 1-sigma size in SI.

    `per_channel` parameters have a value for each of x, y, z (zero where a channel has none of it).
    """

    name: str
    unit: str
    si_per_unit: float
    plausible: float
    per_channel: bool


class Effect(ABC):
    """An effect of the forward model. Stateless: its parameters' values are passed in.

    `sentence` says what it is, `shown_by` what measurement would show it.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    parameters: ClassVar[tuple[Parameter, ...]]
    sentence: ClassVar[str]
    shown_by: ClassVar[str]

    @abstractmethod
    def addition(
        self, values: Mapping[str, Floats], signal: Floats, conditions: Conditions, block: Block
    ) -> Floats:
        """Return what the effect adds at its stage, in the unit of the stage's output.

        `values` holds an array for each parameter: shape (3,) per channel, else shape ().
        `signal` is what the stage receives (see `Stage`).
        """


@dataclass(frozen=True)
class AppliedEffect:
    """An effect with values, as a bench or a model file states it.

    `values` are SI: shape (3,) for a per-channel parameter, () else; a parameter left out is zero.
    `u` are their standard uncertainties where they are known.
    """

    effect: Effect
    values: Mapping[str, Floats]
    channels: tuple[str, ...] = CHANNELS
    u: Mapping[str, Floats] = field(default_factory=dict)

    def complete_values(self) -> dict[str, Floats]:
        """Return the values of all parameters, zeros filled in."""
        return {
            p.name: np.asarray(
                self.values.get(p.name, np.zeros(3 if p.per_channel else ())), dtype=np.float64
            )
            for p in self.effect.parameters
        }
