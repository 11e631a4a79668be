"""An HP / Agilent / Keysight E3631A over GPIB (a board, an adapter) or RS-232.

One switch controls all outputs, and there is no over-voltage protection. Over RS-232 the driver first sets
the supply to remote. Sources: see `drivers.facts.keysight_e3631a`; APPLy, MEASure, OUTPut,
STATus:QUEStionable:INSTrument:ISUMmary.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import keysight_e3631a as facts
from drivers.interfaces import InstrumentRefused, OutputSettings, OutputState, SupplyLimits, message
from drivers.supplies import NUMBER, WiredSupply

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_STATE: Final = rf'"({NUMBER}), ?({NUMBER})";{NUMBER};{NUMBER};[+-]?\d'
_ZERO_V: Final = 0.01


class KeysightE3631A(WiredSupply):
    """A `PowerSupply` with the outputs P6V, P25V and N25V; voltages of N25V are negative."""

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        *,
        limits: SupplyLimits,
        interface: Literal["gpib", "rs232"] = "gpib",
    ) -> None:
        super().__init__(name, session, clock, limits=limits)
        self._interface = interface

    def _prove(self) -> None:
        if self._interface == "rs232":
            self._session.write("SYST:REM")
        self._identify(facts.MAKERS, facts.MODELS, "E3631A")
        self._session.write("*CLS")

    def _states(self) -> dict[str, OutputState]:
        on = self._session.ask("OUTP?", "[01]", "0 or 1") == "1"
        return {
            output: self._state(output, number, on) for number, output in enumerate(self.outputs, start=1)
        }

    def _state(self, output: str, number: int, on: bool) -> OutputState:
        """Query an output's settings, voltage, current and regulation in one message, without selecting it."""
        reply = self._session.ask(
            f"APPL? {output};:MEAS:VOLT? {output};:MEAS:CURR? {output};:STAT:QUES:INST:ISUM{number}:COND?",
            _STATE,
            message("settings, voltage, current and condition of an output"),
        )
        applied, volts, amperes, condition = reply.split(";")
        voltage_v, limit_a = (float(text) for text in applied.strip('"').split(","))
        if int(condition) == facts.FAILED:
            raise InstrumentRefused(
                self.name, f"its output {output} reports that its hardware has failed", "have it serviced"
            )
        settings = OutputSettings(voltage_v, limit_a)
        limiting = on and int(condition) == facts.LIMITING
        return OutputState(on, settings, float(volts), float(amperes), limiting=limiting)

    def _refuse_unready(
        self, states: Mapping[str, OutputState], settings: Mapping[str, OutputSettings]
    ) -> None:
        """Raise `InstrumentRefused` in track mode, or if the common switch would power an unused output."""
        if any(state.on for state in states.values()):
            return
        if others := [
            o for o, s in states.items() if o not in settings and abs(s.settings.voltage_v) > _ZERO_V
        ]:
            set_to = " and ".join(f"{output} to {states[output].settings.voltage_v:g} V" for output in others)
            raise InstrumentRefused(
                self.name,
                f"all of its outputs are switched on together, and it is set on {set_to}",
                "set what is not used to 0 V, or name it in the bench file",
            )
        if self._session.ask("OUTP:TRAC?", "[01]", "0 or 1") == "1":
            raise InstrumentRefused(
                self.name,
                "its output N25V follows P25V (track mode)",
                "end the track mode at its front panel",
            )

    def _apply(self, output: str, wanted: OutputSettings) -> None:
        self._session.write(f"APPL {output},{wanted.voltage_v:.4f},{wanted.current_limit_a:.4f}")

    def _switch(self, output: str, on: bool) -> None:
        self._session.write(f"OUTP {'ON' if on else 'OFF'}")

    def _switch_all_off(self) -> None:
        self._session.write("OUTP OFF")

    def _errors(self) -> list[str]:
        return self._scpi_errors()

    def _go_to_local(self) -> None:
        if self._interface == "rs232":
            self._session.write("SYST:LOC")
