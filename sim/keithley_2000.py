"""A simulated Keithley 2000 on one channel of the world: DC volts, the buffer, triggering.

Other functions cause the error -113; filter and relative can be set but have no effect. The meter accepts
commands while it measures: only *WAI and *OPC? wait. Sources: see `drivers.facts.keithley_2000`. The format
of numbers other than readings is an assumption, not from the manual.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import keithley_2000 as facts
from sim.scpi import Command, ScpiInstrument, switch_lines
from sim.scpi_values import (
    Choice,
    Number,
    ScpiError,
    Text,
    Value,
    next_above,
    number_of,
    numbered,
    quoted,
    within,
)
from sim.voltmeters import (
    Accuracy,
    Converter,
    Function,
    FunctionSettings,
    MeasuringCycle,
    MeteredSignal,
    reading_text,
)
from sim.wires.session import LineEnds

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.clock import Clock

_ERRORS: Final = {-230: "Data corrupt or stale", -350: "Queue overflow"}
_DC_VOLTS: Final = Function("VOLT", "VOLTage[:DC]", "V", facts.RANGES_V, {})
_NPLC: Final = (facts.NPLC[0], facts.NPLC[-1])
_COUNTS: Final = (1, facts.MEMORY_READINGS)
_SIZES: Final = (facts.LEAST_SAMPLES, facts.MEMORY_READINGS)
_WAITING: Final = ("*WAI", "*OPC?")


@dataclass
class Measuring:
    """The settings of the meter, as a `sim.voltmeters.Measurement`; the defaults are those of *RST."""

    nplc: float = 1.0
    autozero: bool = True
    averages: bool = False
    relative: bool = False
    function: Function = _DC_VOLTS
    bandwidth_hz: float = 20.0
    settings: FunctionSettings = field(default_factory=lambda: FunctionSettings(1000.0, 1e-6))

    def set_nplc(self, nplc: float) -> None:
        """Set the integration time in power-line cycles and the resolution that follows from it."""
        self.nplc = nplc
        self.settings.resolution = next(step for least, step in facts.RESOLUTION.items() if nplc >= least)


class Buffer(MeasuringCycle):
    """The trigger system and the buffer, which FEED:CONTrol NEXT lets store readings until it is full."""

    memory_depth = facts.MEMORY_READINGS

    def __init__(self, clock: Clock, interrupted: Callable[[], bool], converter: Converter) -> None:
        self._converter = converter
        self.measuring = Measuring()
        self.size = 100
        self.stores = False
        self.stored: list[str] = []
        super().__init__(clock, interrupted)

    def preset(self) -> None:
        """Set the defaults of *RST; keep the buffer."""
        self.measuring = Measuring()
        self.source = "IMM"
        self.automatic_delay = True
        self.continuous = False
        self.trigger_count = 1
        self.sample_count = 1

    def initiate(self) -> None:
        """INITiate: start a measurement. Raises `ScpiError` -213 if not idle, or in continuous mode."""
        if self.continuous:
            raise ScpiError(-213)
        self._require_idle()
        self._converter.begin()
        self._start(self.trigger_count, keeps=True)

    def settle(self) -> None:
        """Store the readings of a measurement that has ended; do not wait for one in progress."""
        if self._due and not self.in_progress:
            self._collect()

    def clear(self) -> None:
        """TRACe:CLEar: empty the buffer."""
        self.stored = []

    def data(self) -> str:
        """TRACe:DATA?: return the buffer. Raises `ScpiError` -230 if it is empty."""
        if not self.stored:
            raise ScpiError(-230)
        return ",".join(self.stored)

    def resize(self, size: int) -> None:
        """TRACe:POINts: set the buffer's size and empty it. Raises `ScpiError` -221 while it is being filled."""
        if self.stores:
            raise ScpiError(-221)
        self.size, self.stored = size, []

    def _schedule(self, triggers: int) -> None:
        start_s = self._clock.now_s() + self._converter.settling_s(self.measuring)
        step_s = self._converter.sample_s(self.measuring)
        middle_s = self._converter.integration_s(self.measuring) / 2.0
        samples = triggers * self.sample_count
        self._due = [start_s + i * step_s + middle_s for i in range(samples)]
        self._measures_until(start_s + samples * step_s)

    def _sampled(self, due: float) -> str:
        value = self._converter.sample(self.measuring, due)
        text = _text(value, self._converter.step(self.measuring))
        if self.stores:
            self.stored.append(text)
            self.stores = len(self.stored) < self.size
        return text


class Keithley2000(ScpiInstrument):
    """A Keithley 2000, which measures the signal `source` at the time of `clock`.

    `Converter` explains `noise` and `accuracy`. `interface` is the selected interface; all commands are accepted
    over both. Over RS-232 a message may end in CR, LF or both; each reply ends in `line_end`.
    """

    def __init__(
        self,
        source: MeteredSignal,
        clock: Clock,
        *,
        interface: Literal["gpib", "rs232"] = "gpib",
        line_end: str = "\n",
        noise: bool = True,
        accuracy: Accuracy | None = None,
        line_hz: float = 50.0,
    ) -> None:
        super().__init__(numbered(facts.IDENTITY, source.place), _ERRORS)
        self.interface = interface
        messages = tuple(end.encode("ascii") for end in facts.TERMINATORS.values())
        self.line_ends = LineEnds(messages if interface == "rs232" else (b"\n",), line_end.encode("ascii"))
        self._converter = Converter(source, facts, noise=noise, accuracy=accuracy, line_hz=line_hz)
        self.buffer = Buffer(clock, self.device_clear_pending, self._converter)
        self.add(self._sense_commands())
        self.add(self._trigger_commands())
        self.add(self._buffer_commands())
        self.add(self._system_commands())
        self._switch_on()

    @property
    def cycle(self) -> Buffer:
        """The trigger system."""
        return self.buffer

    @property
    def overloaded(self) -> bool:
        """Whether every sample is an overload, whatever the voltage at the terminals; can be set."""
        return self._converter.overloaded

    @overloaded.setter
    def overloaded(self, overloaded: bool) -> None:
        self._converter.overloaded = overloaded

    def admit(self, command: Command) -> None:
        """Store the readings of an ended measurement; wait for one in progress if the command requires it."""
        self.buffer.settle()
        if command.notation in _WAITING:
            self.buffer.complete()

    def device_clear(self) -> None:
        """Stop measuring; keep settings, buffer and errors."""
        self.buffer.abort()

    def reset(self) -> None:
        """*RST: idle, autorange, 1 PLC, one immediate trigger; keep buffer, errors and masks."""
        self.buffer.abort()
        self.buffer.preset()

    def power_cycle(self) -> None:
        """Switch off and on: settings, buffer and errors are lost; the meter measures continuously, filtered."""
        super().power_cycle()
        self.buffer.clear()
        self._switch_on()

    def number(self, value: float) -> str:
        """Return a whole number in the meter's format: `0`."""
        return f"{round(value):d}"

    def _switch_on(self) -> None:
        self.buffer.size, self.buffer.stores = 100, False
        self.buffer.continuous = True
        self.buffer.measuring.averages = True

    # --- commands -----------------------------------------------------------------------------------

    def _sense_commands(self) -> list[Command]:
        volts = "[SENSe[1]:]VOLTage[:DC]"
        return [
            Command("[SENSe[1]:]FUNCtion", self._select, (Text(),)),
            Command("[SENSe[1]:]FUNCtion?", lambda: quoted("VOLT:DC")),
            Command(f"{volts}:RANGe[:UPPer]", self._set_range, (Number("V"),)),
            Command(f"{volts}:RANGe[:UPPer]?", lambda: f"{self._settings.range_value:.6E}"),
            *switch_lines(f"{volts}:RANGe:AUTO", lambda: self._settings, "autorange"),
            Command(f"{volts}:NPLCycles", self._set_nplc, (Number(),)),
            Command(f"{volts}:NPLCycles?", lambda: f"{self.buffer.measuring.nplc:.2f}"),
            *switch_lines(f"{volts}:AVERage:STATe", lambda: self.buffer.measuring, "averages"),
            *switch_lines(f"{volts}:REFerence:STATe", lambda: self.buffer.measuring, "relative"),
        ]

    def _trigger_commands(self) -> list[Command]:
        buffer = self.buffer
        return [
            Command("INITiate[:IMMediate]", buffer.initiate),
            *switch_lines("INITiate:CONTinuous", lambda: buffer, "continuous"),
            Command("ABORt", buffer.abort),
            Command("*WAI", lambda: None),
            Command("TRIGger:SOURce", self._set_source, (Choice(("IMMediate", "BUS")),)),
            Command("TRIGger:SOURce?", lambda: buffer.source),
            *switch_lines("TRIGger:DELay:AUTO", lambda: buffer, "automatic_delay"),
            *self._count("TRIGger:COUNt", "trigger_count"),
            *self._count("SAMPle:COUNt", "sample_count"),
        ]

    def _buffer_commands(self) -> list[Command]:
        buffer = self.buffer
        return [
            Command("TRACe:CLEar", buffer.clear),
            Command("TRACe:POINts", lambda v: buffer.resize(_whole(v, _SIZES)), (Number(),)),
            Command("TRACe:POINts?", lambda: self.number(buffer.size)),
            Command("TRACe:FEED", lambda _: None, (Choice(("SENSe", "SENSe1")),)),
            Command("TRACe:FEED:CONTrol", self._set_control, (Choice(("NEVer", "NEXT")),)),
            Command("TRACe:DATA?", buffer.data),
        ]

    def _system_commands(self) -> list[Command]:
        return [
            *switch_lines("SYSTem:AZERo:STATe", lambda: self.buffer.measuring, "autozero"),
            Command("SYSTem:REMote", lambda: None),
            Command("SYSTem:LOCal", lambda: None),
            Command("FORMat[:DATA]", lambda _: None, (Choice(("ASCii",)),)),
            Command("FORMat[:DATA]?", lambda: "ASC"),
            Command("FORMat:ELEMents", lambda _: None, (Choice(("READing",)),)),
            Command("FORMat:ELEMents?", lambda: "READ"),
        ]

    def _count(self, notation: str, name: str) -> list[Command]:
        return [
            Command(notation, lambda v: setattr(self.buffer, name, _whole(v, _COUNTS)), (Number(),)),
            Command(f"{notation}?", lambda: self.number(getattr(self.buffer, name))),
        ]

    @property
    def _settings(self) -> FunctionSettings:
        return self.buffer.measuring.settings

    def _select(self, function: str) -> None:
        if function.upper() not in ("VOLT", "VOLTAGE", "VOLT:DC", "VOLTAGE:DC"):
            raise ScpiError(-224)

    def _set_range(self, value: Value) -> None:
        highest_v = within(abs(number_of(value, 0.0, facts.HIGHEST_V)), 0.0, facts.HIGHEST_V)
        self._settings.range_value = next_above(min(highest_v, facts.RANGES_V[-1]), facts.RANGES_V)
        self._settings.autorange = False

    def _set_nplc(self, value: Value) -> None:
        self.buffer.measuring.set_nplc(within(number_of(value, *_NPLC), *_NPLC))

    def _set_source(self, source: str) -> None:
        self.buffer.source = source

    def _set_control(self, control: str) -> None:
        self.buffer.stores = control == "NEXT"


def _whole(value: Value, ends: tuple[int, int]) -> int:
    """Return a count. Raises `ScpiError` -222 outside `ends`."""
    return round(within(number_of(value, *ends), *ends))


def _text(value: float, step: float) -> str:
    """Format a reading; an overflow is +9.9E37 or -9.9E37."""
    if abs(value) >= facts.OVERLOAD_V:
        return "+9.9E37" if value > 0.0 else "-9.9E37"
    return reading_text(value, step)
