"""A Pt100 or a thermistor on a channel of a 34970A or 34972A."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, model_validator

from bench.base.units import DurationS
from bench.config.devices.device import Device, PortSection, WiredForm, any_resource
from bench.config.devices.sections import ThermometerForm, ThermometerTruth
from drivers.facts import keysight_34970a as multiplexer
from drivers.facts.keysight_34970a import PAIRED, SENSORS

SensorWord = Literal["pt100", "pt100-two-wire", "thermistor-2252", "thermistor-5k", "thermistor-10k"]

_ROOM_C = 23.0


class Keysight34970AThermometerSection(ThermometerForm, WiredForm):
    """A sensor on a channel of a 34901A card, named as 104; a `pt100` with four wires has its sense wires on 114.

    Where `resource` is that of the voltmeter with the signals, it is one channel more of that meter, which is then
    set up again after each temperature.
    """

    facts: ClassVar = multiplexer

    driver: Literal["keysight-34970a-thermometer"]
    resource: Annotated[str, AfterValidator(any_resource)]
    timeout: DurationS = 5.0
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
    def channels_used(self) -> tuple[int, ...]:
        """The channels of the card that it takes."""
        pair = SENSORS[self.sensor].pair
        return (self.channel, self.channel + pair) if pair else (self.channel,)

    @property
    def tolerance_k(self) -> float:
        """The limits of the meter and of the probe at room temperature together, K."""
        sensor = SENSORS[self.sensor]
        return sensor.meter_c + sensor.probe_c + sensor.probe_slope * _ROOM_C

    def driver_options(self) -> dict[str, Any]:
        """Return its channel, its sensor, how the meter is set."""
        return self.model_dump(include={"channel", "sensor", "interface"})

    def simulation_options(self, truth: ThermometerTruth) -> dict[str, Any]:
        """Return its channel and sensor, and what is true of it."""
        own = {"error_c": truth.error, "noise_c": truth.noise, "air_share": truth.air_share}
        return {
            **self.model_dump(include={"channel", "sensor", "interface"}),
            **own,
            "model": multiplexer.MODELS[self.interface == "lan"],
            "cards": {100 * (self.channel // 100): multiplexer.CARD},
        }


DEVICE = Device(
    "keysight-34970a-thermometer",
    Keysight34970AThermometerSection,
    driver="drivers.instruments.keysight_34970a:Keysight34970AThermometer",
    simulation="sim.keysight_34970a:meter_with_probe",
    example={"resource": "TCPIP0::192.0.2.70::5025::SOCKET", "channel": "104"},
    simulated=("error", "noise", "air_share"),
    place=1,
)
