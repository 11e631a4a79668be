"""What is not known of an effect's shape, as an effect: one way in which readings left it open.

A warm-up that was found with a time constant of 20 min may in part have others. Of all these parts together the
readings that it was found in tell some sums and not others; each that they left open is an effect with one size, of
which 1 is a standard deviation, independent of every other size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.model.effects.base import AppliedEffect, Effect, Parameter, Seen, Stage, Subsystem, Values

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
        """Refuse parts that cannot be added to each other."""
        if len({applied.effect.stage for applied in self.parts}) != 1:
            raise ValueError("the parts of a shape act at one stage of the model")

    @property
    def stage(self) -> Stage:  # type: ignore[override]
        """Where it acts."""
        return self.parts[0].effect.stage

    @property
    def subsystem(self) -> Subsystem:  # type: ignore[override]
        """What it belongs to."""
        return self.parts[0].effect.subsystem

    @property
    def sentence(self) -> str:  # type: ignore[override]
        """What it is."""
        return f"what the readings do not tell of the shape of {self.of}"

    @property
    def shown_by(self) -> str:  # type: ignore[override]
        """What measurement would show it."""
        return self.parts[0].effect.shown_by

    @property
    def needs_history(self) -> bool:  # type: ignore[override]
        """Whether a reading depends on those before it."""
        return any(applied.effect.needs_history or applied.effect.lasts for applied in self.parts)

    @property
    def needs_path(self) -> bool:  # type: ignore[override]
        """Whether it depends on how the head came there."""
        return any(applied.effect.needs_path for applied in self.parts)

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the size times the sum of the parts (see `Effect.addition`)."""
        whole = np.sum([applied.addition(seen) for applied in self.parts], axis=0)
        return np.asarray(values[PART] * whole)


def in_part(of: str, number: int, parts: tuple[AppliedEffect, ...], value: float, u: float) -> AppliedEffect:
    """Return one way in which the shape of an effect is open, with its size and the u of that."""
    effect = InPart(f"{of}_shape_{number}", of, parts)
    return AppliedEffect(effect, {PART: np.asarray(value)}, u={PART: np.asarray(u)})
