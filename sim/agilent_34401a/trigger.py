"""The trigger system and the reading memory of a simulated 34401A.

Idle, INITiate or READ?, wait for a trigger, delay, sample.
Source: 34401A User's Guide (34401-90004), chapter 3 "Triggering", chapter 4 "The Trigger Model".
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from drivers.facts.agilent_34401a import MEMORY_READINGS, OVERLOAD_V
from sim.scpi import Command
from sim.scpi_values import (
    INF,
    MAX,
    MIN,
    Boolean,
    Choice,
    Number,
    ScpiError,
    Text,
    Value,
    integer,
    quoted,
    within,
)
from sim.voltmeters import MeasuringCycle, TriggerState, reading_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from drivers.clock import Clock
    from sim.agilent_34401a.functions import Configuration
    from sim.agilent_34401a.math import Math
    from sim.voltmeters import Converter

_MOST_READINGS: Final = 50_000
_LONGEST_DELAY_S: Final = 3600.0
_INFINITE: Final = "9.90000000E+37"


class Trigger(MeasuringCycle):
    """Trigger settings, the measurement under way, and the memory.

    `on_overload` is told of each reading outside the range, `interrupted` whether a device clear has come in.
    A later model has a memory of its own depth, which keeps the latest readings, those of READ? as well.
    """

    memory_depth = MEMORY_READINGS
    most_readings = _MOST_READINGS
    keeps_latest = False

    def __init__(
        self,
        clock: Clock,
        configuration: Configuration,
        converter: Converter,
        math_operation: Math,
        on_overload: Callable[[], None],
        interrupted: Callable[[], bool],
    ) -> None:
        self._configuration = configuration
        self._converter = converter
        self._math = math_operation
        self._on_overload = on_overload
        self._times_s: list[float] = []
        super().__init__(clock, interrupted)

    def preset(self) -> None:
        """Set what *RST, CONFigure and MEASure set: one immediate trigger, one sample, automatic delay."""
        self.source = "IMM"
        self.delay_s: float | None = None
        self.trigger_count: float = 1
        self.sample_count = 1
        self.stores = True

    def abort(self) -> None:
        """Go to idle and forget what is stored or under way."""
        super().abort()
        self._times_s = []

    # --- measuring ----------------------------------------------------------------------------------

    def initiate(self) -> None:
        """INITiate: start a measurement into memory.

        Raises `ScpiError` -213 when one is under way, 531 when the memory is too small, 522 as `read`.
        """
        self._require_idle()
        readings = self.trigger_count * self.sample_count
        if self.stores and not self.keeps_latest and readings > self.memory_depth:
            raise ScpiError(531)
        self._begin(keeps=self.stores)

    def read(self) -> str | None:
        """READ?: measure and return the readings, which are not stored.

        With an external trigger no reply comes, and the meter waits until a device clear. Raises `ScpiError`
        -213 when a measurement is under way, -214 when only a command could give the trigger, 522 for more
        readings than the largest sample count (or endlessly many), which this simulation does not send.
        """
        self._require_idle()
        if self.source == "BUS":
            raise ScpiError(-214)
        self._begin(keeps=self.keeps_latest)
        return self._outcome()

    def _begin(self, keeps: bool) -> None:
        if self.trigger_count * self.sample_count > self.most_readings:
            raise ScpiError(522)
        self._converter.begin()
        self._start(self.trigger_count, keeps=keeps)

    def _schedule(self, triggers: int) -> None:
        """Fix when the samples of the next triggers are taken: each after its delay, in mid-integration."""
        configuration = self._configuration
        start_s = self._clock.now_s()
        delay_s = self._delay_s()
        step_s = delay_s + self._converter.sample_s(configuration)
        middle_s = delay_s + self._converter.integration_s(configuration) / 2.0
        samples = triggers * self.sample_count
        self._times_s = [start_s + i * step_s + middle_s for i in range(samples)]
        self._measures_until(start_s + samples * step_s, triggers)

    def _taken(self) -> Iterator[str]:
        """Take the samples that are due: the source knows what the signal was at their times."""
        for time_s in self._times_s:
            value = self._math.apply(self._converter.sample(self._configuration, time_s))
            if abs(value) >= OVERLOAD_V:
                self._on_overload()
            step = 0.0 if self._math.enabled else self._converter.step(self._configuration)
            yield reading_text(value, step)
        self._times_s = []

    def _delay_s(self) -> float:
        return self._converter.settling_s(self._configuration) if self.delay_s is None else self.delay_s

    # --- commands -----------------------------------------------------------------------------------

    def commands(self) -> list[Command]:
        """Return the lines of the command table for triggering and memory."""
        word = (Number(optional=True),)
        count = (Number(words=(MIN, MAX, INF)),)
        return [
            Command("INITiate[:IMMediate]", self.initiate),
            Command("READ?", self.read),
            Command("FETCh?", self.fetch),
            Command("*TRG", lambda: self.trigger("BUS")),
            Command(
                "TRIGger[:SEQuence]:SOURce", self._set_source, (Choice(("BUS", "IMMediate", "EXTernal")),)
            ),
            Command("TRIGger[:SEQuence]:SOURce?", lambda: self.source),
            Command("TRIGger[:SEQuence]:DELay", self._set_delay, (Number("S"),)),
            Command("TRIGger[:SEQuence]:DELay?", self._delay, word),
            Command("TRIGger[:SEQuence]:DELay:AUTO", self._set_delay_auto, (Boolean(),)),
            Command("TRIGger[:SEQuence]:DELay:AUTO?", lambda: str(int(self.delay_s is None))),
            Command("TRIGger[:SEQuence]:COUNt", self._set_trigger_count, count),
            Command("TRIGger[:SEQuence]:COUNt?", lambda w="": self._count_text(w, self.trigger_count), word),
            Command("SAMPle:COUNt", self._set_sample_count, (Number(),)),
            Command("SAMPle:COUNt?", lambda w="": self._count_text(w, self.sample_count), word),
            Command("DATA:FEED", self._set_feed, (Choice(("RDG_STORE",)), Text())),
            Command("DATA:FEED?", lambda: quoted("CALC" if self.stores else "")),
            Command("DATA:POINts?", lambda: integer(len(self._memory))),
        ]

    def _set_source(self, source: str) -> None:
        self.source = source
        self.stop_waiting()

    def stop_waiting(self) -> None:
        """Return to idle when waiting for a trigger: the measurement that was asked for is no longer set."""
        if self.state is TriggerState.WAITING:
            self.state = TriggerState.IDLE

    def _set_delay(self, value: Value) -> None:
        limits_s = {MIN: 0.0, MAX: _LONGEST_DELAY_S}
        self.delay_s = limits_s[value] if isinstance(value, str) else within(value, 0.0, _LONGEST_DELAY_S)
        self.stop_waiting()

    def _delay(self, word: str = "") -> str:
        return f"{ {MIN: 0.0, MAX: _LONGEST_DELAY_S}.get(word, self._delay_s()):+.6E}"

    def _set_delay_auto(self, flag: str) -> None:
        self.delay_s = None if flag == "1" else self._delay_s()
        self.stop_waiting()

    def _set_trigger_count(self, value: Value) -> None:
        self.trigger_count = math.inf if value == INF else self._count(value)
        self.stop_waiting()

    def _set_sample_count(self, value: Value) -> None:
        self.sample_count = self._count(value)
        self.stop_waiting()

    def _set_feed(self, _memory: str, feed: str) -> None:
        if feed.upper() not in ("", "CALC", "CALCULATE"):
            raise ScpiError(-224)
        self.stores = feed != ""

    def _count(self, value: Value) -> int:
        """Return a count, rounded; MIN and MAX resolved. Raises `ScpiError` -222 outside 1…`most_readings`."""
        if isinstance(value, str):
            return 1 if value == MIN else self.most_readings
        return math.floor(within(math.floor(value + 0.5), 1, self.most_readings))

    def _count_text(self, word: str, value: float) -> str:
        if word:
            return integer(1 if word == MIN else self.most_readings)
        return _INFINITE if math.isinf(value) else integer(value)
