"""HP / Agilent / Keysight 34970A and 34972A with 34901A multiplexer cards: several DC voltages, one meter.

The signals are sampled one after another, not at one moment: within a scan each waits for its channel's
delay and the integration of those before it. The meter scans in rising order of the channel numbers,
whatever order it is told. Sources: see its facts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from drivers.interfaces import (
    Channel,
    Identity,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterLimits,
    VoltmeterSettings,
)
from drivers.keysight_34970a import facts
from drivers.scpi_voltmeter import IDENTITY, Interface, ProvenSetting, ScpiVoltmeter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_READING_EXTRAS: Final = ("ALAR", "CHAN", "TIME", "UNIT")


class Keysight34970A(ScpiVoltmeter):
    """A `Voltmeter` with as many signals as channels are given (see `ScpiVoltmeter` for the rest).

    `channels` says on which channel of the multiplexer each signal is, `{"x": 101, "y": 102, "z": 103}` or
    the same as pairs; the attribute `channels` holds the signals in the order of the scan. A sample is one
    scan. `channel_delay_s` passes after each relay has closed, before its sample: whole milliseconds.
    Raises `LimitExceeded` for channels that a 34901A does not have or that are given twice, or the delay.
    """

    models = facts.MODELS
    called = "a 34970A or 34972A"

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
            raise LimitExceeded(name, f"cannot do {', '.join(wrong)}", "mend its lines in the bench file")
        signals = tuple(signal for signal, _ in pairs)
        super().__init__(name, signals, session, clock, interface=interface, line_hz=line_hz)
        self._numbers = tuple(number for _, number in pairs)
        self._channel_delay_s = channel_delay_s
        self._limits = VoltmeterLimits.of(facts).of_channels(len(pairs))
        self.sample_overhead_s = channel_delay_s + facts.SAMPLE_OVERHEAD_S

    @property
    def limits(self) -> VoltmeterLimits:
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
            if card != facts.CARD:
                there = "is empty" if card == "0" else f"holds {reply!r}"
                raise InstrumentRefused(
                    self.name,
                    f"slot {slot} of {self._session.resource} {there}, not a {facts.CARD} multiplexer",
                    "put the card in, with the meter switched off, or mend the channels in the bench file",
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
    """Return what is wrong with the channels, one phrase for each."""
    wrong = [] if pairs else ["a scan of no channel"]
    for index, (signal, number) in enumerate(pairs):
        if number // 100 not in facts.SLOTS or number % 100 not in facts.CARD_CHANNELS:
            wrong.append(f"{signal} on channel {number} (a {facts.CARD} has {facts.CHANNELS_TEXT})")
        if number in [other for _, other in pairs[:index]]:
            wrong.append(f"two signals on channel {number}")
        if signal in [other for other, _ in pairs[:index]]:
            wrong.append(f"{signal} on two channels")
    return wrong


def _wrong_delay(delay_s: float) -> list[str]:
    if not 0.0 <= delay_s <= facts.LONGEST_CHANNEL_DELAY_S:
        return [f"a channel delay of {delay_s:g} s (it has 0 to {facts.LONGEST_CHANNEL_DELAY_S:g} s)"]
    steps = delay_s / facts.CHANNEL_DELAY_STEP_S
    if abs(steps - round(steps)) > 1e-6:
        return [f"a channel delay of {delay_s:g} s (it goes in steps of 1 ms)"]
    return []
