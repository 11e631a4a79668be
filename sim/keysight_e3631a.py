"""A simulated HP / Agilent / Keysight E3631A, whose outputs feed the block of the world.

The simulation covers setting, switching and monitoring the outputs, but not triggers, memories or calibration.
Sources: E3631A User's Guide (E3631-90002), chapter 4 "Remote interface reference", chapter 5 "Error messages".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.facts import keysight_e3631a as facts
from sim.scpi import Command, Interface
from sim.scpi_values import DEF, Boolean, Choice, Number, quoted, within
from sim.supply import LEVEL, WORDS, KeysightSupply, shown_number

if TYPE_CHECKING:
    from sim.scpi_values import Value
    from sim.world.world import World


class KeysightE3631A(KeysightSupply):
    """An E3631A; `interface` is its interface setting, "lan" for tests on a socket (see `RemoteInstrument`)."""

    def __init__(self, world: World, *, interface: Interface = "gpib") -> None:
        self._tracks = False
        super().__init__(world, facts, "E3631A", facts.IDENTITY, interface=interface)
        self.add(self._settings_commands())
        chosen = (Choice(self._outputs.names, optional=True),)
        self.add(
            [
                Command("MEASure[:VOLTage][:DC]?", self._measure_voltage, chosen),
                Command("MEASure:CURRent[:DC]?", self._measure_current, chosen),
            ]
        )

    def _preset(self, name: str) -> dict[str, Any]:
        return {"set_v": 0.0, "limit_a": facts.DEFAULT_CURRENT_A[name], "trip_v": None, "trip_after_s": None}

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
        default = 0.0 if what == "voltage_v" else facts.DEFAULT_CURRENT_A[name]
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
