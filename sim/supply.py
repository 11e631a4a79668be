"""Simulated Keysight supplies, whose outputs feed the block of the world, and the outputs of any supply.

The simulations cover setting, protecting, switching and monitoring the outputs, but not triggers, lists, memories,
data logging or calibration. Sources: E3631A User's Guide (E3631-90002), chapter 4 "Remote interface reference",
chapter 5 "Error messages"; E36300 Series Programming Guide, as in `drivers.facts.keysight_e36300`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from drivers.facts import keysight_e3631a, keysight_e36300
from sim.scpi import Command, Interface, RemoteInstrument, never
from sim.scpi_values import (
    DEF,
    MAX,
    MIN,
    Boolean,
    Choice,
    Number,
    OutputList,
    ScpiError,
    Value,
    listed,
    numbered,
    quoted,
    within,
)

if TYPE_CHECKING:
    from types import ModuleType

    from sim.scpi_values import CommandParameter
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


class KeysightE3631A(KeysightSupply):
    """An E3631A; `interface` is its interface setting, "lan" for tests on a socket (see `RemoteInstrument`)."""

    def __init__(self, world: World, *, interface: Interface = "gpib") -> None:
        self._tracks = False
        super().__init__(world, keysight_e3631a, "E3631A", keysight_e3631a.IDENTITY, interface=interface)
        self.add(self._settings_commands())
        chosen = (Choice(self._outputs.names, optional=True),)
        self.add(
            [
                Command("MEASure[:VOLTage][:DC]?", self._measure_voltage, chosen),
                Command("MEASure:CURRent[:DC]?", self._measure_current, chosen),
            ]
        )

    def _preset(self, name: str) -> dict[str, Any]:
        return {
            "set_v": 0.0,
            "limit_a": keysight_e3631a.DEFAULT_CURRENT_A[name],
            "trip_v": None,
            "trip_after_s": None,
        }

    def reset(self) -> None:
        """*RST: as the base class; also leave track mode."""
        self._tracks = False
        super().reset()

    # --- commands -----------------------------------------------------------------------------------

    def _settings_commands(self) -> list[Command]:
        output = Choice(self._outputs.names)
        chosen = Choice(self._outputs.names, optional=True)
        volts, amperes = Number("V", WORDS), Number("A", WORDS)
        extreme = Choice(("MINimum", "MAXimum"), optional=True)
        return [
            Command("APPLy", self._apply, (output, Number("V", WORDS, True), Number("A", WORDS, True))),
            Command("APPLy?", self._applied, (chosen,)),
            Command("INSTrument:NSELect", self._select, (Number(words=()),)),
            Command(f"[SOURce:]VOLTage{LEVEL}", lambda v: self._set("voltage_v", v), (volts,)),
            Command(f"[SOURce:]VOLTage{LEVEL}?", lambda *w: self._setting("voltage_v", *w), (extreme,)),
            Command(f"[SOURce:]CURRent{LEVEL}", lambda v: self._set("current_a", v), (amperes,)),
            Command(f"[SOURce:]CURRent{LEVEL}?", lambda *w: self._setting("current_a", *w), (extreme,)),
            Command("OUTPut[:STATe]", self._switch, (Boolean(),)),
            Command("OUTPut[:STATe]?", lambda: str(int(self._is_on))),
            Command("OUTPut:TRACk[:STATe]", self._track, (Boolean(),)),
            Command("OUTPut:TRACk[:STATe]?", lambda: str(int(self._tracks))),
        ]

    # --- settings -----------------------------------------------------------------------------------

    def _apply(self, output: Value, volts: Value = DEF, amperes: Value = DEF) -> None:
        """Select an output and set its voltage and current; on an error change neither."""
        name = str(output)
        wanted_v, wanted_a = self._value(name, "voltage_v", volts), self._value(name, "current_a", amperes)
        self._selected = name
        self._outputs.change(name, set_v=wanted_v, limit_a=wanted_a)
        self._follow()

    def _applied(self, output: Value = "") -> str:
        stage = self._outputs.stage(str(output or self._selected))
        return quoted(f"{stage.set_v:.6f},{stage.limit_a:.6f}")

    def _select(self, number: float) -> None:
        self._selected = self._outputs.names[round(within(number, 1, len(self._outputs.names))) - 1]

    def _set(self, what: str, value: Value) -> None:
        number = self._value(self._selected, what, value)
        self._outputs.change(self._selected, **{"set_v" if what == "voltage_v" else "limit_a": number})
        self._follow()

    def _setting(self, what: str, extreme: Value = "") -> str:
        if extreme:
            return shown_number(self._value(self._selected, what, extreme))
        stage = self._outputs.stage(self._selected)
        return shown_number(stage.set_v if what == "voltage_v" else stage.limit_a)

    def _value(self, name: str, what: str, value: Value) -> float:
        default = 0.0 if what == "voltage_v" else keysight_e3631a.DEFAULT_CURRENT_A[name]
        return self._of(name, what, value, default)

    def _switch(self, on: Value) -> None:
        for name in self._outputs.names:
            self._outputs.switch(name, on == "1")

    @property
    def _is_on(self) -> bool:
        return any(self._outputs.stage(name).on for name in self._outputs.names)

    def _track(self, on: Value) -> None:
        self._tracks = on == "1"
        self._follow()

    def _follow(self) -> None:
        """Set N25V to the negative of P25V's setting, in track mode."""
        if self._tracks:
            self._outputs.change("N25V", set_v=-self._outputs.stage("P25V").set_v)

    # --- measurements -------------------------------------------------------------------------------

    def _measure_voltage(self, output: Value = "") -> str:
        return shown_number(self._outputs.shown(str(output or self._selected)).voltage_v)

    def _measure_current(self, output: Value = "") -> str:
        return shown_number(self._outputs.shown(str(output or self._selected)).current_a)


class KeysightE36300(KeysightSupply):
    """A supply of the E36300 series; commands without a channel list apply to its first output."""

    def __init__(self, world: World, *, model: str = "E36312A") -> None:
        super().__init__(
            world, keysight_e36300, model, numbered(keysight_e36300.IDENTITY.format(model=model), 1)
        )
        self.add(self._settings_commands())
        self.add(
            [
                Command("MEASure[:SCALar][:VOLTage][:DC]?", self._each(self._volts), (OutputList(),)),
                Command("MEASure[:SCALar]:CURRent[:DC]?", self._each(self._amperes), (OutputList(),)),
            ]
        )

    def input_overflow(self) -> None:
        """Report a message that exceeded the input buffer (-223)."""
        self.report(-223)

    def _preset(self, name: str) -> dict[str, Any]:
        return {
            "set_v": 0.0,
            "limit_a": self._default_a(name),
            "trip_v": max(self._limits[name]["over_voltage_v"], key=abs),
            "trip_after_s": None,
        }

    def _default_a(self, name: str) -> float:
        return float(self._limits[name]["current_a"][1] / 1.03)

    @property
    def _limits(self) -> dict[str, Any]:
        return keysight_e36300.OUTPUTS[self.model]

    # --- commands -----------------------------------------------------------------------------------

    def _settings_commands(self) -> list[Command]:
        return [
            *self._both(f"[SOURce:]VOLTage{LEVEL}", self._set_voltage, lambda s: s.set_v, Number("V", WORDS)),
            *self._both(
                f"[SOURce:]CURRent{LEVEL}", self._set_current, lambda s: s.limit_a, Number("A", WORDS)
            ),
            *self._both(
                "[SOURce:]VOLTage:PROTection[:LEVel]",
                self._set_protection,
                lambda s: s.trip_v or 0.0,
                Number("V", WORDS),
            ),
            Command("[SOURce:]VOLTage:PROTection:TRIPped?", self._each(self._over_voltage), (OutputList(),)),
            Command("[SOURce:]CURRent:PROTection:TRIPped?", self._each(self._over_current), (OutputList(),)),
            Command("OUTPut[:STATe]", self._switch, (Boolean(), OutputList())),
            Command(
                "OUTPut[:STATe]?", self._each(lambda n: str(int(self._outputs.stage(n).on))), (OutputList(),)
            ),
            Command("OUTPut:PROTection:CLEar", self._clear, (OutputList(),)),
        ]

    def _both(
        self,
        notation: str,
        set_one: Callable[[str, Value], None],
        get: Callable[[OutputPhase], float],
        parameter: CommandParameter,
    ) -> tuple[Command, Command]:
        """Return the command and the query of a setting of outputs."""

        def put(value: Value, outputs: Value = "") -> None:
            for name in self._listed(outputs):
                set_one(name, value)

        def ask(name: str) -> str:
            return shown_number(get(self._outputs.stage(name)))

        return Command(notation, put, (parameter, OutputList())), Command(
            f"{notation}?", self._each(ask), (OutputList(),)
        )

    def _each(self, ask: Callable[[str], str]) -> Callable[..., str]:
        """Return a query action that joins the results of `ask` for each output of a list."""
        return lambda outputs="": ",".join(ask(name) for name in self._listed(outputs))

    def _listed(self, outputs: Value) -> tuple[str, ...]:
        if not outputs:
            return (self._selected,)
        return tuple(str(number) for number in listed(str(outputs), len(self._outputs.names)))

    # --- settings -----------------------------------------------------------------------------------

    def _set_voltage(self, name: str, value: Value) -> None:
        """Set a voltage; one above the over-voltage protection is refused (-221)."""
        wanted_v = self._of(name, "voltage_v", value, 0.0)
        protection_v = self._outputs.stage(name).trip_v
        if protection_v is not None and abs(wanted_v) > abs(protection_v):
            raise ScpiError(-221)
        self._outputs.change(name, set_v=wanted_v)

    def _set_current(self, name: str, value: Value) -> None:
        limit_a = self._of(name, "current_a", value, self._default_a(name))
        self._outputs.change(name, limit_a=limit_a)

    def _set_protection(self, name: str, value: Value) -> None:
        """Set the over-voltage protection; a level below the present voltage trips the output."""
        highest_v = max(self._limits[name]["over_voltage_v"], key=abs)
        self._outputs.change(name, trip_v=self._of(name, "over_voltage_v", value, highest_v))

    def _switch(self, on: Value, outputs: Value = "") -> None:
        for name in self._listed(outputs):
            self._outputs.switch(name, on == "1")

    def _clear(self, outputs: Value = "") -> None:
        for name in self._listed(outputs):
            self._outputs.change(name, tripped=None)

    # --- measurements -------------------------------------------------------------------------------

    def _volts(self, name: str) -> str:
        return shown_number(self._outputs.shown(name).voltage_v)

    def _amperes(self, name: str) -> str:
        return shown_number(self._outputs.shown(name).current_a)

    def _over_voltage(self, name: str) -> str:
        return str(int(self._outputs.stage(name).tripped == "voltage"))

    def _over_current(self, name: str) -> str:
        return str(int(self._outputs.stage(name).tripped == "current"))
