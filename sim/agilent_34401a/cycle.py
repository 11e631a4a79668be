"""What the trigger systems of the 34401A's line share: the states, the readings under way, the memory.

Time is that of an injected clock: starting only fixes when each sample is taken, and whoever needs the result
waits for the last one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from typing import TYPE_CHECKING

from sim.scpi.instrument import DeviceClear, never
from sim.scpi.status import ScpiError
from sim.world.clock import VirtualClock, wait_until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from drivers.clock import Clock


class TriggerState(Enum):
    """Where the trigger system stands."""

    IDLE = "idle"
    WAITING = "waiting for a trigger"
    MEASURING = "measuring"


class MeasuringCycle(ABC):
    """Idle, a start, wait for a trigger, measure; `source` says what gives the trigger.

    `memory_depth` readings are kept, the latest; `interrupted` tells whether a device clear has come in. What a
    client began that has left since is given up as soon as another would wait for it; on a virtual clock
    nobody waits, and it goes on.
    """

    memory_depth: int
    starts_itself: tuple[str, ...] = ("IMM",)
    """The sources that need nobody to give a trigger."""

    def __init__(self, clock: Clock, interrupted: Callable[[], bool]) -> None:
        self._clock = clock
        self._interrupted = interrupted
        self._sender_left = self._beginner_left = never
        self.source = "IMM"
        self.preset()
        self.abort()

    @abstractmethod
    def preset(self) -> None:
        """Set what *RST, CONFigure and MEASure set."""

    def abort(self) -> None:
        """Go to idle and forget what is stored or under way."""
        self.state = TriggerState.IDLE
        self._memory: list[str] = []
        self._readings: list[str] = []
        self._finish_s = 0.0
        self._triggers_left: float = 0
        self._keeps = False

    def sent_by(self, left: Callable[[], bool]) -> None:
        """Take note that what is begun from now on is for a client of whom `left` tells whether it has left."""
        if self._forsaken:
            self.abort()
        self._sender_left = left

    def fetch(self) -> str:
        """FETCh?: return what is in memory. Raises `ScpiError` -230 when there is nothing."""
        if not self._memory:
            raise ScpiError(-230)
        return ",".join(self._memory)

    def trigger(self, source: str) -> None:
        """Measure for one trigger from "BUS" or "EXT"; -211 when the meter does not wait for it."""
        if self.state is not TriggerState.WAITING or self.source != source:
            raise ScpiError(-211)
        self._schedule(1)

    def complete(self) -> None:
        """Wait for the measurement under way, if any, or until who began it has left.

        Raises `DeviceClear` when one comes in meanwhile.
        """
        if self.state is not TriggerState.MEASURING:
            return
        if wait_until(self._clock, self._finish_s, lambda: self._interrupted() or self._forsaken):
            self._collect()
        elif self._interrupted():
            raise DeviceClear
        else:
            self.abort()

    @property
    def in_progress(self) -> bool:
        """Whether samples are still being taken at this moment."""
        return self.state is TriggerState.MEASURING and self._clock.now_s() < self._finish_s

    @property
    def _forsaken(self) -> bool:
        """Whether samples are being taken for a client that has left."""
        return self._beginner_left() and self.in_progress and not isinstance(self._clock, VirtualClock)

    @abstractmethod
    def _schedule(self, triggers: int) -> None:
        """Fix when the samples of the next triggers are taken, and say so to `_measures_until`."""

    @abstractmethod
    def _taken(self) -> Iterator[str]:
        """Take the samples that are due, as texts, and forget that they are."""

    def _require_idle(self) -> None:
        """Raise `ScpiError` -213 when a measurement is under way."""
        if self.state is TriggerState.MEASURING and not self.in_progress:
            self._collect()
        if self.state is not TriggerState.IDLE:
            raise ScpiError(-213)

    def _start(self, triggers: float, *, keeps: bool) -> None:
        """Begin a measurement; its readings go to memory when it `keeps` them."""
        self._memory, self._readings = [], []
        self._keeps = keeps
        self._triggers_left = triggers
        if self.source in self.starts_itself:
            self._schedule(int(triggers))
        else:
            self.state = TriggerState.WAITING

    def _measures_until(self, finish_s: float, triggers: int) -> None:
        self._finish_s = finish_s
        self._beginner_left = self._sender_left
        self._triggers_left -= triggers
        self.state = TriggerState.MEASURING

    def _outcome(self) -> str | None:
        """Wait for the readings of READ?; None (no reply) while somebody must give the trigger."""
        if self.state is TriggerState.WAITING:
            return None
        self.complete()
        return ",".join(self._readings)

    def _collect(self) -> None:
        self._readings += self._taken()
        if self._keeps:
            self._memory = self._readings[-self.memory_depth :]
        self.state = TriggerState.WAITING if self._triggers_left > 0 else TriggerState.IDLE
