"""A simulated Watlow F4T controller, around the block of the world: SCPI without an error queue.

Source: Watlow F4T User's Guide, "SCPI commands"; TestEquity F4T manuals.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from drivers.facts.watlow_f4t import FAHRENHEIT_AT_0_C, FAHRENHEIT_PER_C
from sim.scpi import Command, ScpiInstrument
from sim.scpi_values import Boolean, Choice, Number, ScpiError

if TYPE_CHECKING:
    from sim.world.world import World

IDENTITY: Final = "Watlow Electric,F4T,12345,04:07:0011"
OLD_IDENTITY: Final = "Watlow Electric,F4T,12345,03:01:0004"


class WatlowF4T(ScpiInstrument):
    """One control loop, number `loop`, and one output, number `output`, that switches conditioning on.

    `unit` is that of its temperatures; `old_firmware` speaks °F only and cannot be asked. `error` is that of
    the loop, such as a broken sensor.
    """

    def __init__(
        self,
        world: World,
        *,
        unit: Literal["C", "F"] = "C",
        old_firmware: bool = False,
        output_on: bool = True,
        loop: int = 1,
        output: int = 1,
        lowest_c: float = -70.0,
        highest_c: float = 180.0,
    ) -> None:
        super().__init__(OLD_IDENTITY if old_firmware else IDENTITY)
        self._world = world
        self._unit = "F" if old_firmware else unit
        self._set_point_c = 23.0
        self._output_on = output_on
        self._range = (lowest_c, highest_c)
        self._ramp = {"RACTION": "OFF", "RSCALE": "MINUTES", "RRATE": "3.0"}
        self.error = False
        self.add(self._loop_commands(f"SOURce:CLOop{loop}", f"OUTPut{output}"))
        if not old_firmware:
            self.add(self._unit_commands())

    def power_cycle(self) -> None:
        """Switch off and on: the set point and the unit are kept, the output is off."""
        self._switch("0")

    def _common_commands(self) -> list[Command]:
        return [Command("*IDN?", lambda: self.identity)]

    def _status_commands(self) -> list[Command]:
        return []

    def _loop_commands(self, loop: str, output: str) -> list[Command]:
        return [
            Command(f"{loop}:PVALue?", lambda: self._shown(self._world.chamber_c)),
            Command(f"{loop}:SPOint", self._demand, (Number(words=()),)),
            Command(f"{loop}:SPOint?", lambda: self._shown(self._set_point_c)),
            Command(f"{loop}:ERRor?", lambda: "ERROR" if self.error else "NONE"),
            Command(
                f"{loop}:RACTion",
                lambda word: self._ramp.update(RACTION=word),
                (Choice(("OFF", "STARTUP", "SETPOINT", "BOTH")),),
            ),
            Command(f"{loop}:RACTion?", lambda: self._ramp["RACTION"]),
            Command(
                f"{loop}:RSCAle", lambda word: self._ramp.update(RSCALE=word), (Choice(("MINUTES", "HOURS")),)
            ),
            Command(f"{loop}:RSCAle?", lambda: self._ramp["RSCALE"]),
            Command(f"{loop}:RRATe", lambda rate: self._ramp.update(RRATE=f"{rate:g}"), (Number(words=()),)),
            Command(f"{loop}:RRATe?", lambda: self._ramp["RRATE"]),
            Command(f"{output}:STATe", self._switch, (Boolean(),)),
            Command(f"{output}:STATe?", lambda: "ON" if self._output_on else "OFF"),
        ]

    def _unit_commands(self) -> list[Command]:
        return [
            Command("UNIT:TEMPerature", self._set_unit, (Choice(("C", "F")),)),
            Command("UNIT:TEMPerature?", lambda: self._unit),
            Command("UNIT:TEMPerature:DISPlay?", lambda: self._unit),
        ]

    def _shown(self, temperature_c: float) -> str:
        fahrenheit = self._unit == "F"
        value = temperature_c * FAHRENHEIT_PER_C + FAHRENHEIT_AT_0_C if fahrenheit else temperature_c
        return f"{value:.2f}"

    def _demand(self, value: float) -> None:
        target_c = (value - FAHRENHEIT_AT_0_C) / FAHRENHEIT_PER_C if self._unit == "F" else value
        lowest_c, highest_c = self._range
        if not lowest_c <= target_c <= highest_c:
            raise ScpiError(-222)
        self._set_point_c = target_c
        self._condition()

    def _switch(self, flag: str) -> None:
        self._output_on = flag == "1"
        self._condition()

    def _set_unit(self, unit: str) -> None:
        self._unit = "C" if unit == "C" else "F"

    def _condition(self) -> None:
        if self._output_on:
            self._world.ramp_chamber(self._set_point_c)
        else:
            self._world.switch_chamber_off()
