"""The base of simulated power supplies, whose outputs are part of the world."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from sim.scpi import Command, Interface, RemoteInstrument, never
from sim.scpi_values import DEF, MAX, MIN, Value, within

if TYPE_CHECKING:
    from types import ModuleType

    from sim.world.power import OutputPhase, OutputReading
    from sim.world.world import World


class Outputs:
    """The outputs of a supply in a world, by name; `limits` are their limits in `drivers.facts`.

    `preset` returns the settings of an output after switch-on and *RST. `returned` is called when the mains
    power returns, and sets the supply's state. With `one_switch` a front-panel switch acts on all outputs.
    """

    def __init__(
        self,
        world: World,
        limits: Mapping[str, Mapping[str, Any]],
        preset: Callable[[str], dict[str, Any]],
        returned: Callable[[], None],
        *,
        one_switch: bool = False,
    ) -> None:
        self._world = world
        self._preset = preset
        self._returned = returned
        self._back_s: float | None = None
        self.limits = limits
        self.names = tuple(limits)
        world.power.returned = self._come_back
        world.power.one_switch = one_switch
        self.reset()

    @property
    def has_mains(self) -> bool:
        """Whether the supply has mains power; without it, the supply answers nothing."""
        return self._world.power.has_mains(self._now_s)

    @property
    def _now_s(self) -> float:
        """The time of an action: the present time or, during `returned`, the time at which the mains returned."""
        return self._world.clock.now_s() if self._back_s is None else self._back_s

    def span(self, name: str, what: str) -> tuple[float, float]:
        """Return the two limits of a setting of an output; the limit nearer to zero comes first."""
        low, high = sorted((float(value) for value in self.limits[name][what]), key=abs)
        return low, high

    def stage(self, name: str) -> OutputPhase:
        """Return the present state of an output."""
        return self._world.power.stage(name, self._now_s)

    def shown(self, name: str) -> OutputReading:
        """Return the voltage and current that the supply measures at an output, rounded to its resolution."""
        shown, limits = self._world.power.shown(name, self._now_s), self.limits[name]
        return replace(
            shown,
            voltage_v=_rounded(shown.voltage_v, limits["voltage_step_v"]),
            current_a=_rounded(shown.current_a, limits["current_step_a"]),
        )

    def change(self, name: str, **changes: object) -> None:
        """Set the fields of an output's `OutputPhase` that `changes` names, from now on."""
        self._world.power.change(name, self._now_s, **changes)

    def switch(self, name: str, on: bool) -> None:
        """Switch an output on or off; an output that has tripped stays off."""
        if not on or self.stage(name).tripped is None:
            self.change(name, on=on)

    def clear_trips(self) -> None:
        """Clear all trips; the outputs stay off."""
        for name in self.names:
            self.change(name, tripped=None)

    def reset(self) -> None:
        """Switch every output off, clear its trip, and give it the settings of `preset`."""
        for name in self.names:
            self.change(name, on=False, tripped=None, **self._preset(name))

    def _come_back(self, now_s: float) -> None:
        self._back_s = now_s
        try:
            self._returned()
        finally:
            self._back_s = None


def _rounded(value: float, step: float) -> float:
    return round(value / step) * step


LEVEL: Final = "[:LEVel][:IMMediate][:AMPLitude]"
WORDS: Final = (MIN, MAX, DEF)


class KeysightSupply(RemoteInstrument):
    """The base of the Keysight supplies; its outputs are in the world, and one of them is selected.

    `facts` is the supply's module in `drivers.facts`.
    """

    def __init__(
        self,
        world: World,
        facts: ModuleType,
        model: str,
        identity: str,
        *,
        interface: Interface = "lan",
    ) -> None:
        super().__init__(identity, {}, interface)
        self.model = model
        self._facts = facts
        limits = facts.OUTPUTS[model]
        self._selected = next(iter(limits))
        self._outputs = Outputs(
            world, limits, self._preset, self.power_cycle, one_switch=facts.SWITCHED_TOGETHER
        )
        summary = "STATus:QUEStionable:INSTrument:ISUMmary"
        self.add(
            [
                Command(f"{summary}{number}:CONDition?", lambda name=name: self.number(self._condition(name)))
                for number, name in enumerate(limits, start=1)
            ]
        )

    @abstractmethod
    def _preset(self, name: str) -> dict[str, Any]:
        """Return the settings of an output after switch-on and *RST."""

    def handle(self, message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        """Carry out a message; without mains there is no reply."""
        return super().handle(message, interrupted) if self._outputs.has_mains else None

    def reset(self) -> None:
        """*RST: select the first output, switch all outputs off, and restore their default settings."""
        self._selected = self._outputs.names[0]
        self._outputs.reset()

    def _of(self, name: str, what: str, value: Value, default: float) -> float:
        """Return the setting `what` of an output from a number or a word. Raises `ScpiError` -222 out of limits."""
        near, far = self._outputs.span(name, what)
        if isinstance(value, str):
            return {MIN: near, MAX: far, DEF: default}[value]
        return within(value, min(near, far), max(near, far))

    def _condition(self, name: str) -> int:
        """Return the status bits of an output: the cause of a trip, or the regulation mode."""
        stage, facts = self._outputs.stage(name), self._facts
        if stage.tripped is not None:
            return int(facts.OVER_VOLTAGE if stage.tripped == "voltage" else facts.OVER_CURRENT)
        if not stage.on:
            return 0
        return int(facts.LIMITING if self._outputs.shown(name).limiting else facts.REGULATING)


def shown_number(value: float) -> str:
    """Return a number in the format of these supplies: +5.00000000E+00."""
    return f"{value:+.8E}"
