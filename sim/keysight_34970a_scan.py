"""Channels and scans of the simulated 34970A."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from drivers.facts import keysight_34970a as facts
from drivers.facts.agilent_34401a import OVERLOAD_V
from drivers.facts.keysight_34970a import MEMORY_READINGS, PAIRED
from sim.scpi import Command
from sim.scpi_values import DEF, INF, MAX, MIN, Boolean, Choice, Number, ScpiError, Value, list_spans, within
from sim.voltmeters import (
    Function,
    FunctionSettings,
    MeasuringCycle,
    chosen_range,
    chosen_resolution,
    reading_text,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from drivers.clock import Clock
    from sim.voltmeters import Converter, MeteredSignal

# --- channels ---------------------------------------------------------------------------------------

TEMPERATURE: Final = Function("TEMP", "TEMPerature", "C", (1.0,), facts.NPLC_BY_RESOLUTION)
KINDS: Final = ("TCouple", "RTD", "FRTD", "THERmistor")
_TYPES: Final = {"RTD": (85, 91), "FRTD": (85, 91), "THER": (2252, 5000, 10000)}
_ILLEGAL: Final = -224
_NOT_HERE: Final = 305


@dataclass(frozen=True, slots=True)
class Transducer:
    """A channel's temperature sensor: the `kind` as in replies ("FRTD"), and the number of its `type` (85)."""

    kind: str = "TC"
    type: int = 85

    @property
    def configured(self) -> str:
        """The parameters of CONFigure:TEMPerature: "FRTD,85"."""
        return f"{self.kind},{self.type}"

    @classmethod
    def of(cls, kind: str, written: Value, channel: int) -> Transducer:
        """Return the sensor named in a command.

        Raises `ScpiError` -224 for an unknown kind or type, 305 for four wires on a channel of the second bank.
        """
        known = _TYPES.get(kind)
        if known is None:
            raise ScpiError(_ILLEGAL)
        if kind == "FRTD" and channel % 100 not in PAIRED:
            raise ScpiError(_NOT_HERE)
        number = known[-2] if written == DEF else int(float(written))
        if number not in known:
            raise ScpiError(_ILLEGAL)
        return cls(kind, number)


DC_VOLTS: Final = Function("VOLT", "VOLTage[:DC]", "V", facts.RANGES_V, facts.NPLC_BY_RESOLUTION)
CARDS: Final = {facts.CARD: (*facts.CARD_CHANNELS, *facts.CURRENT_CHANNELS)}

WRONG_LIST: Final = 309
NO_MODULE: Final = 302
NO_CHANNEL: Final = 304

_DEFAULT_RESOLUTION: Final = 3e-6
_AUTOMATIC_DELAY_S: Final = 2e-3
_ITEM: Final = re.compile(r"(\d{3})(?::(\d{3}))?")


class ChannelList:
    """A channel list as a parameter, `(@101:103,105)`; with `or_number`, a number or word is accepted, too.

    The value of a list is its text, which `listed` converts to channels.
    """

    def __init__(self, or_number: Number | None = None, optional: bool = False) -> None:
        self.optional = optional
        self._number = or_number

    def parse(self, text: str) -> Value:
        """Return the text of a list, or the value of the number. Raises `ScpiError` 309 if a list is required."""
        if text.startswith("("):
            return text
        if self._number is None:
            raise ScpiError(WRONG_LIST)
        return self._number.parse(text)


def listed(text: str, cards: Mapping[int, str]) -> tuple[int, ...]:
    """Return the channels in the order of the list, `(101, 102, 103, 105)`.

    `cards` maps each slot (100, 200, 300) to its card. Raises `ScpiError` 309 for a malformed list, 302 for a slot
    without a card, 304 for a channel that the card lacks. Missing channels inside a range are skipped.
    """
    channels: list[int] = []
    for first, last in list_spans(text, _ITEM, WRONG_LIST):
        for end in (first, last):
            if 100 * (end // 100) not in cards:
                raise ScpiError(NO_MODULE)
            if not _exists(end, cards):
                raise ScpiError(NO_CHANNEL)
        channels += [channel for channel in range(first, last + 1) if _exists(channel, cards)]
    return tuple(channels)


def _exists(channel: int, cards: Mapping[int, str]) -> bool:
    card = cards.get(100 * (channel // 100))
    return card is not None and channel % 100 in CARDS[card]


class ChannelConfiguration:
    """The settings of one channel, as a `Measurement`; a channel with a `transducer` measures temperature."""

    bandwidth_hz = 20.0

    def __init__(self) -> None:
        self.preset()

    def preset(self) -> None:
        """Set the defaults of *RST and CONFigure: autorange, 1 PLC, autozero, 10 MOhm, automatic delay."""
        self.settings = FunctionSettings(10.0, _DEFAULT_RESOLUTION)
        self.autozero = True
        self.high_impedance = False
        self.stated_delay_s: float | None = None
        self.transducer: Transducer | None = None

    @property
    def function(self) -> Function:
        """The measuring function."""
        return DC_VOLTS if self.transducer is None else TEMPERATURE

    @property
    def nplc(self) -> float:
        """The integration time in power-line cycles."""
        return facts.NPLC_BY_RESOLUTION[self.settings.resolution]

    @property
    def delay_s(self) -> float:
        """The delay from the closing of the relay to the beginning of the sample, s."""
        return _AUTOMATIC_DELAY_S if self.stated_delay_s is None else self.stated_delay_s

    def configure(self, range_value: Value, resolution: Value) -> None:
        """CONFigure:VOLTage:DC: preset the channel, set range and resolution.

        Raises `ScpiError` -222 for an invalid value or 532 for too fine a resolution, and then changes nothing.
        """
        chosen = self.settings.range_value if range_value == DEF else chosen_range(DC_VOLTS, range_value)
        fraction = (
            _DEFAULT_RESOLUTION if resolution == DEF else chosen_resolution(DC_VOLTS, resolution, chosen)
        )
        self.preset()
        self.settings.range_value = chosen
        self.settings.autorange = range_value == DEF
        self.settings.resolution = fraction

    def measure_temperature(self, transducer: Transducer) -> None:
        """CONFigure:TEMPerature: preset the channel and set its sensor."""
        self.preset()
        self.transducer = transducer

    def set_delay(self, delay_s: float) -> None:
        """Set the channel delay, s, rounded to 1 ms. Raises `ScpiError` -222 outside its limits."""
        self.stated_delay_s = round(within(delay_s, 0.0, facts.LONGEST_CHANNEL_DELAY_S), 3)


@runtime_checkable
class HasSensor(Protocol):
    """A signal source that is a temperature sensor, not a voltage."""

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return the temperature shown by a meter configured for the sensor `configured`, °C."""


class CardInput:
    """One channel of the card, as a `MeteredSignal`: the signal wired to it, measured by the shared converter.

    `common` represents the meter itself, whose gain error and offset are the same for all channels. Without a
    signal (`wired` None) the open input reads zero.
    """

    def __init__(self, wired: MeteredSignal | None, common: MeteredSignal) -> None:
        self._wired = wired
        self._common = common

    @property
    def place(self) -> int:
        """The index of the meter on the bench."""
        return self._common.place

    @property
    def temperature_c(self) -> float:
        """The temperature at the meter, °C."""
        return self._common.temperature_c

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the channel at `time_s` of the clock (default: now), V; 0 if nothing is wired."""
        return 0.0 if self._wired is None else self._wired.signal_v(time_s)

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return the temperature that the meter displays, °C; an overload if no sensor is wired.

        `configured` is the type of sensor for which the channel is configured, such as "FRTD,85"; the sensor
        that is wired may be of another type. `time_s` is the time of the clock.
        """
        return self._wired.shown_c(configured, time_s) if isinstance(self._wired, HasSensor) else OVERLOAD_V

    def new_reading(self) -> None:
        """Begin a new reading; called when the channel is triggered."""
        if self._wired is not None:
            self._wired.new_reading()

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for one purpose within the present reading of this channel."""
        return (self._wired or self._common).random(purpose)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for a permanent property of the meter."""
        return self._common.fixed_random(purpose)


# --- scans ------------------------------------------------------------------------------------------
# A trigger starts one sweep of the scan list: relay, channel delay, sample, then the next channel.
# Source: 34970A User's Guide (34970-90003), chapter 4 "Scanning", chapter 5 "Scanning Commands",
# "Reading Format Commands", "Scan Memory Commands".

_MOST_SWEEPS: Final = 50_000
_RELAY_S: Final = 4e-3
_CANNOT: Final = 305
_INFINITE: Final = "+9.90000200E+37"
_EXTRAS: Final = ("UNIT", "TIME", "CHANnel", "ALARm")


class Scan(MeasuringCycle):
    """The scan list, the trigger settings, the scan in progress, and the memory of the latest readings.

    `channels` maps each channel to its settings and converter, `inputs` maps it to its signal. A scan with
    more readings than the memory holds raises `ScpiError` 305 at its start. So does a scan without end
    (TRIGger:COUNt INFinity), which this simulation does not support.
    """

    memory_depth = MEMORY_READINGS

    def __init__(
        self,
        clock: Clock,
        channels: Mapping[int, tuple[ChannelConfiguration, Converter]],
        inputs: Mapping[int, CardInput],
        interrupted: Callable[[], bool],
    ) -> None:
        self._channels = channels
        self._inputs = inputs
        self.channel_list: tuple[int, ...] = ()
        self._began_s = 0.0
        super().__init__(clock, interrupted)

    def preset(self) -> None:
        """Set the defaults of *RST and CONFigure: one immediate scan, readings without any extra field."""
        self.source = "IMM"
        self.count: float = 1
        self.extras = dict.fromkeys((word.upper()[:4] for word in _EXTRAS), False)

    def define(self, channels: tuple[int, ...]) -> None:
        """Set the scan list, sorted in ascending order and without duplicates."""
        self.channel_list = tuple(sorted(set(channels)))

    # --- measuring ----------------------------------------------------------------------------------

    def initiate(self) -> None:
        """INITiate: scan into memory.

        Raises `ScpiError` -213 if a scan is in progress or waits for a trigger, 305 for an empty scan list, and for
        a scan without end or beyond the memory.
        """
        self._require_idle()
        if not self.channel_list or self.count * len(self.channel_list) > self.memory_depth:
            raise ScpiError(_CANNOT)
        self._began_s = self._clock.now_s()
        for channel in self.channel_list:
            self._channels[channel][1].begin()
        self._start(self.count, keeps=True)

    def _schedule(self, triggers: int) -> None:
        """Schedule the samples of the next sweeps, each at the middle of its integration."""
        now_s = self._clock.now_s()
        for _ in range(triggers):
            for channel in self.channel_list:
                configuration, converter = self._channels[channel]
                now_s += _RELAY_S + configuration.delay_s
                self._due.append((channel, now_s + converter.integration_s(configuration) / 2.0))
                now_s += converter.sample_s(configuration)
        self._measures_until(now_s)

    def _sampled(self, due: tuple[int, float]) -> str:
        channel, time_s = due
        configuration, converter = self._channels[channel]
        transducer = configuration.transducer
        if transducer is None:
            value = converter.sample(configuration, time_s)
        else:
            value = self._inputs[channel].shown_c(transducer.configured, time_s)
        return self._text(channel, time_s, value, converter.step(configuration))

    def _text(self, channel: int, time_s: float, value: float, step: float) -> str:
        text = reading_text(value, step) + (" VDC" if self.extras["UNIT"] else "")
        if self.extras["TIME"]:
            text += f",{time_s - self._began_s:013.3f}"
        if self.extras["CHAN"]:
            text += f",{channel}"
        return text + (",0" if self.extras["ALAR"] else "")

    # --- commands -----------------------------------------------------------------------------------

    def commands(self) -> list[Command]:
        """Return the commands and queries for triggering, memory and reading format."""
        count = (Number(words=(MIN, MAX, INF)),)
        source = (Choice(("BUS", "IMMediate", "EXTernal")),)
        lines = [
            Command("INITiate", self.initiate),
            Command("FETCh?", self.fetch),
            Command("TRIGger:SOURce", self._set_source, source),
            Command("TRIGger:SOURce?", lambda: self.source),
            Command("TRIGger:COUNt", self._set_count, count),
            Command("TRIGger:COUNt?", lambda: _INFINITE if math.isinf(self.count) else f"{self.count:+.8E}"),
        ]
        for word in _EXTRAS:
            lines += self._extra_lines(word)
        return lines

    def _extra_lines(self, word: str) -> list[Command]:
        key = word.upper()[:4]

        def switch(flag: str) -> None:
            self.extras[key] = flag == "1"

        return [
            Command(f"FORMat:READing:{word}", switch, (Boolean(),)),
            Command(f"FORMat:READing:{word}?", lambda: str(int(self.extras[key]))),
        ]

    def _set_source(self, source: str) -> None:
        self.source = source

    def _set_count(self, value: Value) -> None:
        words = {MIN: 1.0, MAX: float(_MOST_SWEEPS), INF: math.inf}
        self.count = words[value] if isinstance(value, str) else within(round(value), 1, _MOST_SWEEPS)
