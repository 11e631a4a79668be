"""A simulated 34970A or 34972A with 34901A cards, and a simulated temperature sensor on one channel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import keysight_34970a as facts
from drivers.facts.agilent_34401a import OVERLOAD_V
from drivers.facts.keysight_34970a import SENSORS
from sim.keysight_34970a_scan import (
    CARDS,
    DC_VOLTS,
    KINDS,
    CardInput,
    ChannelConfiguration,
    ChannelList,
    Scan,
    Transducer,
    listed,
)
from sim.scpi import Command, Interface
from sim.scpi_values import (
    DEF,
    MAX,
    MIN,
    Boolean,
    Choice,
    CommandParameter,
    Number,
    ScpiError,
    Value,
    next_above,
    number_of,
    quoted,
)
from sim.voltmeters import Accuracy, Converter, LineMeter, MeteredSignal

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from drivers.clock import Clock
    from sim.world.world import World


Model = Literal["34970A", "34972A"]

_SLOTS: Final = tuple(100 * slot for slot in facts.SLOTS)
_ERRORS: Final = {
    302: "No module was detected in this slot",
    304: "Does not exist",
    305: "Not able to perform requested operation",
    309: "Incorrectly formatted channel list",
}


class Keysight34970A(LineMeter):
    """A 34970A or 34972A. `wiring` maps channels to signals, `{101: world.terminals("x"), …}`.

    `cards` maps each occupied slot (100, 200, 300) to its card. `interface`, `noise` and `accuracy` are as
    for an `Agilent34401A`. The meter has one converter, so all channels share its gain error and offset.
    Raises `ValueError` for a channel that is not on the cards.
    """

    beside_measuring = ("INITiate",)

    def __init__(
        self,
        wiring: Mapping[int, MeteredSignal],
        clock: Clock,
        *,
        model: Model = "34970A",
        cards: Mapping[int, str] | None = None,
        interface: Interface = "lan",
        noise: bool = True,
        accuracy: Accuracy | None = None,
        line_hz: float = 50.0,
    ) -> None:
        super().__init__(facts.IDENTITIES[model], _ERRORS, interface)
        self.model = model
        self.cards = {_SLOTS[0]: facts.CARD} if cards is None else dict(cards)
        numbers = [slot + number for slot, card in self.cards.items() for number in CARDS[card]]
        if not wiring or not set(wiring) <= set(numbers):
            wired, slots = (", ".join(map(str, sorted(some))) for some in (wiring, self.cards))
            raise ValueError(f"channels {wired} are not all on cards in the slots {slots}")
        common = wiring[min(wiring)]
        inputs = {number: CardInput(wiring.get(number), common) for number in numbers}
        self._channels = {
            number: (
                ChannelConfiguration(),
                Converter(inputs[number], facts, noise=noise, accuracy=accuracy, line_hz=line_hz),
            )
            for number in numbers
        }
        self.scan = Scan(clock, self._channels, inputs, self.device_clear_pending)
        for lines in (self.scan.commands(), self._configure_commands(), self._sense_commands()):
            self.add(lines)
        self.add(self._system_commands())

    # --- called by the wire and the bench -----------------------------------------------------------

    @property
    def cycle(self) -> Scan:
        """The scan, which is the meter's trigger system."""
        return self.scan

    @property
    def converters(self) -> list[Converter]:
        """The converters, one for each channel, all with the errors of the meter's single converter."""
        return [converter for _, converter in self._channels.values()]

    def reset(self) -> None:
        """*RST: default channel settings, an empty scan list; keep errors."""
        self._scan_anew(())
        for configuration, _ in self._channels.values():
            configuration.preset()

    # --- CONFigure ----------------------------------------------------------------------------------

    def _configure_commands(self) -> list[Command]:
        words = Number("V", (MIN, MAX, DEF))
        parameters = (ChannelList(words), ChannelList(words, optional=True), ChannelList(optional=True))
        return [
            Command("CONFigure:VOLTage[:DC]", self._configure, parameters),
            Command(
                "CONFigure:TEMPerature",
                self._configure_temperature,
                (Choice(KINDS), Number(words=(DEF,)), *parameters),
            ),
        ]

    def _configure(self, *values: Value) -> None:
        if not str(values[-1]).startswith("("):
            raise ScpiError(-109)
        numbers, channels = self._split(values)
        range_value, resolution = (*numbers, DEF, DEF)[:2]
        for channel in channels:
            self._channels[channel][0].configure(range_value, resolution)
        self._scan_anew(channels)

    def _configure_temperature(self, kind: str, number: Value, *values: Value) -> None:
        if not str(values[-1]).startswith("("):
            raise ScpiError(-109)
        channels = self._split(values)[1]
        probes = {channel: Transducer.of(kind, number, channel) for channel in channels}
        for channel, probe in probes.items():
            self._channels[channel][0].measure_temperature(probe)
        self._scan_anew(channels)

    def _scan_anew(self, channels: tuple[int, ...]) -> None:
        self.scan.abort()
        self.scan.preset()
        self.scan.define(channels)

    # --- settings of channels -----------------------------------------------------------------------

    def _sense_commands(self) -> list[Command]:
        by_integration = {nplc: resolution for resolution, nplc in DC_VOLTS.integration.items()}
        accepted = sorted(by_integration)

        def set_nplc(channel: ChannelConfiguration, value: Value) -> None:
            wanted = number_of(value, accepted[0], accepted[-1])
            channel.settings.resolution = by_integration[next_above(wanted, accepted)]

        def set_delay(channel: ChannelConfiguration, value: Value) -> None:
            channel.set_delay(number_of(value, 0.0, facts.LONGEST_CHANNEL_DELAY_S))

        volts, degrees, flag = "[SENSe:]VOLTage[:DC]", "[SENSe:]TEMPerature", Boolean()
        return [
            self._query(f"{volts}:RANGe", lambda c: f"{c.settings.range_value:+.8E}"),
            self._query(f"{volts}:RANGe:AUTO", lambda c: str(int(c.settings.autorange))),
            *self._lines(f"{volts}:NPLCycles", Number(), set_nplc, lambda c: f"{c.nplc:+.8E}"),
            *self._lines(
                "[SENSe:]ZERO:AUTO", Boolean(("ONCE",)), _set_autozero, lambda c: str(int(c.autozero))
            ),
            *self._lines("INPut:IMPedance:AUTO", flag, _set_impedance, lambda c: str(int(c.high_impedance))),
            *self._lines("ROUTe:CHANnel:DELay", Number("S"), set_delay, lambda c: f"{c.delay_s:+.8E}"),
            self._query("[SENSe:]FUNCtion", lambda c: quoted(c.function.name)),
            *self._lines(f"{degrees}:NPLCycles", Number(), set_nplc, lambda c: f"{c.nplc:+.8E}"),
            *self._lines("UNIT:TEMPerature", Choice(("C", "F", "K")), _set_unit, lambda _: "C"),
            *(
                self._query(f"{degrees}:TRANsducer{of}", partial(_of_probe, show))
                for of, show in _OF_PROBE.items()
            ),
        ]

    def _lines(
        self,
        notation: str,
        parameter: CommandParameter,
        change: Callable[[ChannelConfiguration, Value], None],
        show: Callable[[ChannelConfiguration], str],
    ) -> list[Command]:
        """Return command and query of a channel setting; without a channel list they apply to the scan list.

        `change` sets the value of a channel, `show` returns it as text.
        """

        def command(value: Value, channels: str = "") -> None:
            for channel in self._of(channels):
                change(self._channels[channel][0], value)

        optional = ChannelList(optional=True)
        return [Command(notation, command, (parameter, optional)), self._query(notation, show)]

    def _query(self, notation: str, show: Callable[[ChannelConfiguration], str]) -> Command:
        def query(channels: str = "") -> str:
            return ",".join(show(self._channels[channel][0]) for channel in self._of(channels))

        return Command(f"{notation}?", query, (ChannelList(optional=True),))

    def _of(self, text: str) -> tuple[int, ...]:
        """Return the channels of a list, or the scan list if `text` is empty; `ScpiError` 305 for none."""
        channels = listed(text, self.cards) if text else self.scan.channel_list
        if not channels:
            raise ScpiError(305)
        return channels

    def _split(self, values: tuple[Value, ...]) -> tuple[tuple[Value, ...], tuple[int, ...]]:
        """Return the values before a channel list, and the channels. Raises `ScpiError` 309 for two lists."""
        if any(str(value).startswith("(") for value in values[:-1]):
            raise ScpiError(309)
        if values and str(values[-1]).startswith("("):
            return values[:-1], self._of(str(values[-1]))
        return values, self._of("")

    # --- scan list, system --------------------------------------------------------------------------

    def _system_commands(self) -> list[Command]:
        return [
            Command("ROUTe:SCAN", lambda text: self.scan.define(listed(text, self.cards)), (ChannelList(),)),
            Command("ROUTe:SCAN?", self._scan_list),
            Command("SYSTem:CTYPe?", self._card, (Number(words=()),)),
        ]

    def _scan_list(self) -> str:
        text = f"(@{','.join(map(str, self.scan.channel_list))})"
        return f"#{len(str(len(text)))}{len(text)}{text}"

    def _card(self, slot: float) -> str:
        if slot not in _SLOTS:
            raise ScpiError(-222)
        card = self.cards.get(int(slot))
        return "HEWLETT-PACKARD,0,0,0" if card is None else f"HEWLETT-PACKARD,{card},0,2.3"


_OF_PROBE: Final[dict[str, Callable[[Transducer], str]]] = {
    ":TYPE": lambda probe: probe.kind,
    ":RTD:TYPE": lambda probe: f"{probe.type:+d}",
    ":FRTD:TYPE": lambda probe: f"{probe.type:+d}",
    ":THERmistor:TYPE": lambda probe: f"{probe.type:+d}",
    ":RTD:RESistance[:REFerence]": lambda _: "+1.00000000E+02",
    ":FRTD:RESistance[:REFerence]": lambda _: "+1.00000000E+02",
}


def _of_probe(show: Callable[[Transducer], str], channel: ChannelConfiguration) -> str:
    return show(channel.transducer or Transducer())


def _set_unit(_channel: ChannelConfiguration, unit: Value) -> None:
    if unit != "C":
        raise ScpiError(-224)


def _set_autozero(channel: ChannelConfiguration, flag: Value) -> None:
    # ONCE takes one zero reading and then switches autozero off.
    channel.autozero = flag == "1"


def _set_impedance(channel: ChannelConfiguration, flag: Value) -> None:
    channel.high_impedance = flag == "1"


_PLACE: Final = 3
"""The index of this meter on the bench; the three voltmeters have 0 to 2."""
_LEADS_OHM: Final = 0.5
_OHM_PER_K: Final = 0.385


class Probe:
    """A temperature sensor on the block, of a type in `SENSORS`; to a meter set to volts it is a short.

    It shows the block's temperature plus three terms, °C: the fraction `air_share` of the difference between
    chamber air and block, the constant error `error_c`, and noise of the standard deviation `noise_c`.
    """

    def __init__(
        self, world: World, sensor: str, *, error_c: float = 0.0, noise_c: float = 0.0, air_share: float = 0.0
    ) -> None:
        self._world = world
        self._sensor = SENSORS[sensor]
        self._error_c = error_c
        self._noise_c = noise_c
        self._air_share = air_share
        self._reading = 0

    @property
    def place(self) -> int:
        """The index, on the bench, of the meter to which the sensor is wired."""
        return _PLACE

    @property
    def temperature_c(self) -> float:
        """The temperature of the meter to which the sensor is wired, °C."""
        return self._world.meters_c()

    def signal_v(self, time_s: float | None = None) -> float:
        """Return 0 V: to a voltmeter the sensor is a short."""
        return 0.0

    def new_reading(self) -> None:
        """Begin a new reading; called when the meter is triggered."""
        self._reading = self._world.count("thermometer")

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for one purpose within the present reading."""
        return self._world.random(purpose, "thermometer", self._reading)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for a permanent property of the meter."""
        return self._world.fixed_random(purpose, "thermometer")

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return the temperature, °C, that a meter configured for the sensor `configured` ("FRTD,85") shows.

        A meter configured for two wires adds the resistance of the leads of a four-wire Pt100. Any other sensor
        than `configured` gives an overload.
        """
        block_c = self._world.block_c_at(time_s)
        felt_c = block_c + self._air_share * (self._world.chamber_c - block_c) + self._error_c
        felt_c += self._noise_c * float(self.random("thermometer noise").standard_normal())
        if configured == self._sensor.configured:
            return felt_c
        if configured == "RTD,85" and self._sensor.configured == "FRTD,85":
            return felt_c + _LEADS_OHM / _OHM_PER_K
        return OVERLOAD_V


def meter_with_probe(
    world: World,
    *,
    channel: int,
    sensor: str,
    error_c: float = 0.0,
    noise_c: float = 0.0,
    air_share: float = 0.0,
    probes: Mapping[int, Probe] | None = None,
    **options: object,
) -> Keysight34970A:
    """Return a meter with a temperature sensor on `channel` as its only signal; `options` are those of the meter.

    `probes` replaces this sensor by several sensors, keyed by channel.
    """
    probe = Probe(world, sensor, error_c=error_c, noise_c=noise_c, air_share=air_share)
    return Keysight34970A(probes or {channel: probe}, world.clock, **options)  # type: ignore[arg-type]
