"""A simulated Keysight E36311A, E36312A or E36313A, whose outputs feed the block of the world.

The simulation covers setting, protecting, switching and monitoring the outputs, but not lists, triggers or
data logging. Source: E36300 Series Programming Guide, as in `drivers.facts.keysight_e36300`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.facts import keysight_e36300 as facts
from sim.scpi import Command
from sim.scpi_values import Boolean, Number, OutputList, ScpiError, listed, numbered
from sim.supply import LEVEL, WORDS, KeysightSupply, shown_number

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.scpi_values import CommandParameter, Value
    from sim.world.power import OutputPhase
    from sim.world.world import World


class KeysightE36300(KeysightSupply):
    """A supply of the E36300 series; commands without a channel list apply to its first output."""

    def __init__(self, world: World, *, model: str = "E36312A") -> None:
        super().__init__(world, facts, model, numbered(facts.IDENTITY.format(model=model), 1))
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
        return facts.OUTPUTS[self.model]

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
