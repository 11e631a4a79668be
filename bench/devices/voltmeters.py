"""The voltmeters of a bench file: what each may be told, and what its kind can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from bench.base.forms import FileModel
from bench.base.units import DurationS, VoltageV
from bench.devices.wires import (
    BAUD_RATES,
    BusPlace,
    WiredForm,
    bus_place,
    driver_of,
    meter_resource,
    usual_baud_rate,
)
from drivers.agilent_34401a.driver import DIALECT_34401A
from drivers.interfaces import Channel
from drivers.keysight_34461a.driver import DIALECTS
from drivers.keysight_34970a import driver as keysight_34970a
from drivers.scpi_voltmeter import Limits


@dataclass(frozen=True)
class VoltmeterKind:
    """What voltmeters of a driver can do: the driver's limits for one channel, and what no driver need know.

    `baud_rates` are those of its serial port, none where it has no such port. `accuracy` gives for each range
    the limits of error of DC volts within 90 days at 23 ± 5 °C, parts of the reading and of the range;
    `linearity` the limits of its converter's integral nonlinearity alike.
    """

    limits: Limits
    baud_rates: tuple[int, ...] = ()
    accuracy: Mapping[float, tuple[float, float]] = field(default_factory=lambda: _ACCURACY_90_DAYS)
    linearity: tuple[float, float] = (2e-6, 1e-6)


_ACCURACY_90_DAYS: Final[Mapping[float, tuple[float, float]]] = {
    0.1: (40e-6, 35e-6), 1.0: (30e-6, 7e-6), 10.0: (20e-6, 5e-6), 100.0: (35e-6, 6e-6),
    300.0: (35e-6, 20e-6), 1000.0: (35e-6, 10e-6),
}  # fmt: skip
"""The same for the three kinds: 34401A User's Guide, chapter 8; 34461A and 34970A data sheets."""

VOLTMETERS: Final = {
    "agilent-34401a": VoltmeterKind(DIALECT_34401A.limits, BAUD_RATES[:6]),
    "keysight-34461a": VoltmeterKind(DIALECTS["34461A"].limits),
    "keysight-34970a": VoltmeterKind(keysight_34970a.LIMITS, BAUD_RATES[2:]),
}
"""By the name of the driver. Sources: the user's guides that the drivers name."""

_CARD_CHANNELS: Final = tuple(range(1, 21))
"""Of a 34901A; 21 and 22 measure current."""
_SLOTS: Final = (1, 2, 3)
_LONGEST_CHANNEL_DELAY_S: Final = 60.0


class SerialSection(FileModel):
    """How a meter's serial port is set on its front panel; with a parity it has 7 data bits, without one 8."""

    baud_rate: int = 9600
    parity: Literal["none", "even", "odd"] = "none"

    @property
    def data_bits(self) -> Literal[7, 8]:
        """Data bits of a character."""
        return 8 if self.parity == "none" else 7


class VoltmeterForm(WiredForm):
    """What every voltmeter is told. The range is fixed: a meter that changes it also changes its errors."""

    driver: str
    stated_name: str | None = Field(None, alias="name")
    resource: Annotated[str, AfterValidator(meter_resource)]
    timeout: DurationS = 5.0
    range: VoltageV = 10.0

    @property
    def place(self) -> BusPlace | None:
        """Where it is behind a GPIB adapter, None without one."""
        return bus_place(self.resource)

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        driver = info.data.get("driver")
        if driver is not None and range_v not in VOLTMETERS[driver].limits.ranges_v:
            listed = ", ".join(f"{r:g} V" for r in VOLTMETERS[driver].limits.ranges_v)
            raise ValueError(f"the {driver} has the ranges {listed}, not {range_v:g} V")
        return range_v


class OneChannelForm(VoltmeterForm):
    """A voltmeter with one signal."""

    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=1)]

    @property
    def name(self) -> str:
        """Name of the instrument: as stated, else "voltmeter.x"."""
        return _named(self.stated_name, self.channels)


class SerialPortForm(VoltmeterForm):
    """A voltmeter that may have a serial port.

    `interface` says how the meter is set, apart from the wire that carries its messages.
    """

    interface: Literal["lan", "gpib", "rs232"] = "lan"
    serial: SerialSection = SerialSection()

    @field_validator("serial")
    @classmethod
    def _speed_of_the_meter(cls, serial: SerialSection, info: ValidationInfo) -> SerialSection:
        driver = info.data.get("driver")
        if driver is not None:
            usual_baud_rate(serial.baud_rate, VOLTMETERS[driver].baud_rates)
        return serial


class Agilent34401ASection(OneChannelForm, SerialPortForm):
    """A 34401A."""

    driver: Literal["agilent-34401a"]


class Keysight34461ASection(OneChannelForm):
    """A 34460A, 34461A, 34465A or 34470A; `interface` "lan" stands for USB, too."""

    driver: Literal["keysight-34461a"]
    interface: Literal["lan", "gpib"] = "lan"


def _on_a_card(number: int) -> int:
    if number // 100 not in _SLOTS or number % 100 not in _CARD_CHANNELS:
        raise ValueError(f"a 34901A has the channels 101 to 120, 201 to 220, 301 to 320, not {number}")
    return number


class Keysight34970ASection(SerialPortForm):
    """A 34970A or 34972A with 34901A cards: which signal is on which channel of the multiplexer."""

    driver: Literal["keysight-34970a"]
    inputs: Annotated[dict[Channel, Annotated[int, AfterValidator(_on_a_card)]], Field(min_length=1)]
    channel_delay: DurationS = 0.1

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The signals in the order of the scan, which is that of the channel numbers."""
        return tuple(sorted(self.inputs, key=lambda signal: self.inputs[signal]))

    @property
    def name(self) -> str:
        """Name of the instrument: as stated, else "voltmeter.xyz"."""
        return _named(self.stated_name, self.channels)

    @field_validator("inputs")
    @classmethod
    def _one_signal_each(cls, inputs: dict[Channel, int]) -> dict[Channel, int]:
        if len(set(inputs.values())) < len(inputs):
            raise ValueError("two signals are on one channel of the multiplexer")
        return inputs

    @field_validator("channel_delay")
    @classmethod
    def _of_the_multiplexer(cls, delay_s: float) -> float:
        milliseconds = 1000.0 * delay_s
        whole = abs(milliseconds - round(milliseconds)) < 1e-3
        if not (0.0 <= delay_s <= _LONGEST_CHANNEL_DELAY_S and whole):
            raise ValueError(f"a channel delay is 0 to 60 s in steps of 1 ms, not {delay_s:g} s")
        return delay_s


VoltmeterSection = Annotated[
    Annotated[
        Agilent34401ASection | Keysight34461ASection | Keysight34970ASection, Field(discriminator="driver")
    ],
    driver_of(Agilent34401ASection, Keysight34461ASection, Keysight34970ASection),
]


def _named(stated: str | None, channels: tuple[Channel, ...]) -> str:
    return stated or f"voltmeter.{''.join(channels)}"


def written_channels(voltmeter: Any) -> tuple[str, list[Any]] | None:
    """Return the key under which a voltmeter as written says its signals, and these; None where it does not."""
    if not isinstance(voltmeter, dict):
        return None
    for key in ("channels", "inputs"):
        signals = voltmeter.get(key)
        if isinstance(signals, list | dict):
            return key, list(signals)
    return None
