"""HP / Agilent / Keysight 34970A and 34972A with 34901A multiplexer cards: several DC voltages, one meter.

The signals are sampled one after another, not at one moment: within a scan each waits for its channel's
delay and the integration of those before it. The meter scans in rising order of the channel numbers,
whatever order it is told.
Sources: 34970A User's Guide (34970-90003), chapter 4 "Scanning", "DC Voltage"; chapter 5, "The CONFigure
Command", "Scanning Commands", "Reading Format Commands", "SYSTem:CTYPe?"; chapter 8, specifications.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from drivers.interfaces import Channel, Identity, InstrumentRefused, LimitExceeded, VoltmeterSettings
from drivers.scpi_voltmeter import (
    IDENTITY,
    READING_CHARACTERS,
    Interface,
    Limits,
    ProvenSetting,
    ScpiVoltmeter,
    is_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 300.0)
NPLC: Final = (0.02, 0.2, 1.0, 2.0, 10.0, 20.0, 100.0, 200.0)
MEMORY_READINGS: Final = 50_000
LIMITS: Final = Limits(RANGES_V, NPLC, MEMORY_READINGS)
"""Those of one channel."""
LONGEST_DELAY_S: Final = 60.0

_MODELS: Final = ("34970A", "34972A")
_CARD: Final = "34901A"
_SLOTS: Final = (1, 2, 3)
_CARD_CHANNELS: Final = range(1, 21)  # 21 and 22 of the card measure current
_DELAY_STEP_S: Final = 1e-3

_SAMPLE_OVERHEAD_S: Final = 0.03
"""Closing a relay and what the meter needs around a sample; a card scans 60 channels/s at best."""

_READING_EXTRAS: Final = ("ALAR", "CHAN", "TIME", "UNIT")


class Keysight34970A(ScpiVoltmeter):
    """A `Voltmeter` with as many signals as channels are given (see `ScpiVoltmeter` for the rest).

    `channels` says on which channel of the multiplexer each signal is, `{"x": 101, "y": 102, "z": 103}` or
    the same as pairs; the attribute `channels` holds the signals in the order of the scan. A sample is one
    scan. `channel_delay_s` passes after each relay has closed, before its sample: whole milliseconds.
    Raises `LimitExceeded` for channels that a 34901A does not have or that are given twice, or the delay.
    """

    def __init__(
        self,
        name: str,
        channels: Mapping[Channel, int] | Sequence[tuple[Channel, int]],
        session: MessageSession,
        clock: Clock,
        *,
        interface: Interface = "lan",
        line_hz: float = 50.0,
        channel_delay_s: float = 0.1,
    ) -> None:
        pairs = list(channels.items()) if isinstance(channels, Mapping) else list(channels)
        pairs.sort(key=lambda pair: pair[1])
        if wrong := [*_wrong_channels(pairs), *_wrong_delay(channel_delay_s)]:
            raise LimitExceeded(name, f"cannot do {', '.join(wrong)}", "mend its lines in the bench file")
        signals = tuple(signal for signal, _ in pairs)
        super().__init__(name, signals, session, clock, interface=interface, line_hz=line_hz)
        self._numbers = tuple(number for _, number in pairs)
        self._channel_delay_s = channel_delay_s
        self._limits = LIMITS.of_channels(len(pairs))

    @property
    def limits(self) -> Limits:
        """What the meter can do with these channels: its memory holds 50,000 readings of all of them."""
        return self._limits

    def open(self) -> Identity:
        """Connect, prove the identity by pattern and that a 34901A is in each slot that is used.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        identity = super().open()
        for slot in sorted({100 * (number // 100) for number in self._numbers}):
            reply = self._session.query(f"SYST:CTYP? {slot}", pattern=IDENTITY, expected="a card's identity")
            card = reply.split(",")[1].strip()
            if card != _CARD:
                there = "is empty" if card == "0" else f"holds {reply!r}"
                raise InstrumentRefused(
                    self.name,
                    f"slot {slot} of {self._session.resource} {there}, not a {_CARD} multiplexer",
                    "put the card in, with the meter switched off, or mend the channels in the bench file",
                )
        return identity

    def _accept(self, identity: Identity, reply: str) -> None:
        if not is_of(identity, _MODELS):
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not a 34970A or 34972A",
                "check the address in the bench file",
            )

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

    def _reading_time_s(self, settings: VoltmeterSettings, character_time_s: float) -> float:
        sample_s = self._channel_delay_s + 2.0 * settings.nplc / self._line_hz + _SAMPLE_OVERHEAD_S
        return settings.samples * len(self._numbers) * (sample_s + READING_CHARACTERS * character_time_s)


def _wrong_channels(pairs: Sequence[tuple[Channel, int]]) -> list[str]:
    """Return what is wrong with the channels, one phrase for each."""
    wrong = [] if pairs else ["a scan of no channel"]
    for index, (signal, number) in enumerate(pairs):
        if number // 100 not in _SLOTS or number % 100 not in _CARD_CHANNELS:
            wrong.append(f"{signal} on channel {number} (a {_CARD} has 101 to 120, 201 to 220, 301 to 320)")
        if number in [other for _, other in pairs[:index]]:
            wrong.append(f"two signals on channel {number}")
        if signal in [other for other, _ in pairs[:index]]:
            wrong.append(f"{signal} on two channels")
    return wrong


def _wrong_delay(delay_s: float) -> list[str]:
    if not 0.0 <= delay_s <= LONGEST_DELAY_S:
        return [f"a channel delay of {delay_s:g} s (it has 0 to {LONGEST_DELAY_S:g} s)"]
    steps = delay_s / _DELAY_STEP_S
    if abs(steps - round(steps)) > 1e-6:
        return [f"a channel delay of {delay_s:g} s (it goes in steps of 1 ms)"]
    return []
