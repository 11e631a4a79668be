"""Scanning and the reading memory of a simulated 34970A.

A trigger starts one sweep of the scan list: relay, channel delay, sample, then the next channel.
Source: 34970A User's Guide (34970-90003), chapter 4 "Scanning", chapter 5 "Scanning Commands",
"Reading Format Commands", "Scan Memory Commands".
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from drivers.agilent_34401a.facts import OVERLOAD_V
from drivers.keysight_34970a.facts import MEMORY_READINGS
from sim.agilent_34401a.converter import reading_text
from sim.agilent_34401a.line import MeasuringCycle
from sim.scpi.instrument import Command
from sim.scpi.status import ScpiError
from sim.scpi.values import INF, MAX, MIN, Boolean, Choice, Number, Value, integer, within

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from drivers.clock import Clock
    from sim.agilent_34401a.converter import Converter
    from sim.keysight_34970a.channels import CardInput, ChannelConfiguration

_MOST_SWEEPS: Final = 50_000
_LONGEST_TIMER_S: Final = 359_999.0
_RELAY_S: Final = 4e-3
_CANNOT: Final = 305
_INFINITE: Final = "+9.90000200E+37"
_EXTRAS: Final = ("UNIT", "TIME", "CHANnel", "ALARm")


class Scan(MeasuringCycle):
    """Scan list, trigger settings, the scan under way, and the memory, which keeps the latest readings.

    `channels` holds settings and converter of each channel, `inputs` what is at it. An endless scan (TRIGger:COUNt
    INFinity) can be set but not started here (305), nor one of more readings than the memory holds.
    """

    memory_depth = MEMORY_READINGS
    starts_itself = ("IMM", "TIM")

    def __init__(
        self,
        clock: Clock,
        channels: Mapping[int, tuple[ChannelConfiguration, Converter]],
        inputs: Mapping[int, CardInput],
        on_overload: Callable[[], None],
        interrupted: Callable[[], bool],
    ) -> None:
        self._channels = channels
        self._inputs = inputs
        self._on_overload = on_overload
        self.channel_list: tuple[int, ...] = ()
        self._due: list[tuple[int, float]] = []
        self._began_s = 0.0
        super().__init__(clock, interrupted)

    def preset(self) -> None:
        """Set what *RST, CONFigure and MEASure set: one immediate sweep, readings alone."""
        self.source = "IMM"
        self.count: float = 1
        self.timer_s = 0.0
        self.extras = dict.fromkeys((word.upper()[:4] for word in _EXTRAS), False)

    def abort(self) -> None:
        """ABORt, device clear: go to idle; nothing is left in memory."""
        super().abort()
        self._due = []

    def define(self, channels: tuple[int, ...]) -> None:
        """Set the scan list: it is scanned in rising order, each channel once."""
        self.channel_list = tuple(sorted(set(channels)))

    # --- measuring ----------------------------------------------------------------------------------

    def initiate(self) -> None:
        """INITiate: scan into memory. Raises `ScpiError` -213 while scanning, 305 as the class says."""
        self._begin(keeps=True)

    def read(self) -> str | None:
        """READ?: scan and return the readings, which are not stored. Raises as `initiate`, -214."""
        if self.source == "BUS":
            raise ScpiError(-214)
        self._begin(keeps=False)
        return self._outcome()

    def remove(self, count: float) -> str:
        """DATA:REMove?: return the oldest readings and take them out of memory; -222 if there are fewer."""
        number = int(within(round(count), 1, max(1, len(self._memory))))
        taken, self._memory = self._memory[:number], self._memory[number:]
        if not taken:
            raise ScpiError(-230)
        return ",".join(taken)

    def _begin(self, keeps: bool) -> None:
        self._require_idle()
        if not self.channel_list or self.count * len(self.channel_list) > self.memory_depth:
            raise ScpiError(_CANNOT)
        self._began_s = self._clock.now_s()
        for channel in self.channel_list:
            self._channels[channel][1].begin()
        self._start(self.count, keeps=keeps)

    def _schedule(self, triggers: int) -> None:
        """Fix when the samples of the next sweeps are taken, each in mid-integration."""
        start_s = now_s = self._clock.now_s()
        for sweep in range(triggers):
            if self.source == "TIM":
                now_s = max(now_s, start_s + sweep * self.timer_s)
            for channel in self.channel_list:
                configuration, converter = self._channels[channel]
                now_s += _RELAY_S + configuration.delay_s
                self._due.append((channel, now_s + converter.integration_s(configuration) / 2.0))
                now_s += converter.sample_s(configuration)
        self._measures_until(now_s, triggers)

    def _taken(self) -> Iterator[str]:
        for channel, time_s in self._due:
            configuration, converter = self._channels[channel]
            transducer = configuration.transducer
            if transducer is None:
                value = converter.sample(configuration, time_s)
            else:
                value = self._inputs[channel].shown_c(transducer.configured, time_s)
            if abs(value) >= OVERLOAD_V:
                self._on_overload()
            yield self._text(channel, time_s, value, converter.step(configuration))
        self._due = []

    def _text(self, channel: int, time_s: float, value: float, step: float) -> str:
        text = reading_text(value, step) + (" VDC" if self.extras["UNIT"] else "")
        if self.extras["TIME"]:
            text += f",{time_s - self._began_s:013.3f}"
        if self.extras["CHAN"]:
            text += f",{channel}"
        return text + (",0" if self.extras["ALAR"] else "")

    # --- commands -----------------------------------------------------------------------------------

    def commands(self) -> list[Command]:
        """Return the lines of the command table for triggering, memory and reading format."""
        count = (Number(words=(MIN, MAX, INF)),)
        source = (Choice(("BUS", "IMMediate", "EXTernal", "TIMer")),)
        lines = [
            Command("ABORt", self.abort),
            Command("INITiate", self.initiate),
            Command("READ?", self.read),
            Command("FETCh?", self.fetch),
            Command("*TRG", lambda: self.trigger("BUS")),
            Command("TRIGger:SOURce", self._set_source, source),
            Command("TRIGger:SOURce?", lambda: self.source),
            Command("TRIGger:COUNt", self._set_count, count),
            Command("TRIGger:COUNt?", lambda: _INFINITE if math.isinf(self.count) else f"{self.count:+.8E}"),
            Command("TRIGger:TIMer", self._set_timer, (Number("S"),)),
            Command("TRIGger:TIMer?", lambda: f"{self.timer_s:+.8E}"),
            Command("DATA:POINts?", lambda: integer(len(self._memory))),
            Command("DATA:REMove?", self.remove, (Number(words=()),)),
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

    def _set_timer(self, value: Value) -> None:
        words = {MIN: 0.0, MAX: _LONGEST_TIMER_S}
        self.timer_s = words[value] if isinstance(value, str) else within(value, 0.0, _LONGEST_TIMER_S)
