"""A simulated HP / Agilent / Keysight E3631A, whose outputs feed the block of the world.

Simulated is what sets, switches and watches its outputs; its triggers, memories and calibration are not.
Sources: E3631A User's Guide (E3631-90002), chapter 4 "Remote interface reference", chapter 5 "Error messages".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal

from drivers.facts import keysight_e3631a as facts
from sim.scpi import Command, ScpiInstrument
from sim.scpi_values import DEF, MAX, MIN, Boolean, Choice, Number, ScpiError, Text, quoted, within
from sim.supply import Outputs

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.scpi_values import Value
    from sim.world.world import World

_ERRORS: Final = {
    514: "Command allowed only with RS-232",
    521: "Input buffer overflow",
    550: "Command not allowed in local",
}
_REMOTE: Final = ("SYSTem:LOCal", "SYSTem:REMote", "SYSTem:RWLock")
_ALLOWED_IN_LOCAL: Final = (*_REMOTE, "SYSTem:ERRor?", "*IDN?", "*CLS", "*ESR?", "*STB?")
_WORDS: Final = (MIN, MAX, DEF)
_SUMMARY: Final = 1 << 13
_LEVEL: Final = "[:LEVel][:IMMediate][:AMPLitude]"


class KeysightE3631A(ScpiInstrument):
    """The supply; `interface` is how it is set.

    "rs232" refuses (+550) commands until SYSTem:REMote, "gpib" those of the SYSTem:REMote family (+514), "lan" (for
    whoever tries it on a socket) wants neither.
    """

    model = "E3631A"

    def __init__(self, world: World, *, interface: Literal["gpib", "rs232", "lan"] = "gpib") -> None:
        super().__init__(facts.IDENTITY, _ERRORS)
        self.interface = interface
        self._remote = self._locked = False
        self._selected = "P6V"
        self._tracks = False
        self._display = True
        self._text = ""
        limits = facts.OUTPUTS[self.model]
        self._outputs = Outputs(world, limits, _preset, self.power_cycle, one_switch=facts.SWITCHED_TOGETHER)
        self.add(self._settings_commands())
        self.add(self._watching_commands())
        self.add(self._system_commands())

    # --- what the wire and the bench do -------------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool] = lambda: False) -> bytes | None:
        """Carry out a message; without mains nothing is answered."""
        return super().handle(message, interrupted) if self._outputs.has_mains else None

    def admit(self, command: Command) -> None:
        """Refuse what the interface does not allow."""
        if self.interface == "gpib" and command.notation in _REMOTE:
            raise ScpiError(514)
        if self.interface == "rs232" and not self._remote and command.notation not in _ALLOWED_IN_LOCAL:
            raise ScpiError(550)

    def input_overflow(self) -> None:
        """Take note that a message was longer than the input buffer."""
        self.report(521)

    def press_local(self) -> None:
        """Press LOCAL on the front panel; locked by SYSTem:RWLock it does nothing."""
        if not self._locked:
            self._remote = False

    def power_cycle(self) -> None:
        """Switch off and on: settings are those of *RST, all outputs are off."""
        super().power_cycle()
        self._remote = self._locked = False

    def reset(self) -> None:
        """Carry out *RST."""
        self._selected, self._tracks, self._display, self._text = "P6V", False, True, ""
        self._outputs.reset()

    # --- commands -----------------------------------------------------------------------------------

    def _settings_commands(self) -> list[Command]:
        output = Choice(self._outputs.names)
        chosen = Choice(self._outputs.names, optional=True)
        volts, amperes = Number("V", _WORDS), Number("A", _WORDS)
        extreme = Choice(("MINimum", "MAXimum"), optional=True)
        return [
            Command("APPLy", self._apply, (output, Number("V", _WORDS, True), Number("A", _WORDS, True))),
            Command("APPLy?", self._applied, (chosen,)),
            Command("INSTrument[:SELect]", self._select, (output,)),
            Command("INSTrument[:SELect]?", lambda: self._selected),
            Command("INSTrument:NSELect", self._select_number, (Number(words=()),)),
            Command("INSTrument:NSELect?", lambda: str(1 + self._outputs.names.index(self._selected))),
            Command(f"[SOURce:]VOLTage{_LEVEL}", lambda v: self._set("voltage_v", v), (volts,)),
            Command(f"[SOURce:]VOLTage{_LEVEL}?", lambda *w: self._setting("voltage_v", *w), (extreme,)),
            Command(f"[SOURce:]CURRent{_LEVEL}", lambda v: self._set("current_a", v), (amperes,)),
            Command(f"[SOURce:]CURRent{_LEVEL}?", lambda *w: self._setting("current_a", *w), (extreme,)),
            Command("OUTPut[:STATe]", self._switch, (Boolean(),)),
            Command("OUTPut[:STATe]?", lambda: str(int(self._is_on))),
            Command("OUTPut:TRACk[:STATe]", self._track, (Boolean(),)),
            Command("OUTPut:TRACk[:STATe]?", lambda: str(int(self._tracks))),
        ]

    def _watching_commands(self) -> list[Command]:
        chosen = (Choice(self._outputs.names, optional=True),)
        summary = "STATus:QUEStionable:INSTrument:ISUMmary"
        return [
            Command("MEASure[:VOLTage][:DC]?", self._measure_voltage, chosen),
            Command("MEASure:CURRent[:DC]?", self._measure_current, chosen),
            Command(
                "STATus:QUEStionable:CONDition?", lambda: self.number(_SUMMARY if self._any_limits else 0)
            ),
            *(
                Command(f"{summary}{number}{node}?", lambda name=name: self.number(self._condition(name)))
                for number, name in enumerate(self._outputs.names, start=1)
                for node in (":CONDition", "[:EVENt]")
            ),
        ]

    def _system_commands(self) -> list[Command]:
        return [
            Command("DISPlay[:WINDow][:STATe]", self._show, (Boolean(),)),
            Command("DISPlay[:WINDow][:STATe]?", lambda: str(int(self._display))),
            Command("DISPlay[:WINDow]:TEXT[:DATA]", self._write_text, (Text(),)),
            Command("DISPlay[:WINDow]:TEXT[:DATA]?", lambda: quoted(self._text)),
            Command("DISPlay[:WINDow]:TEXT:CLEar", lambda: self._write_text("")),
            Command("SYSTem:BEEPer[:IMMediate]", lambda: None),
            Command("SYSTem:VERSion?", lambda: "1995.0"),
            Command("SYSTem:LOCal", lambda: self._set_remote(False)),
            Command("SYSTem:REMote", lambda: self._set_remote(True)),
            Command("SYSTem:RWLock", lambda: self._set_remote(True, locked=True)),
        ]

    # --- settings -----------------------------------------------------------------------------------

    def _apply(self, output: Value, volts: Value = DEF, amperes: Value = DEF) -> None:
        """Select an output and set it, both or nothing."""
        name = str(output)
        wanted_v, wanted_a = self._of(name, "voltage_v", volts), self._of(name, "current_a", amperes)
        self._selected = name
        self._outputs.change(name, set_v=wanted_v, limit_a=wanted_a)
        self._follow()

    def _applied(self, output: Value = "") -> str:
        stage = self._outputs.stage(str(output or self._selected))
        return quoted(f"{stage.set_v:.6f},{stage.limit_a:.6f}")

    def _select(self, output: Value) -> None:
        self._selected = str(output)

    def _select_number(self, number: float) -> None:
        self._selected = self._outputs.names[round(within(number, 1, len(self._outputs.names))) - 1]

    def _set(self, what: str, value: Value) -> None:
        number = self._of(self._selected, what, value)
        self._outputs.change(self._selected, **{"set_v" if what == "voltage_v" else "limit_a": number})
        self._follow()

    def _setting(self, what: str, extreme: Value = "") -> str:
        if extreme:
            return _number(self._of(self._selected, what, extreme))
        stage = self._outputs.stage(self._selected)
        return _number(stage.set_v if what == "voltage_v" else stage.limit_a)

    def _of(self, name: str, what: str, value: Value) -> float:
        """Return a setting of an output, of a number or a word. Raises `ScpiError` -222 beyond its range."""
        near, far = self._outputs.span(name, what)
        if isinstance(value, str):
            default = 0.0 if what == "voltage_v" else facts.DEFAULT_CURRENT_A[name]
            return {MIN: near, MAX: far, DEF: default}[value]
        return within(value, min(near, far), max(near, far))

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
        """In track mode N25V gives what P25V is set to."""
        if self._tracks:
            self._outputs.change("N25V", set_v=-self._outputs.stage("P25V").set_v)

    # --- what it measures ---------------------------------------------------------------------------

    def _measure_voltage(self, output: Value = "") -> str:
        return _number(self._outputs.shown(str(output or self._selected)).voltage_v)

    def _measure_current(self, output: Value = "") -> str:
        return _number(self._outputs.shown(str(output or self._selected)).current_a)

    def _condition(self, name: str) -> int:
        if not self._outputs.stage(name).on:
            return 0
        return facts.LIMITING if self._outputs.shown(name).limiting else facts.REGULATING

    @property
    def _any_limits(self) -> bool:
        return any(self._condition(name) == facts.LIMITING for name in self._outputs.names)

    # --- the rest -----------------------------------------------------------------------------------

    def _show(self, on: Value) -> None:
        self._display = on == "1"

    def _write_text(self, text: Value) -> None:
        self._text = str(text)[:12]

    def _set_remote(self, remote: bool, locked: bool = False) -> None:
        self._remote, self._locked = remote, locked


def _preset(name: str) -> dict[str, Any]:
    return {"set_v": 0.0, "limit_a": facts.DEFAULT_CURRENT_A[name], "trip_v": None, "trip_after_s": None}


def _number(value: float) -> str:
    """Return a number as it prints it: +5.00000000E+00."""
    return f"{value:+.8E}"
