"""Scanning and the reading memory of a simulated 34970A.

A trigger starts one sweep of the scan list: relay, channel delay, sample, then the next channel. As for the
34401A, starting only fixes when each sample is taken; whoever needs the result waits for the last one.
Source: 34970A User's Guide (34970-90003), chapter 4 "Scanning", chapter 5 "Scanning Commands",
"Reading Format Commands", "Scan Memory Commands".
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from sim.agilent_34401a.converter import OVERLOAD, reading_text
from sim.agilent_34401a.trigger import TriggerState
from sim.scpi.instrument import Command, DeviceClear
from sim.scpi.status import ScpiError
from sim.scpi.values import INF, MAX, MIN, Boolean, Choice, Number, Value, integer, within
from sim.world.clock import wait_until

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from drivers.clock import Clock
    from sim.agilent_34401a.converter import Converter
    from sim.keysight_34970a.channels import ChannelConfiguration

MEMORY_DEPTH: Final = 50_000
_MOST_SWEEPS: Final = 50_000
_LONGEST_TIMER_S: Final = 359_999.0
_RELAY_S: Final = 4e-3
_CANNOT: Final = 305
_INFINITE: Final = "+9.90000200E+37"
_EXTRAS: Final = ("UNIT", "TIME", "CHANnel", "ALARm")


class Scan:
    """Scan list, trigger settings, the scan under way, and the memory, which keeps the latest readings.

    `channels` holds settings and converter of each channel. An endless scan (TRIGger:COUNt INFinity) can be
    set but not started here (305), nor one of more readings than the memory holds.
    """

    def __init__(
        self,
        clock: Clock,
        channels: Mapping[int, tuple[ChannelConfiguration, Converter]],
        on_overload: Callable[[], None],
        interrupted: Callable[[], bool],
    ) -> None:
        self._clock = clock
        self._channels = channels
        self._on_overload = on_overload
        self._interrupted = interrupted
        self.channel_list: tuple[int, ...] = ()
        self.preset()
        self.abort()

    def preset(self) -> None:
        """Set what *RST, CONFigure and MEASure set: one immediate sweep, readings alone."""
        self.source = "IMM"
        self.count: float = 1
        self.timer_s = 0.0
        self.extras = dict.fromkeys((word.upper()[:4] for word in _EXTRAS), False)

    def abort(self) -> None:
        """ABORt, device clear: go to idle; nothing is left in memory."""
        self.state = TriggerState.IDLE
        self._memory: list[str] = []
        self._readings: list[str] = []
        self._due: list[tuple[int, float]] = []
        self._began_s = 0.0
        self._finish_s = 0.0
        self._left: float = 0
        self._stores = False

    def define(self, channels: tuple[int, ...]) -> None:
        """Set the scan list: it is scanned in rising order, each channel once."""
        self.channel_list = tuple(sorted(set(channels)))

    # --- measuring ----------------------------------------------------------------------------------

    def initiate(self) -> None:
        """INITiate: scan into memory. Raises `ScpiError` -213 while scanning, 305 as the class says."""
        self._begin(stores=True)

    def read(self) -> str | None:
        """READ?: scan and return the readings, which are not stored. Raises as `initiate`, -214."""
        if self.source == "BUS":
            raise ScpiError(-214)
        self._begin(stores=False)
        if self.state is TriggerState.WAITING:
            return None
        self.complete()
        return ",".join(self._readings)

    def fetch(self) -> str:
        """FETCh?: return what is in memory. Raises `ScpiError` -230 when there is nothing."""
        if not self._memory:
            raise ScpiError(-230)
        return ",".join(self._memory)

    def remove(self, count: float) -> str:
        """DATA:REMove?: return the oldest readings and take them out of memory; -222 if there are fewer."""
        number = int(within(round(count), 1, max(1, len(self._memory))))
        taken, self._memory = self._memory[:number], self._memory[number:]
        if not taken:
            raise ScpiError(-230)
        return ",".join(taken)

    def trigger(self, source: str) -> None:
        """Sweep once for a trigger from "BUS" or "EXT"; -211 when the meter does not wait for it."""
        if self.state is not TriggerState.WAITING or self.source != source:
            raise ScpiError(-211)
        self._schedule(1)

    def complete(self) -> None:
        """Wait for the sweeps under way. Raises `DeviceClear` when one comes in meanwhile."""
        if self.state is TriggerState.MEASURING:
            if not wait_until(self._clock, self._finish_s, self._interrupted):
                raise DeviceClear
            self._collect()

    def _begin(self, stores: bool) -> None:
        if self.state is TriggerState.MEASURING and self._clock.now_s() >= self._finish_s:
            self._collect()
        if self.state is not TriggerState.IDLE:
            raise ScpiError(-213)
        if not self.channel_list or self.count * len(self.channel_list) > MEMORY_DEPTH:
            raise ScpiError(_CANNOT)
        self._memory, self._readings = [], []
        self._stores = stores
        self._left = self.count
        self._began_s = self._clock.now_s()
        for channel in self.channel_list:
            self._channels[channel][1].begin()
        if self.source in ("IMM", "TIM"):
            self._schedule(int(self.count))
        else:
            self.state = TriggerState.WAITING

    def _schedule(self, sweeps: int) -> None:
        """Fix when the samples of the next sweeps are taken, each in mid-integration."""
        start_s = now_s = self._clock.now_s()
        for sweep in range(sweeps):
            if self.source == "TIM":
                now_s = max(now_s, start_s + sweep * self.timer_s)
            for channel in self.channel_list:
                configuration, converter = self._channels[channel]
                now_s += _RELAY_S + configuration.delay_s
                self._due.append((channel, now_s + converter.integration_s(configuration) / 2.0))
                now_s += converter.sample_s(configuration)
        self._finish_s = now_s
        self._left -= sweeps
        self.state = TriggerState.MEASURING

    def _collect(self) -> None:
        for channel, time_s in self._due:
            configuration, converter = self._channels[channel]
            value = converter.sample(configuration, time_s)
            if abs(value) >= OVERLOAD:
                self._on_overload()
            self._readings.append(self._text(channel, time_s, value, converter.step(configuration)))
        if self._stores:
            self._memory = self._readings[-MEMORY_DEPTH:]
        self._due = []
        self.state = TriggerState.WAITING if self._left > 0 else TriggerState.IDLE

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
