"""Voltmeters of Agilent and Keysight (34401A, Truevolt, 34970A) and Keithley (2000); thermometers with a wire."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from bench.base.arrays import CHANNELS
from bench.base.units import DurationS
from bench.config.devices.device import (
    Device,
    LineForm,
    Port,
    PortSection,
    Printable,
    Timeout,
    WiredForm,
    any_resource,
    is_serial,
)
from bench.config.devices.sections import (
    OneChannelForm,
    SerialPortForm,
    SizeK,
    TemperatureRange,
    ThermometerForm,
    ThermometerTruth,
    VoltmeterTruth,
)
from drivers.facts import agilent_34401a as agilent
from drivers.facts import keithley_2000 as keithley
from drivers.facts import keysight_34461a as truevolt
from drivers.facts import keysight_34970a as multiplexer
from drivers.facts import text_line
from drivers.facts.keysight_34970a import PAIRED, SENSORS
from drivers.interfaces import Channel


class Agilent34401ASection(OneChannelForm, SerialPortForm):
    """An Agilent 34401A."""

    facts: ClassVar = agilent

    driver: Literal["agilent-34401a"]

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return the options common to all simulated voltmeters, the flaws of input and port, and the firmware."""
        options = super().simulation_options(truth) | {
            "errors_at_start": truth.errors_at_start,
            "real_port": truth.real_port,
        }
        if truth.firmware:
            options["firmware"] = truth.firmware[CHANNELS.index(self.channels[0]) % len(truth.firmware)]
        return options | _flaws(truth)


def _flaws(truth: VoltmeterTruth) -> dict[str, Any]:
    """Return the option `flaws` of a simulated input, or none for an ideal one."""
    flaws = truth.flaws()
    return {"flaws": flaws} if any(flaws.values()) else {}


_OF_THE_INPUT: Final = (
    "noise",
    "accuracy",
    "source_ohm",
    "mains",
    "zero_drift",
    "flicker",
    "reference_flicker",
)


class Keysight34461ASection(OneChannelForm):
    """A Keysight 34460A, 34461A, 34465A or 34470A; `interface` "lan" also covers USB."""

    facts: ClassVar = truevolt

    driver: Literal["keysight-34461a"]
    interface: Literal["lan", "gpib"] = "lan"

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return the options common to all simulated voltmeters, and the flaws of its input."""
        return super().simulation_options(truth) | _flaws(truth)


class Keithley2000Port(PortSection):
    """The RS-232 settings at the front panel of a Keithley 2000; `terminator` is the setting TX TERM."""

    baud_rate: int = PortSection.of(keithley).baud_rate
    terminator: Literal["lf", "cr", "crlf", "lfcr"] = "lf"


class Keithley2000Section(OneChannelForm):
    """A Keithley 2000, over GPIB or RS-232."""

    facts: ClassVar = keithley
    for_simulation: ClassVar = ("line_end",)

    driver: Literal["keithley-2000"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: Keithley2000Port = Keithley2000Port()

    @model_validator(mode="after")
    def _set_to_its_port(self) -> Keithley2000Section:
        if is_serial(self.resource) and self.interface != "rs232":
            raise ValueError("a serial port is RS-232: state 'interface: rs232', and set the meter to it")
        return self

    @property
    def line_end(self) -> str:
        """The line termination."""
        serial = self.interface == "rs232"
        return keithley.TERMINATORS[self.serial.terminator] if serial else keithley.READ_TERMINATION

    def port(self) -> Port:
        """Return the setup of the wire; on RS-232 with the line termination of the section."""
        return Port(self.line_end, self.line_end, super().port().serial)


def _on_a_card(number: int) -> int:
    if number // 100 not in multiplexer.SLOTS or number % 100 not in multiplexer.CARD_CHANNELS:
        raise ValueError(
            f"a {multiplexer.CARD} has no channel {number}; choose from {multiplexer.CHANNELS_TEXT}"
        )
    return number


class Keysight34970ASection(SerialPortForm):
    """A 34970A or 34972A with 34901A cards; `inputs` gives the multiplexer channel of each signal."""

    facts: ClassVar = multiplexer
    for_driver: ClassVar = (("channel_delay_s", "channel_delay"),)

    driver: Literal["keysight-34970a"]
    inputs: Annotated[dict[Channel, Annotated[int, AfterValidator(_on_a_card)]], Field(min_length=1)]
    channel_delay: DurationS = multiplexer.CHANNEL_DELAY_S

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The signals in scan order, which is the order of the channel numbers."""
        return tuple(sorted(self.inputs, key=lambda signal: self.inputs[signal]))

    @property
    def inputs_used(self) -> dict[Channel, int]:
        """The multiplexer channel of each signal."""
        return self.inputs

    @field_validator("inputs")
    @classmethod
    def _one_signal_each(cls, inputs: dict[Channel, int]) -> dict[Channel, int]:
        if len(set(inputs.values())) < len(inputs):
            raise ValueError("two signals share one channel of the multiplexer; change one")
        return inputs

    @field_validator("channel_delay")
    @classmethod
    def _of_the_multiplexer(cls, delay_s: float) -> float:
        steps = delay_s / multiplexer.CHANNEL_DELAY_STEP_S
        whole = abs(steps - round(steps)) < 1e-3
        longest_s = multiplexer.LONGEST_CHANNEL_DELAY_S
        if not (0.0 <= delay_s <= longest_s and whole):
            raise ValueError(
                f"state a channel delay of 0 to {longest_s:g} s in steps of 1 ms, not {delay_s:g} s"
            )
        return delay_s

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return the options common to all voltmeters, the model (34972A if on LAN) and the cards by slot."""
        return super().simulation_options(truth) | {
            "model": multiplexer.MODELS[self.interface == "lan"],
            "cards": {100 * (number // 100): multiplexer.CARD for number in self.inputs.values()},
        }


SensorWord = Literal["pt100", "pt100-two-wire", "thermistor-2252", "thermistor-5k", "thermistor-10k"]

_ROOM_C = 23.0


class Keysight34970AThermometerSection(ThermometerForm, WiredForm):
    """A temperature sensor on a channel of a 34901A card, such as 104.

    A four-wire `pt100` has its sense wires ten channels higher, such as on 114. If the voltmeter for the signals
    has the same `resource`, the sensor is an extra channel of that meter; the meter is configured for signals again
    after each reading of the temperature.
    """

    facts: ClassVar = multiplexer
    for_driver: ClassVar = ("channel", "sensor", "interface")
    for_simulation: ClassVar = for_driver

    driver: Literal["keysight-34970a-thermometer"]
    resource: Annotated[str, AfterValidator(any_resource)]
    timeout: Timeout = 5.0
    interface: Literal["lan", "gpib", "rs232"] = "lan"
    serial: PortSection = PortSection.of(multiplexer)
    channel: int
    sensor: SensorWord = "pt100"

    @model_validator(mode="after")
    def _on_a_card(self) -> Keysight34970AThermometerSection:
        known = PAIRED if SENSORS[self.sensor].pair else multiplexer.CARD_CHANNELS
        if self.channel // 100 not in multiplexer.SLOTS or self.channel % 100 not in known:
            raise ValueError(
                f"a {multiplexer.CARD} has {SENSORS[self.sensor].words} on its channels {known[0]:02d} to "
                f"{known[-1]:02d}, such as 104, not {self.channel}"
            )
        return self

    @property
    def tolerance_k(self) -> float:
        """The sum of the error limits of meter and probe at room temperature, K."""
        sensor = SENSORS[self.sensor]
        return sensor.meter_c + sensor.probe_c + sensor.probe_slope * _ROOM_C

    def simulation_options(self, truth: ThermometerTruth) -> dict[str, Any]:
        """Return the options of the simulated meter: values of the section, sensor errors, model, cards."""
        return super().simulation_options(truth) | {
            "error_c": truth.error,
            "noise_c": truth.noise,
            "air_share": truth.air_share,
            "model": multiplexer.MODELS[self.interface == "lan"],
            "cards": {100 * (self.channel // 100): multiplexer.CARD},
        }


class LineThermometerSection(TemperatureRange, ThermometerForm, LineForm):
    """A thermometer that answers `request` with one line of text, which holds the temperature in °C.

    A value below `minimum` or above `maximum` is refused; `tolerance` is the thermometer's error limit.
    """

    facts: ClassVar = text_line
    group: ClassVar = text_line.TEMPERATURE
    for_driver: ClassVar = (*LineForm.for_driver, ("minimum_c", "minimum"), ("maximum_c", "maximum"))

    driver: Literal["line-thermometer"]
    resource: Annotated[str, AfterValidator(any_resource)]
    model: Printable = "thermometer"
    tolerance: SizeK = 0.5

    @property
    def tolerance_k(self) -> float:
        """The stated tolerance, K."""
        return self.tolerance

    def simulation_options(self, truth: ThermometerTruth) -> dict[str, Any]:
        """Return the options common to all simulated instruments with a line of text, and the error, K."""
        return self.line_options() | {"error_c": truth.error}


DEVICE = (
    Device(
        "agilent-34401a",
        Agilent34401ASection,
        driver="drivers.instruments.agilent_34401a:Agilent34401A",
        simulation="sim.agilent_34401a:Agilent34401A",
        example={"channels": ["x"], "resource": "GPIB0::22::INSTR", "interface": "gpib"},
        simulated=(*_OF_THE_INPUT, "firmware", "errors_at_start", "real_port"),
    ),
    Device(
        "keysight-34461a",
        Keysight34461ASection,
        driver="drivers.instruments.keysight_34461a:Keysight34461A",
        simulation="sim.keysight_34461a:Keysight34461A",
        example={"channels": ["x"], "resource": "TCPIP0::192.0.2.22::5025::SOCKET"},
        simulated=_OF_THE_INPUT,
    ),
    Device(
        "keithley-2000",
        Keithley2000Section,
        driver="drivers.instruments.keithley_2000:Keithley2000",
        simulation="sim.keithley_2000:Keithley2000",
        example={"channels": ["x"], "resource": "GPIB0::16::INSTR"},
        simulated=("noise", "accuracy"),
    ),
    Device(
        "keysight-34970a",
        Keysight34970ASection,
        driver="drivers.instruments.keysight_34970a:Keysight34970A",
        simulation="sim.keysight_34970a:Keysight34970A",
        example={
            "inputs": {"x": "101", "y": "102", "z": "103"},
            "resource": "GPIB0::9::INSTR",
            "interface": "gpib",
        },
        simulated=("noise", "accuracy"),
    ),
    Device(
        "keysight-34970a-thermometer",
        Keysight34970AThermometerSection,
        driver="drivers.instruments.keysight_34970a:Keysight34970AThermometer",
        simulation="sim.keysight_34970a:meter_with_probe",
        example={"resource": "TCPIP0::192.0.2.70::5025::SOCKET", "channel": "104"},
        simulated=("error", "noise", "air_share"),
        place=1,
    ),
    Device(
        "line-thermometer",
        LineThermometerSection,
        driver="drivers.instruments.text_line:LineThermometer",
        simulation="sim.counters:LineThermometer",
        example={
            "resource": "ASRL/dev/ttyUSB1::INSTR",
            "request": "TEMP?",
            "pattern": r"T=(?P<temperature>[+-]\d+\.\d+) C",
            "example": "T=+23.00 C",
            "errors": {"T=OPEN": "the sensor came off"},
            "minimum": "-40 degC",
            "maximum": "125 degC",
        },
        simulated=("error",),
        place=2,
    ),
)
