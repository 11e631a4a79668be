"""The power supply of the block: outputs, rails and disturbances."""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from sim.world.chance import KeyedNumbers


REFERENCE_C: Final = 23.0
"""The temperature for which a rail's current is stated, °C."""

Trip = Literal["voltage", "current"]
DisturbanceKind = Literal["sag", "drift", "load", "open", "off", "cut"]
DISTURBANCES: Final[Mapping[DisturbanceKind, str]] = {
    "sag": "the output gives less than it is set to, by `size` of it",
    "drift": "its voltage runs away by `size`, V/h",
    "load": "the rail takes `size` times its current",
    "open": "a contact between output and block opens",
    "off": "somebody switches the output off at the front panel",
    "cut": "the mains fail; afterwards the supply is as it is when it is switched on",
}


@dataclass(frozen=True)
class Rail:
    """A supply rail of the block: the output that feeds it, its nominal voltage, V, and nominal current, A.

    The block works within `working_v`, V; its absolute maximum ratings are `absolute_v`, V, and `absolute_a`,
    A.
    """

    name: str
    output: str
    nominal_v: float
    working_v: tuple[float, float]
    absolute_v: tuple[float, float]
    current_a: float
    absolute_a: float = math.inf


@dataclass(frozen=True)
class PowerSettings:
    """The rails of the block, their load, and the block's signals without power.

    The current grows by the fraction `current_by_temperature` per kelvin. At switch-on it is `in_rush` times as
    large; the excess decays with the time constant `in_rush_time_s`. Without power, the offset of each signal has
    the standard deviation `dead_offset_v`, and its noise `dead_noise_v`, V.
    """

    rails: tuple[Rail, ...] = ()
    current_by_temperature: float = 2e-3
    in_rush: float = 3.0
    in_rush_time_s: float = 0.2
    dead_offset_v: float = 2e-3
    dead_noise_v: float = 5e-4


@dataclass(frozen=True)
class Disturbance:
    """A disturbance of an output (of all, if `output` is empty) from clock time `at_s` on, for `lasts_s`, s.

    `DISTURBANCES` explains each `kind` and its `size`.
    """

    kind: DisturbanceKind
    at_s: float
    output: str = ""
    size: float = 0.0
    lasts_s: float = math.inf


@dataclass(frozen=True)
class OutputPhase:
    """The state of an output from `since_s` on: switch, voltage, current limit, protection and disturbances.

    The output trips when its voltage reaches `trip_v`, or when its current was at the limit for
    `trip_after_s`; a criterion that is None never trips it. `on_since_s` is the time of the last switch-on.
    """

    since_s: float
    on: bool = False
    on_since_s: float = -math.inf
    set_v: float = 0.0
    limit_a: float = 0.0
    trip_v: float | None = None
    trip_after_s: float | None = None
    tripped: Trip | None = None
    sag: float = 0.0
    offset_v: float = 0.0
    drift_v_s: float = 0.0
    load: float = 1.0
    open: bool = False


@dataclass(frozen=True)
class OutputReading:
    """The voltage (V) and current (A) at the terminals of an output, and whether the current is limited."""

    voltage_v: float
    current_a: float
    limiting: bool


@dataclass(frozen=True)
class Violation:
    """A period in which a rail was outside its absolute maximum ratings; `value` is the worst, in `unit`."""

    rail: str
    from_s: float
    to_s: float
    value: float
    unit: Literal["V", "A"]


_CLOSE_S: Final = 1e-6
"""The tolerance of the time at which a rail crosses a limit, s."""


def dead_v(settings: PowerSettings, numbers: KeyedNumbers, channel: str, time_s: float) -> float:
    """Return the signal of a block output without power, V: a small offset and noise."""
    offset = numbers.fixed_random("dead signal", channel).standard_normal()
    noise = numbers.fixed_random("dead signal", channel, f"{time_s:.6f}").standard_normal()
    return float(settings.dead_offset_v * offset + settings.dead_noise_v * noise)


@dataclass
class _Output:
    stages: list[OutputPhase]
    rails: tuple[Rail, ...] = field(default=())

    @property
    def last(self) -> OutputPhase:
        return self.stages[-1]

    def at(self, time_s: float) -> OutputPhase:
        index = bisect_right(self.stages, time_s, key=lambda stage: stage.since_s) - 1
        return self.stages[max(0, index)]


class Power:
    """The outputs of the supply and the rails of the block.

    `block_c` returns the block's temperature at a time, °C. A simulated supply sets its outputs with `change` and
    reads them with `stage` and `shown`. It stores in `returned` the function to call when the mains return, and
    sets `one_switch` if its outputs have a common switch. All times are those of the world's clock. Methods may be
    called from any thread.
    """

    def __init__(
        self, settings: PowerSettings, now_s: float, block_c: Callable[[float], float], lock: threading.RLock
    ) -> None:
        self.settings = settings
        self._lock = lock
        self.violations: list[Violation] = []
        self.one_switch = False
        self.returned: Callable[[float], None] = lambda now_s: None
        self._block_c = block_c
        self._reached_s = now_s
        self._outputs: dict[str, _Output] = {}
        for rail in settings.rails:
            output = self._output(rail.output)
            output.rails = (*output.rails, rail)
        self._lives: list[tuple[float, bool]] = [(now_s, False)]
        self._coming: list[tuple[float, Callable[[], None]]] = []
        self._cut_until_s = -math.inf

    # --- actions and disturbances -------------------------------------------------------------------

    def change(self, output: str, now_s: float, **changes: object) -> None:
        """Set the fields of an output's `OutputPhase` that `changes` names, from now on."""
        with self._lock:
            self.advance(now_s)
            self._change(output, self._reached_s, **changes)
            self._pass(self._reached_s)

    def disturb(self, disturbance: Disturbance) -> None:
        """Schedule a disturbance. Raises `ValueError` for an output that feeds no rail."""
        fed = [name for name, output in self._outputs.items() if output.rails]
        if disturbance.output and disturbance.output not in fed:
            raise ValueError(f"output {disturbance.output} feeds no rail; choose from {', '.join(fed)}")
        together = not disturbance.output or (disturbance.kind == "off" and self.one_switch)
        names = fed if together else [disturbance.output]
        begin, end = disturbance.at_s, disturbance.at_s + disturbance.lasts_s
        undisturbed: dict[str, dict[str, object]] = {
            "sag": {"sag": 0.0},
            "drift": {"drift_v_s": 0.0, "offset_v": 0.0},
            "load": {"load": 1.0},
            "open": {"open": False},
        }
        disturbed: dict[str, dict[str, object]] = {
            "sag": {"sag": disturbance.size},
            "drift": {"drift_v_s": disturbance.size / 3600.0},
            "load": {"load": disturbance.size},
            "open": {"open": True},
            "off": {"on": False},
        }
        if disturbance.kind == "cut":
            self._at(begin, partial(self._cut, begin, end))
            self._at(end, lambda: self.returned(end))
            return
        for name in names:
            self._at(begin, partial(self._change, name, begin, **disturbed[disturbance.kind]))
            if disturbance.kind != "off" and math.isfinite(end):
                self._at(end, partial(self._change, name, end, **undisturbed[disturbance.kind]))

    # --- true state ---------------------------------------------------------------------------------

    def outputs(self) -> tuple[str, ...]:
        """Return the names of the outputs that feed a rail."""
        return tuple(name for name, output in self._outputs.items() if output.rails)

    def stage(self, output: str, now_s: float) -> OutputPhase:
        """Return the present state of an output."""
        with self._lock:
            self.advance(now_s)
            return self._output(output).last

    def shown(self, output: str, now_s: float) -> OutputReading:
        """Return the present voltage and current at the terminals of an output."""
        with self._lock:
            stage = self.stage(output, now_s)
            return self._shown(self._output(output), stage, now_s)

    def has_mains(self, now_s: float) -> bool:
        """Whether the supply itself has mains power."""
        with self._lock:
            self.advance(now_s)
            return now_s >= self._cut_until_s

    def rail_v(self, name: str, time_s: float) -> float:
        """Return the voltage of a rail at the block at a time up to now, V."""
        with self._lock:
            self.advance(time_s)
            rail = next(rail for rail in self.settings.rails if rail.name == name)
            return self._rail_v(rail, time_s)

    def above_nominal_v(self, time_s: float) -> tuple[float, ...]:
        """Return the voltage of each rail at the block minus its nominal voltage, at a time up to now, V."""
        with self._lock:
            self.advance(time_s)
            return tuple(self._rail_v(rail, time_s) - rail.nominal_v for rail in self.settings.rails)

    def on_since_s(self, time_s: float) -> float | None:
        """Return the time, s, since which the block has power at `time_s`; None without power or rails."""
        if not self.settings.rails:
            return None
        with self._lock:
            self.advance(time_s)
            index = bisect_right(self._lives, time_s, key=lambda life: life[0]) - 1
            since_s, alive = self._lives[max(0, index)]
            return since_s if alive else None

    def feeds_block(self, time_s: float) -> bool:
        """Whether all rails are within `working_v` at a time up to now; True for a block without rails."""
        return not self.settings.rails or self.on_since_s(time_s) is not None

    @property
    def switchings(self) -> tuple[tuple[float, bool], ...]:
        """The clock times, s, at which the block gained (True) or lost power (False); the first is False."""
        return tuple(self._lives)

    # --- advance of time ----------------------------------------------------------------------------

    def advance(self, now_s: float) -> None:
        """Carry out the disturbances and trips up to now. The caller must hold the lock."""
        while self._reached_s < now_s:
            until_s = min(now_s, self._coming[0][0]) if self._coming else now_s
            self._pass(max(until_s, self._reached_s))
            while self._coming and self._coming[0][0] <= self._reached_s:
                self._coming.pop(0)[1]()
                self._pass(self._reached_s)

    def _pass(self, until_s: float) -> None:
        """Advance to `until_s`, before which no disturbance is due, and carry out the trips on the way."""
        while True:
            trips = [(self._trips_at(output, until_s), name) for name, output in self._outputs.items()]
            first_s, name, why = min(
                ((at_s, name, why) for (at_s, why), name in trips if why), default=(math.inf, "", None)
            )
            end_s = min(until_s, first_s)
            self._watch(self._reached_s, end_s)
            self._reached_s = end_s
            if why is None or first_s > until_s:
                return
            self._change(name, end_s, on=False, tripped=why)
            self._watch(end_s, end_s)

    def _trips_at(self, output: _Output, until_s: float) -> tuple[float, Trip | None]:
        """Return the time and the cause of an output's next trip up to `until_s`, or infinity and None."""
        stage, begin_s = output.last, self._reached_s
        if not stage.on:
            return math.inf, None
        if stage.trip_v is not None:
            limit_v = abs(stage.trip_v)
            if abs(self._shown(output, stage, begin_s).voltage_v) >= limit_v:
                return begin_s, "voltage"
            if abs(self._shown(output, stage, until_s).voltage_v) >= limit_v:
                beyond = self._crossing(
                    lambda t: abs(self._shown(output, stage, t).voltage_v) >= limit_v, begin_s, until_s
                )
                return beyond, "voltage"
        if stage.trip_after_s is not None and self._shown(output, stage, stage.since_s).limiting:
            at_s = max(begin_s, stage.since_s + stage.trip_after_s)
            if at_s <= until_s and self._shown(output, stage, at_s).limiting:
                return at_s, "current"
        return math.inf, None

    def _watch(self, begin_s: float, end_s: float) -> None:
        """Record violations and power changes of the rails in a period without switching or disturbance."""
        for rail in self.settings.rails:
            volts = [self._rail_v(rail, time_s) for time_s in (begin_s, end_s)]
            low_v, high_v = rail.absolute_v
            worst_v = max(volts, key=lambda v: max(v - high_v, low_v - v))
            if not low_v <= worst_v <= high_v:
                self._note(Violation(rail.name, begin_s, end_s, worst_v, "V"))
            worst_a = max(self._rail_a(rail, time_s) for time_s in (begin_s, end_s))
            if worst_a > rail.absolute_a:
                self._note(Violation(rail.name, begin_s, end_s, worst_a, "A"))
        for time_s in (begin_s, end_s):
            alive = self._alive(time_s)
            if alive != self._lives[-1][1]:
                self._lives.append((self._crossing(partial(self._is_alive, alive), begin_s, time_s), alive))

    def _note(self, violation: Violation) -> None:
        """Record a violation; one that continues the previous violation extends it."""
        for index, known in enumerate(self.violations):
            same = (known.rail, known.unit) == (violation.rail, violation.unit)
            if same and known.to_s == violation.from_s:
                worst = max(known.value, violation.value, key=abs)
                self.violations[index] = replace(known, to_s=violation.to_s, value=worst)
                return
        self.violations.append(violation)

    def _crossing(self, beyond: Callable[[float], bool], begin_s: float, end_s: float) -> float:
        """Return, by bisection, when `beyond` changes from False (at `begin_s`) to True (at `end_s`)."""
        while end_s - begin_s > _CLOSE_S:
            middle_s = (begin_s + end_s) / 2.0
            begin_s, end_s = (begin_s, middle_s) if beyond(middle_s) else (middle_s, end_s)
        return end_s

    # --- state at a time ----------------------------------------------------------------------------

    def _is_alive(self, alive: bool, time_s: float) -> bool:
        return self._alive(time_s) == alive

    def _alive(self, time_s: float) -> bool:
        return all(
            rail.working_v[0] <= self._rail_v(rail, time_s) <= rail.working_v[1]
            for rail in self.settings.rails
        )

    def _rail_v(self, rail: Rail, time_s: float) -> float:
        output = self._outputs[rail.output]
        stage = output.at(time_s)
        return 0.0 if stage.open else self._shown(output, stage, time_s).voltage_v

    def _rail_a(self, rail: Rail, time_s: float) -> float:
        stage = self._outputs[rail.output].at(time_s)
        if stage.open or not stage.on:
            return 0.0
        return abs(self._rail_v(rail, time_s)) * self._conductance(rail, stage, time_s)

    def _shown(self, output: _Output, stage: OutputPhase, time_s: float) -> OutputReading:
        if not stage.on:
            return OutputReading(0.0, 0.0, limiting=False)
        gone_v = stage.offset_v + stage.drift_v_s * (time_s - stage.since_s)
        open_v = (stage.set_v + gone_v) * (1.0 - stage.sag)
        conductance = (
            0.0 if stage.open else sum(self._conductance(rail, stage, time_s) for rail in output.rails)
        )
        current_a = abs(open_v) * conductance
        if current_a <= stage.limit_a:
            return OutputReading(open_v, current_a, limiting=False)
        return OutputReading(math.copysign(stage.limit_a / conductance, open_v), stage.limit_a, limiting=True)

    def _conductance(self, rail: Rail, stage: OutputPhase, time_s: float) -> float:
        """Return the load of a rail at a time, A/V; a rail draws more when warm and just after switch-on."""
        settings = self.settings
        warm = 1.0 + settings.current_by_temperature * (self._block_c(time_s) - REFERENCE_C)
        since_s = max(0.0, time_s - stage.on_since_s)
        rush = 1.0 + (settings.in_rush - 1.0) * math.exp(-since_s / settings.in_rush_time_s)
        return stage.load * rail.current_a * warm * rush / abs(rail.nominal_v)

    # --- changes ------------------------------------------------------------------------------------

    def _output(self, name: str) -> _Output:
        if name not in self._outputs:
            self._outputs[name] = _Output([OutputPhase(self._reached_s)])
        return self._outputs[name]

    def _change(self, name: str, now_s: float, **changes: object) -> None:
        output = self._output(name)
        before = output.last
        gone_v = before.offset_v + before.drift_v_s * (now_s - before.since_s)
        stage = replace(before, since_s=now_s, offset_v=gone_v)
        stage = replace(stage, **changes)  # type: ignore[arg-type]
        if stage.on and not before.on:
            stage = replace(stage, on_since_s=now_s)
        output.stages.append(stage)

    def _at(self, time_s: float, action: Callable[[], None]) -> None:
        self._coming.append((time_s, action))
        self._coming.sort(key=lambda coming: coming[0])

    def _cut(self, now_s: float, until_s: float) -> None:
        self._cut_until_s = until_s
        for name in self._outputs:
            self._change(name, now_s, on=False, tripped=None)
