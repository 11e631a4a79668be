"""HP / Agilent / Keysight 34970A and 34972A with 34901A cards: one meter that measures several DC voltages.

The signals are not sampled simultaneously: within a scan, the meter samples one channel after another, each after
its channel delay. It scans in ascending order of the channel numbers, whatever order is requested. Sources: see
`drivers.facts.keysight_34970a`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from drivers.facts import keysight_34970a as facts
from drivers.facts.keysight_34970a import OPEN_C, PAIRED, SENSORS, Sensor
from drivers.interfaces import (
    BadReading,
    Channel,
    Identity,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterLimits,
    VoltmeterSettings,
    message,
)
from drivers.scpi_voltmeter import IDENTITY, Interface, ProvenSetting, ScpiVoltmeter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drivers.clock import Clock
    from drivers.interfaces import Channel
    from drivers.wire.visa import MessageSession

_READING_EXTRAS: Final = ("ALAR", "CHAN", "TIME", "UNIT")


class Keysight34970A(ScpiVoltmeter):
    """A `Voltmeter` with one signal per multiplexer channel (see `ScpiVoltmeter` for the other arguments).

    `channels` maps signals to channels, `{"x": 101, "y": 102, "z": 103}`, or lists them as pairs; the attribute
    `channels` holds the signals in scan order. A sample is one scan. `channel_delay_s` is the time from the closing
    of a relay to its sample, in whole milliseconds. Raises `LimitExceeded` for channels that a 34901A does not
    have, for duplicates, and for an invalid delay.
    """

    not_live = "a scanner's relays wear with every query, so it is read at readings only"
    models = facts.MODELS
    called = message("34970A or 34972A")

    def __init__(
        self,
        name: str,
        channels: Mapping[Channel, int] | Sequence[tuple[Channel, int]],
        session: MessageSession,
        clock: Clock,
        *,
        interface: Interface = "lan",
        line_hz: float = 50.0,
        channel_delay_s: float = facts.CHANNEL_DELAY_S,
    ) -> None:
        pairs = list(channels.items()) if isinstance(channels, Mapping) else list(channels)
        pairs.sort(key=lambda pair: pair[1])
        if wrong := [*_wrong_channels(pairs), *_wrong_delay(channel_delay_s)]:
            raise LimitExceeded(name, f"cannot do {', '.join(wrong)}", "correct its lines in the bench file")
        signals = tuple(signal for signal, _ in pairs)
        super().__init__(name, signals, session, clock, interface=interface, line_hz=line_hz)
        self._numbers = tuple(number for _, number in pairs)
        self._channel_delay_s = channel_delay_s
        self._limits = VoltmeterLimits.of(facts).of_channels(len(pairs))
        self.sample_overhead_s = channel_delay_s + facts.SAMPLE_OVERHEAD_S

    @property
    def limits(self) -> VoltmeterLimits:
        """The limits of the meter with these channels, which share its memory of 50,000 readings."""
        return self._limits

    def open(self) -> Identity:
        """Connect, verify the identity, and verify that each slot in use holds a 34901A.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        identity = super().open()
        for slot in sorted({100 * (number // 100) for number in self._numbers}):
            reply = self._session.query(
                f"SYST:CTYP? {slot}", pattern=IDENTITY, expected=message("a card's identity")
            )
            card = reply.split(",")[1].strip()
            if card != facts.CARD:
                there = message("is empty") if card == "0" else message(f"holds {reply!r}")
                raise InstrumentRefused(
                    self.name,
                    f"slot {slot} of {self._session.resource} {there}, not a {facts.CARD} multiplexer",
                    "put the card in, with the meter switched off, or correct the channels in the bench file",
                )
        return identity

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        listed = f"(@{','.join(map(str, self._numbers))})"
        every = len(self._numbers)

        def each(value: float) -> tuple[float, ...]:
            return (value,) * every

        return [
            # CONF presets delay, input resistance (10 MOhm), trigger and reading format, so it comes first.
            ProvenSetting(
                f"CONF:VOLT:DC {settings.range_v:g},DEF,{listed}",
                f"FUNC? {listed}",
                ",".join(['"VOLT"'] * every),
            ),
            ProvenSetting(None, f"VOLT:DC:RANG? {listed}", each(settings.range_v)),
            ProvenSetting(None, f"VOLT:DC:RANG:AUTO? {listed}", each(0.0)),
            ProvenSetting(
                f"VOLT:DC:NPLC {settings.nplc:g},{listed}", f"VOLT:DC:NPLC? {listed}", each(settings.nplc)
            ),
            ProvenSetting(f"ZERO:AUTO ON,{listed}", f"ZERO:AUTO? {listed}", each(1.0)),
            ProvenSetting(f"INP:IMP:AUTO ON,{listed}", f"INP:IMP:AUTO? {listed}", each(1.0)),
            ProvenSetting(
                f"ROUT:CHAN:DEL {self._channel_delay_s:g},{listed}",
                f"ROUT:CHAN:DEL? {listed}",
                each(self._channel_delay_s),
            ),
            ProvenSetting(
                f"ROUT:SCAN {listed}", "ROUT:SCAN?", f"#{len(str(len(listed)))}{len(listed)}{listed}"
            ),
            *(
                ProvenSetting(f"FORM:READ:{extra} OFF", f"FORM:READ:{extra}?", 0.0)
                for extra in _READING_EXTRAS
            ),
            ProvenSetting("TRIG:SOUR IMM", "TRIG:SOUR?", "IMM"),
            ProvenSetting(f"TRIG:COUN {settings.samples}", "TRIG:COUN?", float(settings.samples)),
        ]


def _wrong_channels(pairs: Sequence[tuple[Channel, int]]) -> list[str]:
    """Return one phrase for each mistake in the pairs of signal and channel."""
    wrong = [] if pairs else [message("a scan of no channel")]
    for index, (signal, number) in enumerate(pairs):
        if number // 100 not in facts.SLOTS or number % 100 not in facts.CARD_CHANNELS:
            wrong.append(message(f"{signal} on channel {number} (a {facts.CARD} has {facts.CHANNELS_TEXT})"))
        if number in [other for _, other in pairs[:index]]:
            wrong.append(message(f"two signals on channel {number}"))
        if signal in [other for other, _ in pairs[:index]]:
            wrong.append(message(f"{signal} on two channels"))
    return wrong


def _wrong_delay(delay_s: float) -> list[str]:
    if not 0.0 <= delay_s <= facts.LONGEST_CHANNEL_DELAY_S:
        return [
            message(f"a channel delay of {delay_s:g} s (it has 0 to {facts.LONGEST_CHANNEL_DELAY_S:g} s)")
        ]
    steps = delay_s / facts.CHANNEL_DELAY_STEP_S
    if abs(steps - round(steps)) > 1e-6:
        return [message(f"a channel delay of {delay_s:g} s (it goes in steps of 1 ms)")]
    return []


# --- as a thermometer -------------------------------------------------------------------------------
# Source: see `SENSORS` and the rest of `drivers.facts.keysight_34970a`.

_TEMPERATURE: Final = VoltmeterSettings(range_v=1.0, nplc=10.0, samples=1)
"""Settings for a temperature reading; the range has no effect, because the meter selects its range."""


class _Probe(ScpiVoltmeter):
    """A 34970A or 34972A that scans a single channel with a temperature sensor."""

    models = facts.MODELS
    called = message("34970A or 34972A")

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        *,
        channel: int,
        sensor: Sensor,
        interface: Interface,
        line_hz: float,
    ) -> None:
        super().__init__(name, ("x",), session, clock, interface=interface, line_hz=line_hz)
        self._channel = channel
        self._sensor = sensor
        self.sample_overhead_s = facts.CHANNEL_DELAY_S + facts.SAMPLE_OVERHEAD_S

    @property
    def limits(self) -> VoltmeterLimits:
        return VoltmeterLimits((_TEMPERATURE.range_v,), facts.NPLC, facts.MEMORY_READINGS)

    def open(self) -> Identity:
        identity = super().open()
        slot = 100 * (self._channel // 100)
        reply = self._session.query(
            f"SYST:CTYP? {slot}", pattern=IDENTITY, expected=message("a card's identity")
        )
        if reply.split(",")[1].strip() != facts.CARD:
            raise InstrumentRefused(
                self.name,
                f"slot {slot} of {self._session.resource} holds {reply!r}, not a {facts.CARD} multiplexer",
                "put the card in, with the meter switched off, or correct the channel in the bench file",
            )
        return identity

    def renew(self) -> None:
        """Configure the channel again before its next reading."""
        self._connection = None

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        listed = f"(@{self._channel})"
        return [
            # CONF sets the scan list to this channel and presets triggers and the format of readings.
            ProvenSetting(f"CONF:TEMP {self._sensor.configured},1,DEF,{listed}", f"FUNC? {listed}", '"TEMP"'),
            *(
                ProvenSetting(None, f"{question} {listed}", wanted)
                for question, wanted in self._sensor.proved
            ),
            ProvenSetting(f"UNIT:TEMP C,{listed}", f"UNIT:TEMP? {listed}", "C"),
            ProvenSetting(f"TEMP:NPLC {settings.nplc:g},{listed}", f"TEMP:NPLC? {listed}", settings.nplc),
            ProvenSetting(
                f"ROUT:SCAN {listed}", "ROUT:SCAN?", f"#{len(str(len(listed)))}{len(listed)}{listed}"
            ),
        ]

    def _refuse_overload(
        self, signals: Mapping[Channel, tuple[float, ...]], settings: VoltmeterSettings
    ) -> None:
        if any(abs(value) >= OPEN_C for values in signals.values() for value in values):
            raise BadReading(
                self.name,
                f"channel {self._channel} is open: it sees no {self._sensor.words}",
                "check the sensor's wiring; with four wires the sense wires are ten channels higher",
            )


class Keysight34970AThermometer:
    """A `Thermometer`: a sensor named as in `SENSORS` on a multiplexer channel such as 104.

    If the same instrument also serves as the voltmeter or as another thermometer, pass that driver as `meter` and
    its session as `session`. A voltmeter is then configured again after each temperature. Raises `LimitExceeded`
    for a channel that no card has, or that cannot measure with four wires although the sensor has four.
    """

    asks_person = False

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        *,
        channel: int,
        sensor: str = "pt100",
        interface: Interface = "lan",
        line_hz: float = 50.0,
        meter: Keysight34970A | Keysight34970AThermometer | None = None,
    ) -> None:
        probe = SENSORS[sensor]
        known = PAIRED if probe.pair else facts.CARD_CHANNELS
        if channel // 100 not in facts.SLOTS or channel % 100 not in known:
            raise LimitExceeded(
                name,
                f"cannot have {probe.words} on channel {channel}",
                "correct its channel in the bench file",
            )
        self.name = name
        self.sensor = f"{probe.words}, channel {channel}"
        self._range_c = probe.range_c
        self._meter = meter
        self._probe = _Probe(
            name, session, clock, channel=channel, sensor=probe, interface=interface, line_hz=line_hz
        )  # fmt: skip

    def open(self) -> Identity:
        """Connect and verify meter and card. Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`."""
        identity = self._probe.open()
        # a shared meter's serial number is reported by the voltmeter only
        return identity if self._meter is None else replace(identity, serial="")

    def close(self) -> str:
        """Disconnect, unless another driver owns the session. Never raises, may be called twice.

        Returns what a person must still do, an empty string for nothing.
        """
        return self._probe.close() if self._meter is None else ""

    def block_c(self, key: str) -> float:
        """Configure and verify the channel, read the sensor once, and return the temperature, °C.

        Raises `BadReading` for an open sensor or an impossible value, `InstrumentRefused`, `InstrumentLost`.
        """
        self._probe.renew()
        self._probe.configure(_TEMPERATURE)
        try:
            self._probe.start()
            shown_c = self._probe.fetch()["x"][0]
        finally:
            if isinstance(self._meter, Keysight34970A):
                self._meter.disturbed()
        low_c, high_c = self._range_c
        if not low_c <= shown_c <= high_c:
            raise BadReading(
                self.name,
                f"it shows {shown_c:g} °C, outside the sensor's {low_c:g} to {high_c:g} °C",
                "check the sensor and its kind in the bench file",
            )
        return shown_c
