"""A Pt100 or a thermistor on a channel of a 34970A or 34972A, beside the signals or with a meter of its own.

Source: see `sensors` and the facts of the meter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from drivers.interfaces import (
    BadReading,
    Identity,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterLimits,
    VoltmeterSettings,
)
from drivers.keysight_34970a import facts
from drivers.keysight_34970a.sensors import OPEN_C, PAIRED, SENSORS, Sensor
from drivers.scpi_voltmeter import IDENTITY, Interface, ProvenSetting, ScpiVoltmeter

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.interfaces import Channel
    from drivers.keysight_34970a.driver import Keysight34970A
    from drivers.wire.visa import MessageSession

_TEMPERATURE: Final = VoltmeterSettings(range_v=1.0, nplc=10.0, samples=1)
"""A range is no matter of temperatures; the meter finds its own."""


class _Probe(ScpiVoltmeter):
    """The meter as it scans one channel for a temperature."""

    models = facts.MODELS
    called = "a 34970A or 34972A"

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
        reply = self._session.query(f"SYST:CTYP? {slot}", pattern=IDENTITY, expected="a card's identity")
        if reply.split(",")[1].strip() != facts.CARD:
            raise InstrumentRefused(
                self.name,
                f"slot {slot} of {self._session.resource} holds {reply!r}, not a {facts.CARD} multiplexer",
                "put the card in, with the meter switched off, or mend the channel in the bench file",
            )
        return identity

    def anew(self) -> None:
        """Forget what was set: the channel is set again before it is read."""
        self._connection = None

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        listed = f"(@{self._channel})"
        return [
            # CONF makes the channel the scan list, presets triggers and the format of readings
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
                "check the sensor's wiring; with four wires the sense wires are ten channels on",
            )


class Keysight34970AThermometer:
    """A `Thermometer`: the sensor of that name (`SENSORS`) on a channel such as 104.

    With `meter`, the voltmeter that has the signals, it is read over the voltmeter's session, and the voltmeter
    then set up again. Raises `LimitExceeded` for a channel that a card does not have, or not for four wires.
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
        meter: Keysight34970A | None = None,
    ) -> None:
        probe = SENSORS[sensor]
        known = PAIRED if probe.pair else facts.CARD_CHANNELS
        if channel // 100 not in facts.SLOTS or channel % 100 not in known:
            raise LimitExceeded(
                name, f"cannot have {probe.words} on channel {channel}", "mend its channel in the bench file"
            )
        self.name = name
        self.sensor = f"{probe.words}, channel {channel}"
        self._range_c = probe.range_c
        self._meter = meter
        self._probe = _Probe(
            name, session, clock, channel=channel, sensor=probe, interface=interface, line_hz=line_hz
        )  # fmt: skip

    def open(self) -> Identity:
        """Connect and prove meter and card. Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`."""
        identity = self._probe.open()
        # beside the signals it is the voltmeter that has the serial number
        return identity if self._meter is None else replace(identity, serial="")

    def close(self) -> str:
        """Let the wire go where it is its own, as a voltmeter does. Never raises, may be called twice."""
        return self._probe.close() if self._meter is None else ""

    def block_c(self, key: str) -> float:
        """Set the channel up, prove it, read the sensor once.

        Raises `BadReading` for an open sensor, `InstrumentRefused`, `InstrumentLost`.
        """
        self._probe.anew()
        self._probe.configure(_TEMPERATURE)
        try:
            self._probe.start()
            shown_c = self._probe.fetch()["x"][0]
        finally:
            if self._meter is not None:
                self._meter.disturbed()
        low_c, high_c = self._range_c
        if not low_c <= shown_c <= high_c:
            raise BadReading(
                self.name,
                f"it shows {shown_c:g} °C, outside the sensor's {low_c:g} to {high_c:g} °C",
                "check the sensor and its kind in the bench file",
            )
        return shown_c
