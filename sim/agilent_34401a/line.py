"""What simulated meters of the 34401A's line share: triggering, memory, remote control, errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from sim.scpi.instrument import Command, DeviceClear, ScpiInstrument, never
from sim.scpi.status import ScpiError
from sim.world.clock import VirtualClock, wait_until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from drivers.clock import Clock
    from sim.agilent_34401a.converter import Converter


Interface = Literal["gpib", "rs232", "lan"]

VOLT_OVERLOAD: Final = 1
"""The bit of the questionable data register."""

_ERRORS: Final = {
    514: "Command allowed only with RS-232",
    521: "Input buffer overflow",
    522: "Output buffer overflow",
    532: "Cannot achieve requested resolution",
    550: "Command not allowed in local",
}
_REMOTE_COMMANDS: Final = ("SYSTem:LOCal", "SYSTem:REMote", "SYSTem:RWLock")
_ALLOWED_IN_LOCAL: Final = (*_REMOTE_COMMANDS, "SYSTem:ERRor?", "*IDN?", "*CLS", "*ESR?", "*STB?")
_SCPI_VERSION: Final = "1994.0"


class LineMeter(ScpiInstrument):
    """The base of the meters.

    `interface` is what a meter believes to be connected by: "rs232" refuses (+550) all but identification,
    errors and SYSTem:REMote until that was sent, "gpib" refuses the SYSTem:REMote family (+514), "lan" takes
    both and needs neither. `errors` are the texts that the model has beside those of the line.
    """

    beside_measuring: tuple[str, ...] = ()
    """The commands that do not wait for a measurement under way."""

    def __init__(self, identity: str, errors: Mapping[int, str], interface: Interface) -> None:
        super().__init__(identity, {**_ERRORS, **errors})
        self.interface = interface
        self._remote = False
        self._locked = False
        self.add(self._remote_commands())

    # --- what a model says --------------------------------------------------------------------------

    @property
    @abstractmethod
    def cycle(self) -> MeasuringCycle:
        """Its trigger system."""

    @property
    @abstractmethod
    def converters(self) -> Sequence[Converter]:
        """Its converter, as each of its inputs has it."""

    # --- what the wire and the bench do -------------------------------------------------------------

    def admit(self, command: Command) -> None:
        """Refuse what the interface does not allow, and wait for a measurement under way."""
        if self.interface == "gpib" and command.notation in _REMOTE_COMMANDS:
            raise ScpiError(514)
        if self.interface == "rs232" and not self._remote and command.notation not in _ALLOWED_IN_LOCAL:
            raise ScpiError(550)
        if command.notation not in self.beside_measuring:
            self.cycle.complete()

    def device_clear(self) -> None:
        """Stop measuring and go to idle; settings, errors and status stay."""
        self.cycle.abort()

    def input_overflow(self) -> None:
        """Take note that a message was longer than the input buffer."""
        self.report(521)

    def power_cycle(self) -> None:
        """Switch off and on: the settings are gone, all but what a model keeps."""
        super().power_cycle()
        self._set_remote(False)

    def press_local(self) -> None:
        """Press LOCAL on the front panel: an RS-232 meter refuses commands until SYSTem:REMote.

        Locked by SYSTem:RWLock the key does nothing.
        """
        if not self._locked:
            self._remote = False

    @property
    def overloaded(self) -> bool:
        """Whether the voltage at every input is beyond every range, whatever the sources say."""
        return any(converter.overloaded for converter in self.converters)

    @overloaded.setter
    def overloaded(self, overloaded: bool) -> None:
        for converter in self.converters:
            converter.overloaded = overloaded

    # --- commands -----------------------------------------------------------------------------------

    def _remote_commands(self) -> list[Command]:
        return [
            Command("SYSTem:VERSion?", lambda: _SCPI_VERSION),
            Command("SYSTem:LOCal", lambda: self._set_remote(False)),
            Command("SYSTem:REMote", lambda: self._set_remote(True)),
            Command("SYSTem:RWLock", lambda: self._set_remote(True, locked=True)),
        ]

    def _set_remote(self, remote: bool, locked: bool = False) -> None:
        self._remote = remote
        self._locked = locked


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
