"""Effects that are stated as a formula, in a file: what they add is an expression and not a class of their own."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.model.effects.base import Effect, Parameter, Seen, Stage, Subsystem, Values
from bench.model.effects.expression import (
    LAGGED,
    DegreeReading,
    ExpressionError,
    ValueReading,
    calls_in,
    interpret,
    lags_in,
    names_in,
)
from bench.model.effects.thermal import lagged
from bench.model.geometry import STAND_ANGLES

SUBSYSTEM_OF: Final[Mapping[Stage, Subsystem]] = {
    Stage.STAND: Subsystem.STAND,
    Stage.HEAD_ANGLE: Subsystem.STAND,
    Stage.SPECIFIC_FORCE: Subsystem.SITE,
    Stage.BLOCK_OUTPUT: Subsystem.BLOCK,
    Stage.VOLTMETER_READING: Subsystem.VOLTMETER,
}
"""What a formula belongs to by its stage, where it does not say."""

OF_THE_HEAD: Final = ("angle", "turned", "wound", "travelled")
"""Variables that a reading without an angle of the head does not have."""


@dataclass(frozen=True)
class FormulaEffect(Effect):
    """An effect whose addition is an expression over what it sees and its parameters, in SI.

    At the stand it is added to the angle `adds_to`. At the block's output it is in g: the scale factor of the
    channel makes volts of it. Raises `ExpressionError` where the expression cannot be taken.
    """

    name: str
    stage: Stage
    subsystem: Subsystem
    parameters: tuple[Parameter, ...]
    sentence: str
    shown_by: str
    expression: str
    adds_to: str = ""
    per_mount: bool = False
    lasts: bool = False
    origin: str = field(default="", compare=False, repr=False)
    """File and line of the expression, where it was read from one: for whoever is to mend it."""

    def __post_init__(self) -> None:
        """Prove the expression: every name known, each term of the first degree in the sizes."""
        names = names_in(self.expression)
        own = {parameter.name for parameter in self.parameters}
        variables = variables_of(self.stage)
        for name in names:
            if name not in own and name not in variables:
                raise ExpressionError(_unknown_name(name, self.stage, variables))
        for parameter in self.parameters:
            if parameter.name not in names:
                raise ExpressionError(f"the parameter '{parameter.name}' does not stand in the expression")
        shapes = {parameter.name for parameter in self.parameters if parameter.is_shape}
        for lag in lags_in(self.expression):
            if not isinstance(lag, ast.Constant) and not (isinstance(lag, ast.Name) and lag.id in shapes):
                raise ExpressionError("the lag of 'lagged' is a number of seconds or a parameter with a grid")
        if (self.adds_to in STAND_ANGLES) != (self.stage is Stage.STAND):
            raise ExpressionError(
                f"'adds_to' says of an effect of the stand, and of no other, which angle: {', '.join(STAND_ANGLES)}"
            )
        sizes = frozenset(parameter.name for parameter in self.parameters if not parameter.is_shape)
        if interpret(self.expression, DegreeReading(sizes)) != 1:
            raise ExpressionError("the expression has no size in it: a parameter without a grid is one")

    @property
    def needs_history(self) -> bool:  # type: ignore[override]
        """Whether a reading depends on those before it."""
        looks_back = {"turned", "wound", "travelled", "visit"}
        return (
            self.lasts
            or LAGGED in calls_in(self.expression)
            or not looks_back.isdisjoint(names_in(self.expression))
        )

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return what is added at the stage (see `Effect.addition`); nothing where the angle is not known.

        Raises `ExpressionError` where the formula gives no finite number for a reading.
        """
        used = frozenset(names_in(self.expression))
        known = {name: of(seen) for name, of in variables_of(self.stage).items() if name in used}
        channels = self.stage in _WITH_CHANNELS
        if channels:
            known = {name: c if c.ndim == 2 else c[..., None] for name, c in known.items()}
        time_s = seen.conditions.elapsed_s
        reading = ValueReading({**known, **values}, lambda course, lag: _lagged(course, time_s, lag))
        with np.errstate(all="ignore"):
            added = interpret(self.expression, reading)
        shape = (len(seen.conditions), 3) if channels else (len(seen.conditions),)
        away = ~np.isfinite(seen.conditions.angle_rad)
        if used.isdisjoint(OF_THE_HEAD):
            away &= _unseen(known.values(), len(away))
        return self._placed(self._finite(np.broadcast_to(added, shape), away), seen)

    def _finite(self, added: Floats, away: Mask) -> Floats:
        """Return the numbers, zero in the readings `away`: without an angle of the head, or of no block at all."""
        bad = ~np.isfinite(added)
        if not bad.any():
            return added
        added = np.where(away.reshape(-1, *(1,) * (added.ndim - 1)), 0.0, added)
        bad = ~np.isfinite(added)
        if bad.any():
            row = int(np.flatnonzero(bad.reshape(len(added), -1).any(axis=1))[0])
            raise ExpressionError(
                f"{f'{self.origin}: ' if self.origin else ''}the formula of {self.name} gives no finite number for "
                f"reading {row + 1}, as a division by zero does; change the expression, "
                "such as by max(…, 1e-6) in a divisor or a logarithm"
            )
        return added

    def _placed(self, added: Floats, seen: Seen) -> Floats:
        match self.stage:
            case Stage.STAND:
                placed = np.zeros_like(seen.signal)
                placed[:, STAND_ANGLES.index(self.adds_to)] = added
                return placed
            case Stage.BLOCK_OUTPUT:
                return added * seen.scale
            case _:
                return added


_WITH_CHANNELS: Final = (Stage.SPECIFIC_FORCE, Stage.BLOCK_OUTPUT, Stage.VOLTMETER_READING)

Variable = Callable[[Seen], Floats]


def variables_of(stage: Stage) -> dict[str, Variable]:
    """Return what a formula of a stage may depend on: each a function of what it sees, shape (n,) or (n, 3)."""
    match stage:
        case Stage.SPECIFIC_FORCE | Stage.BLOCK_OUTPUT:
            return _COMMON | _own_and_each("a") | {"aj": _axis_after(1), "ak": _axis_after(2)}
        case Stage.VOLTMETER_READING:
            return _COMMON | _own_and_each("U")
        case _:
            return dict(_COMMON)


def _own_and_each(letter: str) -> dict[str, Variable]:
    """Return a signal on a channel's own axis, and on x, y and z."""
    each = {letter + channel: _axis(i) for i, channel in enumerate(CHANNELS)}
    return {letter: lambda seen: seen.signal, **each}


def _axis(number: int) -> Variable:
    return lambda seen: seen.signal[:, number]


def _axis_after(steps: int) -> Variable:
    return lambda seen: np.roll(seen.signal, -steps, axis=1)


_COMMON: Final[dict[str, Variable]] = {
    "pi": lambda seen: np.full(len(seen.conditions), np.pi),
    "angle": lambda seen: seen.conditions.angle_rad,
    "turned": lambda seen: seen.conditions.head_turns.turned,
    "wound": lambda seen: seen.conditions.head_turns.wound,
    "travelled": lambda seen: seen.conditions.head_turns.travelled,
    "direction": lambda seen: seen.conditions.direction.astype(np.float64),
    "time": lambda seen: seen.conditions.elapsed_s,
    "temperature": lambda seen: seen.conditions.warmth_k,
    "pass_number": lambda seen: seen.conditions.pass_number.astype(np.float64),
    "visit": lambda seen: seen.conditions.head_turns.visit,
}


def _lagged(course: Floats, time_s: Floats, lag: Floats) -> Floats:
    """Return a course behind a first-order lag, column by column."""
    whole = np.broadcast_to(course, (len(time_s), *np.shape(course)[1:]))
    if whole.ndim == 1:
        return lagged(whole, time_s, float(lag))
    return np.stack([lagged(column, time_s, float(lag)) for column in whole.T], axis=1)


def _unknown_name(name: str, stage: Stage, variables: Mapping[str, Variable]) -> str:
    text = f"'{name}' is neither a parameter nor a variable; at the stage '{stage}' there are"
    return f"{text} {', '.join(variables)}"


def _unseen(variables: Iterable[Floats], readings: int) -> Mask:
    """Return the readings (n,) of which a variable is not known, as `a` of an input that is short."""
    missing = np.zeros(readings, dtype=bool)
    for values in variables:
        if values.ndim and len(values) == readings:
            missing |= ~np.isfinite(values).reshape(readings, -1).all(axis=1)
    return missing
