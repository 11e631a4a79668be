"""A simulated HP/Agilent 34401A multimeter on one channel of the world.

Complete for DC volts; the other functions can be set, read back and measured, with readings as of a meter
that has nothing but a DC voltage at its terminals. Source: 34401A User's Guide (34401-90004), chapters 3-5.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import agilent_34401a as facts
from sim.agilent_34401a.functions import FUNCTIONS, Configuration, Function
from sim.agilent_34401a.math import Math
from sim.agilent_34401a.trigger import Trigger
from sim.scpi import Command
from sim.scpi_values import (
    DEF,
    DEVICE_ERROR,
    MAX,
    MIN,
    Boolean,
    CommandParameter,
    Number,
    ScpiError,
    Text,
    Value,
    Word,
    integer,
    quoted,
)
from sim.voltmeters import VOLT_OVERLOAD, Accuracy, Converter, Interface, LineMeter, MeteredSignal

if TYPE_CHECKING:
    from drivers.clock import Clock

_ERRORS: Final = {
    531: "Insufficient memory",
    540: "Cannot use overload as math reference",
    702: "Cal secured",
    703: "Invalid secure code",
}

_CURRENT_OVERLOAD: Final = 2
_OHMS_OVERLOAD: Final = 512

_DISPLAY_WIDTH: Final = 12
_SECURITY_CODE: Final = "HP034401"
_CALIBRATION_COUNT: Final = 12


class Agilent34401A(LineMeter):
    """The meter: settings, trigger system, status; `source` is what it is wired to, `clock` its time.

    `interface` is as of a `LineMeter`. `noise` False gives exact values: no noise, no rounding to the resolution.
    `accuracy` "90 days" gives it a gain, an offset and a temperature coefficient of its own within that
    specification. `terminals` is the front panel's switch.
    """

    model = facts.MODELS[0]
    beside_measuring = ("INITiate[:IMMediate]",)
    _trigger_type: type[Trigger] = Trigger

    def __init__(
        self,
        source: MeteredSignal,
        clock: Clock,
        *,
        interface: Interface = "lan",
        noise: bool = True,
        accuracy: Accuracy | None = None,
        line_hz: float = 50.0,
        terminals: Literal["front", "rear"] = "front",
    ) -> None:
        super().__init__(facts.IDENTITY, _ERRORS, interface)
        self.terminals = terminals
        self.beeper_enabled = True
        self._calibration_secured = True
        self.configuration = Configuration(self._configuration_changed)
        self.math = Math(lambda: self.configuration.function, self._note)
        self._converter = Converter(source, facts, noise=noise, accuracy=accuracy, line_hz=line_hz)
        self.trigger = self._trigger_type(
            clock,
            self.configuration,
            self._converter,
            self.math,
            self._overload,
            self.device_clear_pending,
        )
        self._clear_text()
        self.display_on = True
        for part in (self.configuration, self.trigger, self.math):
            self.add(part.commands())
        self.add(self._measure_commands())
        self.add(self._system_commands())
        self.add(self._calibration_commands())

    # --- what the wire and the bench do -------------------------------------------------------------

    @property
    def cycle(self) -> Trigger:
        """Its trigger system."""
        return self.trigger

    @property
    def converters(self) -> tuple[Converter]:
        """Its one converter."""
        return (self._converter,)

    def external_trigger(self) -> None:
        """Give a pulse at the Ext Trig terminal; one that is not waited for is ignored (-211)."""
        try:
            self.trigger.complete()
            self.trigger.trigger("EXT")
        except ScpiError as error:
            self.report(error.number)

    def reset(self) -> None:
        """*RST: DC volts, autorange, 10 PLC, one immediate trigger; errors and masks stay."""
        self.trigger.abort()
        self.configuration.preset()
        self.trigger.preset()
        self.math.preset()
        self.display_on = True
        self._clear_text()

    @property
    def display_text(self) -> str:
        """What DISPlay:TEXT has put on the display."""
        return self._display_text

    # --- what its parts report ----------------------------------------------------------------------

    def _configuration_changed(self) -> None:
        self.trigger.stop_waiting()
        self.math.drop_if_unfit()

    def _note(self, error: int, questionable: int) -> None:
        if error:
            self.report(error)
        self.status.questionable |= questionable

    def _overload(self) -> None:
        """An overload is seen in the registers only: it is not an error of the queue."""
        unit = self.configuration.function.unit
        bits = {"A": _CURRENT_OVERLOAD, "OHM": _OHMS_OVERLOAD}
        self.status.questionable |= bits.get(unit, VOLT_OVERLOAD)
        self.status.event |= DEVICE_ERROR

    # --- CONFigure and MEASure ----------------------------------------------------------------------

    def _measure_commands(self) -> list[Command]:
        lines = []
        for function in FUNCTIONS.values():
            parameters: tuple[CommandParameter, ...] = ()
            if function.subsystem or function.keeps_range_of:
                words = (MIN, MAX, DEF)
                parameters = (Number(function.unit, words, optional=True),) * 2
            lines += [
                Command(f"CONFigure:{function.notation}", partial(self._configure, function), parameters),
                Command(f"MEASure:{function.notation}?", partial(self._measure, function), parameters),
            ]
        return lines

    def _configure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> None:
        self.configuration.configure(function, range_value, resolution)
        self.trigger.abort()
        self.trigger.preset()
        self.math.preset()

    def _measure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> str | None:
        self._configure(function, range_value, resolution)
        return self.trigger.read()

    # --- display, system, calibration ---------------------------------------------------------------

    def _system_commands(self) -> list[Command]:
        return [
            Command("ROUTe:TERMinals?", lambda: {"front": "FRON", "rear": "REAR"}[self.terminals]),
            Command("DISPlay[:WINDow][:STATe]", self._set_display, (Boolean(),)),
            Command("DISPlay[:WINDow][:STATe]?", lambda: str(int(self.display_on))),
            Command("DISPlay[:WINDow]:TEXT[:DATA]", self._show, (Text(),)),
            Command("DISPlay[:WINDow]:TEXT[:DATA]?", lambda: quoted(self._display_text)),
            Command("DISPlay[:WINDow]:TEXT:CLEar", self._clear_text),
            Command("SYSTem:BEEPer", _beep),
            Command("SYSTem:BEEPer:STATe", self._set_beeper, (Boolean(),)),
            Command("SYSTem:BEEPer:STATe?", lambda: str(int(self.beeper_enabled))),
        ]

    def _calibration_commands(self) -> list[Command]:
        """Calibration can be looked at; it cannot be changed, as nothing is there to calibrate against."""
        return [
            Command("CALibration?", self._refuse_calibration),
            Command("CALibration:COUNt?", lambda: integer(_CALIBRATION_COUNT)),
            Command("CALibration:SECure:CODE", self._refuse_calibration, (Word(),)),
            Command("CALibration:SECure:STATe", self._secure, (Boolean(), Word(optional=True))),
            Command("CALibration:SECure:STATe?", lambda: str(int(self._calibration_secured))),
            Command("CALibration:STRing", self._refuse_calibration, (Text(),)),
            Command("CALibration:STRing?", lambda: quoted("")),
            Command("CALibration:VALue", self._refuse_calibration, (Number("V"),)),
            Command("CALibration:VALue?", lambda: f"{0.0:+.8E}"),
        ]

    def _set_display(self, flag: str) -> None:
        self.display_on = flag == "1"

    def _show(self, text: str) -> None:
        self._display_text = text[:_DISPLAY_WIDTH]

    def _clear_text(self) -> None:
        self._display_text = ""

    def _set_beeper(self, flag: str) -> None:
        self.beeper_enabled = flag == "1"

    def _refuse_calibration(self, _value: Value = "") -> str | None:
        raise ScpiError(702)

    def _secure(self, flag: str, code: str = "") -> None:
        if code != _SECURITY_CODE and (code or flag == "0"):
            raise ScpiError(703)
        self._calibration_secured = flag == "1"


def _beep() -> None:
    """SYSTem:BEEPer: nobody is there to hear it."""
