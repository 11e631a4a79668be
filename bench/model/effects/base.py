"""The base classes of effects: one class serves to simulate an effect, to fit it and to name it in reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, MINUTE, Floats, Mask
from bench.model.conditions import Conditions
from bench.model.geometry import Block


class Stage(StrEnum):
    """The stage of the measuring chain at which an effect acts, in the order of the chain.

    `Effect.addition` receives the signal at its stage, and its result is added to this signal: at STAND the stand
    angles in rad (n, 5), columns as `STAND_ANGLES`; at HEAD_ANGLE the head angle in rad (n,); at SPECIFIC_FORCE the
    force on block axes in g (n, 3); at VOLTMETER_READING the voltage at the meter terminals in V (n, 3). At
    BLOCK_OUTPUT an effect receives the force in g (n, 3) and returns volts (n, 3).
    """

    STAND = "stand"
    HEAD_ANGLE = "head angle"
    SPECIFIC_FORCE = "specific force"
    BLOCK_OUTPUT = "block output"
    VOLTMETER_READING = "voltmeter reading"


class EffectMistake(ValueError):
    """An effect's class does not keep its promises; the text says which."""


class Subsystem(StrEnum):
    """The part of the bench to which an effect belongs.

    If two effects of one part explain the readings, the diagnosis prefers the simpler.
    """

    BLOCK = "block"
    STAND = "stand"
    VOLTMETER = "voltmeter"
    SITE = "site"


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: its `unit` in files, the SI value of this unit, and a plausible value in SI.

    The plausible value is a standard deviation. A `per_channel` parameter has a value for each of x, y, z, zero for
    a channel without the effect. There are three kinds of parameters: sizes, shapes and starting states. The effect
    is proportional to a size.

    A shape has a `grid` of SI values; examples are a time constant, a width or a harmonic. The readings are not
    linear in a shape. A fit therefore keeps it constant, and the diagnosis fits the effect with each value of the
    grid. A shape that a file does not state has the value `default`.

    A starting state is the state of the effect at the start of a mounting, with a new value in every mounting and
    run. It is proportional to the size that `start_of` names (`Effect.start_spread`). A fit estimates a starting
    state only if its u is stated.
    """

    name: str
    unit: str
    si_per_unit: float
    plausible: float
    per_channel: bool
    grid: tuple[float, ...] = ()
    default: float = 0.0
    start_of: str = ""

    @property
    def is_shape(self) -> bool:
        """Whether the parameter determines the form of the effect and not its amount."""
        return bool(self.grid)

    @property
    def is_size(self) -> bool:
        """Whether the effect is proportional to the parameter: neither a shape nor a starting state."""
        return not self.grid and not self.start_of


Values = Mapping[str, Floats]
"""Values of an effect's parameters by name, SI: shape (3,) for a per-channel parameter, else ()."""


@dataclass(frozen=True)
class Seen:
    """The input of an effect: the `signal` at its stage (see `Stage`), the conditions of the rows, the block."""

    signal: Floats
    conditions: Conditions
    block: Block

    @property
    def scale(self) -> Floats:
        """Scale factors K_ii of the channels along their own axes, V/g, shape (3,)."""
        return self.block.K.diagonal()


class Effect(ABC):
    """An effect of the forward model. Stateless: the values of its parameters are passed in.

    `sentence` describes the effect; `shown_by` names a measurement that would show it; `shows_on` names the parts
    of the bench where it shows (`docs/generators/effects.py`). A `per_mount` effect may act in single mountings; if
    it `lasts`, it acts from that mounting to the end of the run. A `per_pass` effect may act in single passes of a
    mounting; if it `outlasts_mount`, it may continue through remounts. `apart` lists the sets of parameters that
    the diagnosis fits while the other parameters are zero; if it is empty, the names of the parameters determine
    the sets. `needs_history` is true if a reading depends on earlier rows, `needs_path` if it depends on the path
    of the head to the setting. `start_repeats` is true if the approach of the head to its first setting determines
    the starting state, so that mountings with the same approach have the same state.
    """

    name: str
    stage: Stage
    subsystem: Subsystem
    parameters: tuple[Parameter, ...]
    sentence: str
    shown_by: str
    shows_on: tuple[str, ...] = ()
    per_mount: bool = False
    lasts: bool = False
    per_pass: bool = False
    outlasts_mount: bool = False
    apart: tuple[tuple[str, ...], ...] = ()
    needs_history: bool = False
    needs_path: bool = False
    start_repeats: bool = False

    @abstractmethod
    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the amount that the effect adds at its stage, in the unit of the stage's output.

        `values` holds an array for each parameter: shape (3,) if per channel, else ().
        """

    def start_spread(self, conditions: Conditions) -> float:
        """Return the standard deviation of the starting state divided by the size named in `start_of`, SI.

        The number has no meaning for an effect without a starting state (see `Parameter`).
        """
        del conditions
        return 1.0


class BlockEffect(Effect):
    """An effect of the accelerometers: it depends on the specific force in g, and adds to their signals in V."""

    stage = Stage.BLOCK_OUTPUT
    subsystem = Subsystem.BLOCK
    shows_on: tuple[str, ...] = ("block",)


class StandEffect(Effect):
    """An effect of the stand: an addition to its angles, rad."""

    stage = Stage.STAND
    subsystem = Subsystem.STAND


class HeadEffect(Effect):
    """An effect of the head and its scale: an addition to the head angle, rad.

    `order` is the number of periods per turn if the effect is a sine of the head angle, else None.
    """

    order: int | None = None
    stage = Stage.HEAD_ANGLE
    subsystem = Subsystem.STAND
    shows_on = ("head",)


class VoltmeterEffect(Effect):
    """An effect of the voltmeters: an addition to the voltages at their terminals, V."""

    stage = Stage.VOLTMETER_READING
    subsystem = Subsystem.VOLTMETER
    shows_on = ("voltmeters",)


def angle(name: str, plausible_arcsec: float) -> Parameter:
    """Return the parameter `name`, an angle common to all channels, with a plausible value."""
    return Parameter(name, "arcsec", ARCSEC, plausible_arcsec * ARCSEC, per_channel=False)


def wave(values: Values, phase: Floats, prefix: str = "") -> Floats:
    """Return c cos(phase) + s sin(phase) for phases (n,), rad.

    c and s are the values of `<prefix>cosine` and `<prefix>sine`.
    """
    return values[f"{prefix}cosine"] * np.cos(phase) + values[f"{prefix}sine"] * np.sin(phase)


def lagged(signal: Floats, time_s: Floats, lag_s: float) -> Floats:
    """Return a signal (n,) after a first-order lag that was in equilibrium at its first value.

    The solution is exact for a signal linear between the times. Rows at equal times have equal results; where the
    time falls, a new run begins, and the result restarts from the signal.
    """
    if lag_s <= 0.0 or len(signal) == 0:
        return signal
    elapsed = np.diff(time_s)
    with np.errstate(all="ignore"):  # times that are equal or fall are handled below
        rises = (np.diff(signal) * lag_s / elapsed).tolist()
        decays = np.exp(-elapsed / lag_s).tolist()
    values = signal.tolist()
    behind = values[:1]
    for i, (after, rise, decay) in enumerate(zip(elapsed.tolist(), rises, decays, strict=True)):
        if after < 0.0:
            behind.append(values[i + 1])
        elif after == 0.0:
            behind.append(behind[i])
        else:
            behind.append(values[i + 1] - rise + (behind[i] - values[i] + rise) * decay)
    return np.array(behind)


def warmth_behind(conditions: Conditions, lag_s: float) -> Floats:
    """Return `Conditions.warmth_k` after a first-order lag, K, shape (n,); it is cached in the conditions."""
    kept = conditions.memory
    if ("warmth", lag_s) not in kept:
        kept["warmth", lag_s] = lagged(conditions.warmth_k, conditions.elapsed_s, lag_s)
    known: Floats = kept["warmth", lag_s]
    return known


def fading(conditions: Conditions, lag_s: float) -> Floats:
    """Return the fraction (n,) that remains, at each row, of a deviation at the start of its mounting.

    It is exp(-t / `lag_s`), with t since the first reading of the mounting; a `lag_s` of 0 gives 0.
    """
    if lag_s <= 0.0:
        return np.zeros(len(conditions))
    return np.asarray(np.exp(-conditions.since_mounting_s / lag_s))


def lag_of(*minutes: int) -> Parameter:
    """Return the shape parameter of a lag; its grid is zero and the given `minutes`."""
    grid = (0.0, *(m * MINUTE for m in minutes))
    return Parameter("lag", "min", MINUTE, plausible=10 * MINUTE, per_channel=False, grid=grid)


def time_constant(*minutes: int) -> Parameter:
    """Return the shape parameter "tau" of an exponential decay: grid `minutes`, default 20 min."""
    grid = tuple(m * MINUTE for m in minutes)
    return Parameter(
        "tau", "min", MINUTE, plausible=20 * MINUTE, per_channel=False, grid=grid, default=20 * MINUTE
    )


def play(signal: Floats, width: float) -> Floats:
    """Return a signal (n,) after a mechanical play of half-width `width`, centred on the first value."""
    if width <= 0.0 or len(signal) == 0:
        return signal
    behind = np.empty_like(signal)
    at = signal[0]
    for i, value in enumerate(signal.tolist()):
        at = min(max(at, value - width), value + width)
        behind[i] = at
    return behind


PASS: Final = " pass "
"""The text between mounting and pass number in the label of a pass."""


def pass_label(mounting: str, number: int) -> str:
    """Return the label of one pass of a mounting, such as "2 pass 1"."""
    return f"{mounting}{PASS}{number}"


def rows_of(installations: Sequence[str], conditions: Conditions) -> Mask:
    """Return the mask (n,) of the rows in these mountings or passes, labelled as "2" or "2 pass 1"."""
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
    """An effect with parameter values, as stated in a bench file or a model file.

    `values` and their standard uncertainties `u`, where known, are in SI: shape (3,) for a per-channel parameter,
    else (). A shape without a value has its default; any other parameter without a value is zero. `installations`
    are the mountings (`str(Mounting)`: "2", in series 3 "2/3") or passes (`pass_label`: "2 pass 1") in which the
    effect acts; empty means all. `either_of` lists this effect and the effects that the readings cannot distinguish
    from it; it is empty if there are none.
    """

    effect: Effect
    values: Values
    channels: tuple[str, ...] = CHANNELS
    u: Values = field(default_factory=dict)
    installations: tuple[str, ...] = ()
    either_of: tuple[str, ...] = ()

    def complete_values(self) -> dict[str, Floats]:
        """Return the values of all parameters; missing shapes have their default, others are 0 if missing."""
        return {
            p.name: np.asarray(
                self.values.get(p.name, (p.default,) * 3 if p.per_channel else p.default), dtype=np.float64
            )
            for p in self.effect.parameters
        }

    def shapes_text(self) -> str:
        """Return the shape parameters as text, such as "tau 20 min"; empty for an effect without shapes."""
        values = self.complete_values()
        shapes = [p for p in self.effect.parameters if p.is_shape]
        units = {p.name: "" if p.unit == "1" else f" {p.unit}" for p in shapes}
        return ", ".join(f"{p.name} {float(values[p.name]) / p.si_per_unit:g}{units[p.name]}" for p in shapes)

    def rows(self, conditions: Conditions) -> Mask:
        """Return the mask (n,) of the rows in which the effect acts."""
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
        """Return what the effect adds to the signal at its stage, zero in rows where it does not act.

        Shape and unit are those of `Effect.addition`. Raises `EffectMistake` for another shape, which numpy would
        add to all rows or columns.
        """
        added = self.effect.addition(self.complete_values(), seen)
        if isinstance(added, int | float) and added == 0:  # such as an empty sum
            return np.zeros_like(seen.signal)
        if np.shape(added) != np.shape(seen.signal):
            shape = np.shape(added) or type(added).__name__
            raise EffectMistake(
                f"effect {self.effect.name}: its addition returns {shape}, not an array of the signal's shape "
                f"{np.shape(seen.signal)}; correct its class"
            )
        if not self.installations:
            return added
        rows = self.rows(seen.conditions)
        return np.where(rows.reshape(-1, *(1,) * (added.ndim - 1)), added, 0.0)


# --- the open part of a shape -----------------------------------------------------------------------
# A warm-up found with a time constant of 20 min may include components with other time constants. The readings
# determine some linear combinations of these components and leave others open. Each open combination is an effect
# with one size, of standard deviation 1.

PART: Final = "part"
"""The only parameter of an `InPart` effect: the factor on the sum of its parts."""


@dataclass(frozen=True)
class InPart(Effect):
    """A correction for the uncertain shape of the effect `of`: a multiple of the sum of its `parts`.

    The parts are effects with fixed values; the only parameter is the factor on their sum, which a fit may
    estimate. Raises `ValueError` if the parts act at different stages.
    """

    name: str
    of: str
    parts: tuple[AppliedEffect, ...]
    parameters: tuple[Parameter, ...] = (Parameter(PART, "1", 1.0, plausible=1.0, per_channel=False),)

    def __post_init__(self) -> None:
        """Derive the class attributes from the parts. Raises `ValueError` if the parts act at different stages."""
        effects = [applied.effect for applied in self.parts]
        if len({effect.stage for effect in effects}) != 1:
            raise ValueError("the parts of a shape must act at one stage of the model")
        told = {
            "stage": effects[0].stage,
            "subsystem": effects[0].subsystem,
            "sentence": f"what the readings leave open about the shape of {self.of}",
            "shown_by": effects[0].shown_by,
            "needs_history": any(effect.needs_history or effect.lasts for effect in effects),
            "needs_path": any(effect.needs_path for effect in effects),
        }
        for name, value in told.items():
            object.__setattr__(self, name, value)

    @property
    def title(self) -> str:
        """The name of the effect in results: "warm_up in other shapes (1)"."""
        return f"{self.of} in other shapes ({self.name.rpartition('_')[2]})"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the factor times the sum of the parts (see `Effect.addition`)."""
        whole = np.sum([applied.addition(seen) for applied in self.parts], axis=0)
        return np.asarray(values[PART] * whole)


def in_part(of: str, number: int, parts: tuple[AppliedEffect, ...], value: float, u: float) -> AppliedEffect:
    """Return correction `number` of the shape of the effect `of`; `u` is the u of its factor `value`."""
    effect = InPart(f"{of}_shape_{number}", of, parts)
    return AppliedEffect(effect, {PART: np.asarray(value)}, u={PART: np.asarray(u)})
