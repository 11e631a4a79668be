"""Channels of a simulated 34970A: lists, settings, sensors, what is wired to each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from drivers.agilent_34401a.facts import OVERLOAD_V
from drivers.keysight_34970a import facts
from drivers.keysight_34970a.sensors import PAIRED
from sim.agilent_34401a.functions import Function, FunctionSettings, chosen_range, chosen_resolution
from sim.scpi.status import ScpiError
from sim.scpi.values import DEF, Number, Value, within

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from sim.agilent_34401a.converter import MeteredSignal


TEMPERATURE: Final = Function("TEMP", "TEMPerature", "C", (1.0,), facts.NPLC_BY_RESOLUTION, "TEMPerature")
KINDS: Final = ("TCouple", "RTD", "FRTD", "THERmistor")
_TYPES: Final = {"RTD": (85, 91), "FRTD": (85, 91), "THER": (2252, 5000, 10000)}
_ILLEGAL: Final = -224
_NOT_HERE: Final = 305


@dataclass(frozen=True, slots=True)
class Transducer:
    """The probe that a channel is set to: its kind as in replies, and its type."""

    kind: str = "TC"
    type: int = 85

    @property
    def configured(self) -> str:
        """As CONFigure:TEMPerature names it: "FRTD,85"."""
        return f"{self.kind},{self.type}"

    @classmethod
    def of(cls, kind: str, written: Value, channel: int) -> Transducer:
        """Return the probe of a command. Raises `ScpiError` -224, 305 for four wires on the second bank."""
        known = _TYPES.get(kind)
        if known is None:
            raise ScpiError(_ILLEGAL)
        if kind == "FRTD" and channel % 100 not in PAIRED:
            raise ScpiError(_NOT_HERE)
        number = known[-2] if written == DEF else int(float(written))
        if number not in known:
            raise ScpiError(_ILLEGAL)
        return cls(kind, number)


DC_VOLTS: Final = Function(
    "VOLT", "VOLTage[:DC]", "V", facts.RANGES_V, facts.NPLC_BY_RESOLUTION, "VOLTage[:DC]"
)
CARDS: Final = {facts.CARD: (*facts.CARD_CHANNELS, *facts.CURRENT_CHANNELS)}

WRONG_LIST: Final = 309
NO_MODULE: Final = 302
NO_CHANNEL: Final = 304

_DEFAULT_RESOLUTION: Final = 3e-6
_AUTOMATIC_DELAY_S: Final = 2e-3
_LIST: Final = re.compile(r"\(\s*@\s*([0-9:,\s]*)\)")
_ITEM: Final = re.compile(r"(\d{3})(?::(\d{3}))?")


class ChannelList:
    """A channel list as a parameter, `(@101:103,105)`; alone, or where a number or word may stand first.

    The value of a list is its text; `listed` makes the channels of it.
    """

    def __init__(self, or_number: Number | None = None, optional: bool = False) -> None:
        self.optional = optional
        self._number = or_number

    def parse(self, text: str) -> Value:
        """Return the text of a list, or the value of the number."""
        if text.startswith("("):
            return text
        if self._number is None:
            raise ScpiError(WRONG_LIST)
        return self._number.parse(text)


def listed(text: str, cards: Mapping[int, str]) -> tuple[int, ...]:
    """Return the channels of a list as they are written, `(101, 102, 103, 105)`.

    `cards` holds the card in each slot (100, 200, 300). Raises `ScpiError` 309 for another form, 302 where
    there is no card, 304 where the card has no such channel; within a range those are passed over.
    """
    match = _LIST.fullmatch(text)
    if match is None:
        raise ScpiError(WRONG_LIST)
    channels: list[int] = []
    inner = match.group(1).replace(" ", "")
    for item in inner.split(",") if inner else []:
        ends = _ITEM.fullmatch(item)
        if ends is None:
            raise ScpiError(WRONG_LIST)
        first, last = int(ends.group(1)), int(ends.group(2) or ends.group(1))
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
    """How one channel is measured; a `Measurement`. With a `transducer` it is a temperature."""

    bandwidth_hz = 20.0

    def __init__(self) -> None:
        self.preset()

    def preset(self) -> None:
        """Set what *RST and CONFigure set: autorange, 1 PLC, autozero, 10 MOhm, automatic delay."""
        self.settings = FunctionSettings(10.0, _DEFAULT_RESOLUTION, 0.0)
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
        """Integration in power-line cycles."""
        return facts.NPLC_BY_RESOLUTION[self.settings.resolution]

    @property
    def delay_s(self) -> float:
        """From the closing of the relay to the beginning of the sample, s."""
        return _AUTOMATIC_DELAY_S if self.stated_delay_s is None else self.stated_delay_s

    def configure(self, range_value: Value, resolution: Value) -> None:
        """CONFigure:VOLTage:DC. Raises `ScpiError` -222, 532; nothing is changed then."""
        chosen = self.settings.range_value if range_value == DEF else chosen_range(DC_VOLTS, range_value)
        fraction = (
            _DEFAULT_RESOLUTION if resolution == DEF else chosen_resolution(DC_VOLTS, resolution, chosen)
        )
        self.preset()
        self.settings.range_value = chosen
        self.settings.autorange = range_value == DEF
        self.settings.resolution = fraction

    def measure_temperature(self, transducer: Transducer) -> None:
        """CONFigure:TEMPerature."""
        self.preset()
        self.transducer = transducer

    def set_delay(self, delay_s: float) -> None:
        """Set the channel delay, s, in steps of 1 ms. Raises `ScpiError` -222."""
        self.stated_delay_s = round(within(delay_s, 0.0, facts.LONGEST_CHANNEL_DELAY_S), 3)


@runtime_checkable
class HasSensor(Protocol):
    """What is at a channel where a temperature can be measured."""

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return what it shows as the sensor that is configured, °C."""
        ...


class CardInput:
    """One channel of the card, a `MeteredSignal`: what is wired to it, seen through the converter all share.

    `common` stands for the meter itself, whose gain and offset are the same for all channels. With nothing
    wired (`wired` None) the open input reads zero.
    """

    def __init__(self, wired: MeteredSignal | None, common: MeteredSignal) -> None:
        self._wired = wired
        self._common = common

    @property
    def place(self) -> int:
        """Which of the bench's meters stands here."""
        return self._common.place

    @property
    def temperature_c(self) -> float:
        """The temperature at the meter, °C."""
        return self._common.temperature_c

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the channel, V."""
        return 0.0 if self._wired is None else self._wired.signal_v(time_s)

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return what a sensor at the channel shows as the one that is configured, °C; beyond all for no sensor."""
        return self._wired.shown_c(configured, time_s) if isinstance(self._wired, HasSensor) else OVERLOAD_V

    def new_reading(self) -> None:
        """Say that a reading was triggered."""
        if self._wired is not None:
            self._wired.new_reading()

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator for a purpose within the present reading of this channel."""
        return (self._wired or self._common).random(purpose)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the generator for something that the meter has for good."""
        return self._common.fixed_random(purpose)
