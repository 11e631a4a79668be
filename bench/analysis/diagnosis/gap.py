"""The gap on readings held out, and the rule by which it shrinks: what a name alone and a model file rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.posterior import NoiseSize
from bench.base.arrays import Floats

FLOOR: Final = 1.0
"""Reduced chi-square of readings held out when nothing is missing."""

LEAST_FALL: Final = 4.0
"""By so much must the chi-square of readings held out fall, in all and by each effect.

An effect that is not there, of whatever size, gains so much from their noise in no more than 2.3 %.
"""

LEAST_CLOSED: Final = 0.5
"""So much of what is above the floor must close, where it is above it by more than chance."""

BY_CHANCE: Final = 0.01
"""A gap that chance alone reaches so often is none: of that, no part can be asked for."""

BLIND: Final = "the rest could not have shown what was found"
NOT_THERE: Final = "what was found does not show there"
OWN_VALUE: Final = "what was found has a value of its own there, of which the rest says nothing"
BLINDNESS: Final = (BLIND, NOT_THERE, OWN_VALUE)
UNDETERMINED: Final = "the rest does not determine the coefficients"


@dataclass(frozen=True)
class HeldOut:
    """Measured less predicted in readings held out (n,), in the unit of the signal and in g, and its chi-square.

    `expected_g` (n,) is the standard deviation that noise and all that was estimated give it.
    """

    error: Floats
    error_g: Floats
    expected_g: Floats
    chi2: float

    @property
    def reduced(self) -> float:
        """Chi-square over the number of rows."""
        return self.chi2 / len(self.error)


@dataclass(frozen=True)
class Fold:
    """Readings held out, predicted by the model as it was given and with what the others named.

    `gains` says of each name that the search on the others gave by how much the chi-square is smaller for it.
    `blind` is why they cannot confirm what was found, as worked out before these were opened; empty where they can.
    """

    label: str
    gains: Mapping[str, float]
    before: HeldOut
    after: HeldOut
    blind: str

    @property
    def confirmable(self) -> bool:
        """Whether the others could have shown what was found."""
        return not self.blind

    @property
    def counted(self) -> bool:
        """Whether it counts: it can confirm what was found, or what the others named makes it worse."""
        worse = self.after.chi2 - self.before.chi2 >= LEAST_FALL
        return self.confirmable or (worse and self.blind == BLIND)

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "what": self.label,
            "confirmable": self.confirmable,
            "counted": self.counted,
            "left_out": None if self.counted else self.blind,
            "named_without_it": list(self.gains),
            "before": self.before.reduced,
            "after": self.after.reduced,
            "before_rms_ug": 1e6 * rms([self.before.error_g]),
            "after_rms_ug": 1e6 * rms([self.after.error_g]),
        }


@dataclass(frozen=True)
class Gap:
    """Reduced chi-square of the readings held out, before and after; its expectation is 1 (`floor`).

    `named` are the names that should close it. `undetermined` are readings that could not be held out, because the
    others do not determine the coefficients.
    """

    folds: tuple[Fold, ...]
    noise: NoiseSize
    unit: str
    freedom: int
    named: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()

    @property
    def opened(self) -> tuple[Fold, ...]:
        """The folds that count."""
        return tuple(f for f in self.folds if f.counted)

    @property
    def left_out(self) -> tuple[Fold, ...]:
        """The folds that do not."""
        return tuple(f for f in self.folds if not f.counted)

    @property
    def count(self) -> int:
        """Rows in those that count."""
        return sum(len(f.before.error) for f in self.opened)

    @property
    def before(self) -> float:
        """Reduced chi-square of the model that was given."""
        return sum(f.before.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square with what was named, each fold by itself."""
        return sum(f.after.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def closed(self) -> float | None:
        """The part of what is above the floor that naming closes; None where nothing is above it."""
        return part_closed(self.before, self.after) if self.opened else None

    @property
    def p_after(self) -> float:
        """Probability of more than `after` by chance."""
        return self._chance(self.after)

    def _chance(self, reduced: float) -> float:
        return float(special.fdtrc(self.count, self.freedom, reduced)) if self.count else float("nan")

    @property
    def before_rms(self) -> float:
        """Root mean square of measured less predicted in single channels, unit of the signal."""
        return rms([f.before.error for f in self.opened])

    @property
    def after_rms(self) -> float:
        """The same with what was named."""
        return rms([f.after.error for f in self.opened])

    @property
    def before_rms_g(self) -> float:
        """Root mean square of measured less predicted, g by the scale factors."""
        return rms([f.before.error_g for f in self.opened])

    @property
    def after_rms_g(self) -> float:
        """The same with what was named."""
        return rms([f.after.error_g for f in self.opened])

    @property
    def expected_rms_g(self) -> float:
        """What `after_rms_g` is expected to be when nothing is missing."""
        return rms([f.after.expected_g for f in self.opened])

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The names that readings held out do not confirm: where the rest gave them, they gain too little."""
        return tuple(
            name
            for name in dict.fromkeys(self.named)
            if sum(fold.gains.get(name, 0.0) for fold in self.opened) < LEAST_FALL
        )

    @property
    def shrinks(self) -> bool | None:
        """Whether the gap shrinks by the rule registered; None where nothing was found, or no fold measures it.

        The chi-square falls by `LEAST_FALL`, in all and by each name; `LEAST_CLOSED` of what is above the floor
        closes, where chance does not reach that; and no root mean square rises, in the signal's unit or in g.
        """
        if not self.named or not self.opened:
            return None
        part = self.closed
        return (
            (self.before - self.after) * self.count >= LEAST_FALL
            and (part is None or part >= LEAST_CLOSED or self._chance(self.before) >= BY_CHANCE)
            and self.after_rms <= self.before_rms
            and self.after_rms_g <= self.before_rms_g
            and not self.unconfirmed
        )

    @property
    def reason(self) -> str:
        """Why readings held out do not confirm what was found; nothing where they do, or nothing was found."""
        if not self.named or self.shrinks:
            return ""
        if not self.folds:
            cannot = f"; without {', '.join(self.undetermined)} {UNDETERMINED}" if self.undetermined else ""
            return f"nothing can be held out: one pass, and no verification or free position{cannot}"
        if not self.opened:
            why = {blind: [f.label for f in self.folds if f.blind == blind] for blind in BLINDNESS}
            told = "; ".join(f"{', '.join(labels)}: {blind}" for blind, labels in why.items() if labels)
            return f"nothing held out can measure the gap ({told})"
        sizes = (
            f"reduced chi-square {self.before:.2f} before, {self.after:.2f} after, root mean square "
            f"{1e6 * self.before_rms_g:.3g} µg before, {1e6 * self.after_rms_g:.3g} µg after"
        )
        if len(set(self.named)) > len(self.unconfirmed) > 0:
            return f"readings held out do not confirm {', '.join(self.unconfirmed)} ({sizes})"
        return f"the gap on readings held out does not shrink enough ({sizes})"

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        opened = bool(self.opened)
        undetermined = [
            dict.fromkeys(("before", "after", "before_rms_ug", "after_rms_ug"))
            | {"what": label, "confirmable": False, "counted": False, "left_out": UNDETERMINED}
            | {"named_without_it": []}
            for label in self.undetermined
        ]
        return {
            "before": self.before if opened else None,
            "after": self.after if opened else None,
            "floor": FLOOR,
            "closed": self.closed,
            "shrinks": self.shrinks,
            "reason": self.reason or None,
            "p_after": self.p_after if opened else None,
            "before_rms": self.before_rms if opened else None,
            "after_rms": self.after_rms if opened else None,
            "before_rms_ug": 1e6 * self.before_rms_g if opened else None,
            "after_rms_ug": 1e6 * self.after_rms_g if opened else None,
            "expected_rms_ug": 1e6 * self.expected_rms_g if opened else None,
            "noise_rms": self.noise.reading,
            "unit": self.unit,
            "held_out": [*(f.to_dict() for f in self.folds), *undetermined],
        }


def part_closed(before: float, after: float) -> float | None:
    """Return the part of a gap above the floor that is closed; None where nothing was above it."""
    return (before - after) / (before - FLOOR) if before > FLOOR else None


def rms(parts: Sequence[Floats]) -> float:
    """Return the root mean square of all numbers together; NaN of none."""
    if not parts:
        return float("nan")
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
