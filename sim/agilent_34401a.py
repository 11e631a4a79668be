"""A simulated HP/Agilent 34401A multimeter on one channel of the world.

It accepts the commands that drivers and other clients send; any other command causes the error -113. Every function
can be selected and set, but the terminals carry only a DC voltage. No trigger ever arrives from outside. Source:
34401A User's Guide (34401-90004), chapters 3-5; chapter 8, specifications.
"""

from __future__ import annotations

import math
import re
from functools import partial
from typing import TYPE_CHECKING, Final

from drivers.facts import agilent_34401a as facts
from sim.scpi import Command, Interface, never, number_lines, switch_lines
from sim.scpi_values import (
    DEF,
    DEVICE_ERROR,
    INF,
    MAX,
    MIN,
    Boolean,
    Choice,
    CommandParameter,
    Number,
    ScpiError,
    Text,
    Value,
    integer,
    next_above,
    next_below,
    notation_pattern,
    number_of,
    quoted,
    within,
)
from sim.voltmeters import (
    Accuracy,
    Converter,
    Function,
    FunctionSettings,
    LineMeter,
    MeasuringCycle,
    MeteredSignal,
    TriggerState,
    chosen_range,
    chosen_resolution,
    reading_text,
)
from sim.wires.session import LineEnds

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from drivers.clock import Clock

# --- functions and their settings -------------------------------------------------------------------

_NPLC: Final = facts.NPLC_BY_RESOLUTION
_GATE_S: Final = {1e-6: 1.0, 1e-5: 0.1, 1e-4: 0.01}
_ON_DISPLAY: Final = {1e-6: 0.0, 1e-5: 0.0, 1e-4: 0.0}
_BANDWIDTHS_HZ: Final = (3.0, 20.0, 200.0)
_DEFAULT_BANDWIDTH_HZ: Final = 20.0
_DC_V: Final = facts.RANGES_V
_AC_V: Final = (0.1, 1.0, 10.0, 100.0, 750.0)
_OHM: Final = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)

FUNCTIONS: Final[dict[str, Function]] = {
    function.name: function
    for function in (
        Function("VOLT", "VOLTage[:DC]", "V", _DC_V, _NPLC),
        Function("VOLT:RAT", "VOLTage[:DC]:RATio", "V", _DC_V, _NPLC, settings_of="VOLT"),
        Function("VOLT:AC", "VOLTage:AC", "V", _AC_V, _ON_DISPLAY, ""),
        Function("CURR", "CURRent[:DC]", "A", (0.01, 0.1, 1.0, 3.0), _NPLC),
        Function("CURR:AC", "CURRent:AC", "A", (1.0, 3.0), _ON_DISPLAY, ""),
        Function("RES", "RESistance", "OHM", _OHM, _NPLC),
        Function("FRES", "FRESistance", "OHM", _OHM, _NPLC),
        Function("FREQ", "FREQuency", "HZ", _AC_V, _GATE_S, "APERture"),
        Function("PER", "PERiod", "S", _AC_V, _GATE_S, "APERture"),
        Function("CONT", "CONTinuity", "OHM", (1e3,), _ON_DISPLAY, "", fixed=True),
        Function("DIOD", "DIODe", "V", (1.0,), _ON_DISPLAY, "", fixed=True),
    )
}


def _default_settings(function: Function) -> FunctionSettings:
    start = 10.0 if 10.0 in function.ranges else function.ranges[0]
    return FunctionSettings(start, function.default_resolution)


class Configuration:
    """The measurement settings of the meter.

    A command for a single setting, except the input impedance, calls `on_change`; CONFigure and *RST do not.
    A number between two accepted values is replaced by the one that still meets the request: the higher range
    or integration time, the lower detector bandwidth, the finer resolution.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self.preset()

    def preset(self) -> None:
        """Set the defaults of *RST."""
        self.function = FUNCTIONS["VOLT"]
        self.by_function = {name: _default_settings(function) for name, function in FUNCTIONS.items()}
        self.autozero = True
        self.high_impedance = False
        self.bandwidth_hz = _DEFAULT_BANDWIDTH_HZ

    @property
    def settings(self) -> FunctionSettings:
        """The settings of the selected function; the ratio function uses those of DC volts."""
        return self.by_function[self.function.settings_of or self.function.name]

    @property
    def nplc(self) -> float:
        """The integration time of the selected function in power-line cycles, or its gate time in s."""
        return self.function.integration[self.settings.resolution]

    def configure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> None:
        """CONFigure: select a function with range and resolution, and preset the other settings.

        Raises `ScpiError` -222 for an invalid range, 532 for too fine a resolution, -221 for a numeric resolution
        with autorange; the settings then stay unchanged.
        """
        fresh = _default_settings(function)
        if range_value == DEF and not isinstance(resolution, str):
            raise ScpiError(-221)
        if range_value != DEF:
            fresh.range_value = chosen_range(function, range_value)
            fresh.autorange = False
        fresh.resolution = chosen_resolution(function, resolution, fresh.range_value)
        self.function = function
        self.by_function[function.name] = fresh
        self.autozero = not function.has_nplc or self.nplc >= 1.0
        self.high_impedance = False
        self.bandwidth_hz = _DEFAULT_BANDWIDTH_HZ

    def commands(self) -> list[Command]:
        """Return the commands and queries of the configuration."""
        bandwidths = (_BANDWIDTHS_HZ[0], _BANDWIDTHS_HZ[-1])
        lines = [
            Command("[SENSe:]FUNCtion", self._select, (Text(),)),
            Command("[SENSe:]FUNCtion?", lambda: quoted(self.function.name)),
            *number_lines(
                "[SENSe:]DETector:BANDwidth", "HZ", bandwidths, lambda: self.bandwidth_hz, self._set_bandwidth
            ),
            *self.autozero_lines("[SENSe:]ZERO:AUTO"),
            *self.impedance_lines("INPut:IMPedance:AUTO"),
        ]
        for function in FUNCTIONS.values():
            if not function.fixed and not function.settings_of:
                lines += self._range_lines(function) + self._resolution_lines(function)
        return lines

    def autozero_lines(self, notation: str) -> list[Command]:
        """Return the command and the query of autozero; ONCE takes one zero reading and switches autozero off."""
        return switch_lines(notation, lambda: self, "autozero", ("ONCE",), self._on_change)

    def impedance_lines(self, notation: str) -> list[Command]:
        """Return the command and the query of the high input impedance."""
        return switch_lines(notation, lambda: self, "high_impedance")

    def _range_lines(self, function: Function) -> list[Command]:
        node = f"[SENSe:]{function.notation}{':VOLTage' if function.has_aperture else ''}:RANGe"
        unit = "V" if function.has_aperture else function.unit

        def settings() -> FunctionSettings:
            return self.by_function[function.name]

        def set_range(value: float) -> None:
            settings().range_value = next_above(value, function.ranges)
            settings().autorange = False
            self._on_change()

        ends = (function.ranges[0], function.ranges[-1])
        return [
            *number_lines(node, unit, ends, lambda: settings().range_value, set_range),
            *switch_lines(f"{node}:AUTO", settings, "autorange", (), self._on_change),
        ]

    def _resolution_lines(self, function: Function) -> list[Command]:
        node = f"[SENSe:]{function.notation}"
        by_integration = {integration: resolution for resolution, integration in function.integration.items()}
        accepted = sorted(by_integration)

        def settings() -> FunctionSettings:
            return self.by_function[function.name]

        def set_resolution(value: Value) -> None:
            settings().resolution = chosen_resolution(function, value, settings().range_value)
            self._on_change()

        def read_resolution(word: str = "") -> str:
            limits = {MIN: min(function.integration), MAX: max(function.integration)}
            return f"{limits.get(word, settings().resolution) * settings().range_value:+.6E}"

        def set_integration(value: float) -> None:
            wanted = within(value, accepted[0] * (1 - 1e-6), 1e9)
            settings().resolution = by_integration[next_above(wanted, accepted)]
            self._on_change()

        lines = []
        if not function.has_aperture:
            lines += [
                Command(f"{node}:RESolution", set_resolution, (Number(function.unit),)),
                Command(f"{node}:RESolution?", read_resolution, (Number(optional=True),)),
            ]
        if function.keyword:
            lines += number_lines(
                f"{node}:{function.keyword}",
                "S" if function.has_aperture else "",
                (accepted[0], accepted[-1]),
                lambda: function.integration[settings().resolution],
                set_integration,
            )
        return lines

    def _select(self, name: str) -> None:
        for function in FUNCTIONS.values():
            if notation_pattern(function.notation).match(name.strip()):
                self.function = function
                self._on_change()
                return
        raise ScpiError(-224)

    def _set_bandwidth(self, value: float) -> None:
        self.bandwidth_hz = next_below(within(value, _BANDWIDTHS_HZ[0], 3e5), _BANDWIDTHS_HZ)
        self._on_change()


# --- trigger system and memory ----------------------------------------------------------------------

_MOST_READINGS: Final = 50_000
_LONGEST_DELAY_S: Final = 3600.0
_INFINITE: Final = "9.90000000E+37"


class Trigger(MeasuringCycle):
    """The trigger settings, the measurement in progress, and the memory.

    INITiate or READ? starts a measurement: the meter waits for a trigger, lets the delay pass, and samples.
    `on_overload` is called for each reading outside the range. `interrupted` returns whether a device clear has
    arrived. In a subclass with `keeps_latest`, the memory keeps the latest readings, including those of READ?.
    """

    memory_depth = facts.MEMORY_READINGS
    most_readings = _MOST_READINGS
    keeps_latest = False

    def __init__(
        self,
        clock: Clock,
        configuration: Configuration,
        converter: Converter,
        on_overload: Callable[[], None],
        interrupted: Callable[[], bool],
    ) -> None:
        self._configuration = configuration
        self._converter = converter
        self._on_overload = on_overload
        super().__init__(clock, interrupted)

    def preset(self) -> None:
        """Set the defaults of *RST, CONFigure and MEASure: one immediate trigger, one sample, automatic delay."""
        self.source = "IMM"
        self.stated_delay_s: float | None = None
        self.trigger_count: float = 1
        self.sample_count = 1

    def stop_waiting(self) -> None:
        """Become idle if the meter waits for a trigger; called after a change of the measurement settings."""
        if self.state is TriggerState.WAITING:
            self.state = TriggerState.IDLE

    def initiate(self) -> None:
        """INITiate: start a measurement into memory.

        Raises `ScpiError` -213 if a measurement is in progress or waits for a trigger, 531 if the memory is too
        small for its readings, 522 for more than `most_readings` readings.
        """
        self._require_idle()
        if not self.keeps_latest and self.trigger_count * self.sample_count > self.memory_depth:
            raise ScpiError(531)
        self._begin(keeps=True)

    def read(self) -> str | None:
        """READ?: measure and return the readings, which are stored only if `keeps_latest`.

        With an external trigger there is no reply (None): the meter waits until a device clear. Raises
        `ScpiError` -213 if a measurement is in progress or waits for a trigger, -214 for the trigger source
        BUS, 522 for more than `most_readings` readings, which is a limit of this simulation.
        """
        self._require_idle()
        if self.source == "BUS":
            raise ScpiError(-214)
        self._begin(keeps=self.keeps_latest)
        return self._outcome()

    def _begin(self, keeps: bool) -> None:
        if self.trigger_count * self.sample_count > self.most_readings:
            raise ScpiError(522)
        self._converter.begin()
        self._start(self.trigger_count, keeps=keeps)

    @property
    def delay_s(self) -> float:
        """The delay from a trigger to the beginning of its sample, s."""
        stated_s = self.stated_delay_s
        return self._converter.settling_s(self._configuration) if stated_s is None else stated_s

    def _schedule(self, triggers: int) -> None:
        """Schedule the samples of the next triggers, each at the middle of its integration after the delay."""
        start_s, delay_s = self._clock.now_s(), self.delay_s
        step_s = delay_s + self._converter.sample_s(self._configuration)
        middle_s = delay_s + self._converter.integration_s(self._configuration) / 2.0
        samples = triggers * self.sample_count
        self._due = [start_s + i * step_s + middle_s for i in range(samples)]
        self._measures_until(start_s + samples * step_s)

    def _sampled(self, due: float) -> str:
        value = self._converter.sample(self._configuration, due)
        if abs(value) >= facts.OVERLOAD_V:
            self._on_overload()
        return reading_text(value, self._converter.step(self._configuration))

    def commands(self) -> list[Command]:
        """Return the commands and queries for triggering and memory."""
        word = (Number(optional=True),)
        return [
            Command("INITiate[:IMMediate]", self.initiate),
            Command("READ?", self.read),
            Command("FETCh?", self.fetch),
            Command(
                "TRIGger[:SEQuence]:SOURce", self._set_source, (Choice(("BUS", "IMMediate", "EXTernal")),)
            ),
            Command("TRIGger[:SEQuence]:SOURce?", lambda: self.source),
            *number_lines(
                "TRIGger[:SEQuence]:DELay",
                "S",
                (0.0, _LONGEST_DELAY_S),
                lambda: self.delay_s,
                self._set_delay,
            ),
            Command("TRIGger[:SEQuence]:DELay:AUTO", self._set_delay_auto, (Boolean(),)),
            Command("TRIGger[:SEQuence]:DELay:AUTO?", lambda: str(int(self.stated_delay_s is None))),
            Command("TRIGger[:SEQuence]:COUNt", self._set_trigger_count, (Number(words=(MIN, MAX, INF)),)),
            Command("TRIGger[:SEQuence]:COUNt?", lambda w="": self._count_text(w, self.trigger_count), word),
            Command("SAMPle:COUNt", self._set_sample_count, (Number(),)),
            Command("SAMPle:COUNt?", lambda w="": self._count_text(w, self.sample_count), word),
            Command("DATA:POINts?", lambda: integer(len(self._memory))),
        ]

    def _set_source(self, source: str) -> None:
        self.source = source
        self.stop_waiting()

    def _set_delay(self, value: float) -> None:
        self.stated_delay_s = within(value, 0.0, _LONGEST_DELAY_S)
        self.stop_waiting()

    def _set_delay_auto(self, flag: str) -> None:
        self.stated_delay_s = None if flag == "1" else self.delay_s
        self.stop_waiting()

    def _set_trigger_count(self, value: Value) -> None:
        self.trigger_count = math.inf if value == INF else self._count(value)
        self.stop_waiting()

    def _set_sample_count(self, value: Value) -> None:
        self.sample_count = self._count(value)
        self.stop_waiting()

    def _count(self, value: Value) -> int:
        """Return a count, rounded, with MIN and MAX resolved. Raises `ScpiError` -222 outside 1…`most_readings`."""
        count = math.floor(number_of(value, 1, self.most_readings) + 0.5)
        return math.floor(within(count, 1, self.most_readings))

    def _count_text(self, word: str, value: float) -> str:
        if word:
            return integer(1 if word == MIN else self.most_readings)
        return _INFINITE if math.isinf(value) else integer(value)


# --- the meter --------------------------------------------------------------------------------------

_ERRORS: Final = {531: "Insufficient memory"}
_DISPLAY_WIDTH: Final = 12


_REAL_PORT: Final = LineEnds(buffer=110, loses_early=True)
_IDLE_S: Final = 600.0
_REMOTE: Final = re.compile(rb"\s*:?SYST(EM)?:REM(OTE)?\s*\Z", re.IGNORECASE)


def _parameters(unit: str) -> tuple[CommandParameter, ...]:
    """Return the parameters of CONFigure and MEASure: range and resolution."""
    return (Number(unit, (MIN, MAX, DEF), optional=True),) * 2


_COMMA_AFTER_LAST: Final = ("3-1-1", "7-5-2")
"""Firmware that prints a comma after the last of several readings, as the User's Guide shows them."""


class Agilent34401A(LineMeter):
    """A 34401A with its settings and trigger system.

    It measures `source` at the time of `clock`. `RemoteInstrument` explains `interface`; `Converter` explains
    `noise`, `accuracy` and `flaws`. `firmware` replaces the last field of the identity; "3-1-1" and "7-5-2" print a
    comma after the last reading. `errors_at_start` are in the error queue after switch-on, as if an adapter had
    sent its own *IDN? (xyphro/UsbGpib issue 41).
    With `real_port`, RS-232 behaves as on pages 151-152 of the User's Guide: the buffer has some 100 characters,
    and characters sent between a query and its reply are lost, even Ctrl-C. After ten idle minutes the meter then
    ignores everything but SYSTem:REMote.
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
        flaws: Mapping[str, float] | None = None,
        firmware: str = "",
        errors_at_start: Sequence[int] = (),
        real_port: bool = False,
    ) -> None:
        super().__init__(facts.IDENTITY, _ERRORS, interface)
        if firmware:
            self.identity = f"{self.identity.rpartition(',')[0]},{firmware}"
        self._errors_at_start, self._real_port = errors_at_start, real_port and interface == "rs232"
        self._clock, self._heard_s = clock, clock.now_s()
        self.beeper_enabled = True
        self.configuration = Configuration(self._configuration_changed)
        self._converter = Converter(
            source, facts, noise=noise, accuracy=accuracy, line_hz=line_hz, flaws=flaws
        )
        self.trigger = self._trigger_type(
            clock, self.configuration, self._converter, self._overload, self.device_clear_pending
        )
        self.trigger.after_last = "," if firmware in _COMMA_AFTER_LAST else ""
        self._clear_text()
        self.display_on = True
        self.add(self.configuration.commands())
        self.add(self.trigger.commands())
        self.add(self._measure_commands())
        self.add(self._system_commands())
        for number in errors_at_start:
            self.report(number)

    @property
    def line_ends(self) -> LineEnds:
        """The line ends; a real RS-232 port also has a small buffer, and loses input while a reply is due."""
        return _REAL_PORT if self._real_port else LineEnds()

    def handle(self, message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        """Carry out one message; after ten idle minutes a real RS-232 port ignores all but SYSTem:REMote."""
        if self._real_port and self._clock.now_s() - self._heard_s > _IDLE_S and not _REMOTE.match(message):
            return None
        reply = super().handle(message, interrupted)
        self._heard_s = self._clock.now_s()
        return reply

    def power_cycle(self) -> None:
        """Switch off and on; errors that an adapter causes at switch-on enter the queue again."""
        super().power_cycle()
        for number in self._errors_at_start:
            self.report(number)

    @property
    def cycle(self) -> Trigger:
        """The trigger system."""
        return self.trigger

    @property
    def converters(self) -> tuple[Converter]:
        """The single converter."""
        return (self._converter,)

    def reset(self) -> None:
        """*RST: DC volts, autorange, 10 PLC, one immediate trigger; keep errors and masks."""
        self.trigger.abort()
        self.configuration.preset()
        self.trigger.preset()
        self.display_on = True
        self._clear_text()

    def _configuration_changed(self) -> None:
        self.trigger.stop_waiting()

    def _overload(self) -> None:
        """Report an overload in the event register; it does not enter the error queue."""
        self.events.bits |= DEVICE_ERROR

    def _measure_commands(self) -> list[Command]:
        lines = [
            Command("CONFigure:VOLTage[:DC]", partial(self._configure, FUNCTIONS["VOLT"]), _parameters("V"))
        ]
        for name in ("VOLT", "VOLT:AC", "CURR", "CURR:AC", "RES", "FRES"):
            function = FUNCTIONS[name]
            measure = partial(self._measure, function)
            lines.append(Command(f"MEASure:{function.notation}?", measure, _parameters(function.unit)))
        return lines

    def _configure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> None:
        self.configuration.configure(function, range_value, resolution)
        self.trigger.abort()
        self.trigger.preset()

    def _measure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> str | None:
        self._configure(function, range_value, resolution)
        return self.trigger.read()

    def _system_commands(self) -> list[Command]:
        return [
            Command("ROUTe:TERMinals?", lambda: "FRON"),
            *switch_lines("DISPlay[:WINDow][:STATe]", lambda: self, "display_on"),
            Command("DISPlay[:WINDow]:TEXT[:DATA]", self._show, (Text(),)),
            Command("DISPlay[:WINDow]:TEXT[:DATA]?", lambda: quoted(self._display_text)),
            Command("DISPlay[:WINDow]:TEXT:CLEar", self._clear_text),
            Command("SYSTem:BEEPer", lambda: None),
            *switch_lines("SYSTem:BEEPer:STATe", lambda: self, "beeper_enabled"),
        ]

    def _show(self, text: str) -> None:
        self._display_text = text[:_DISPLAY_WIDTH]

    def _clear_text(self) -> None:
        self._display_text = ""
