"""Injected faults of a simulated instrument and its wire: their kind, time and frequency.

A fault is stated as data in a bench file or through the control: `{fault: cut, probability: 0.01}`, `{fault: drop,
at: 17}`, `{fault: late, matching: "READ?", seconds: 2, instrument: voltmeter.x}`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from drivers.clock import Clock, SystemClock
from drivers.interfaces import BenchError
from sim.wires.session import DROP, SILENCE, LineEnds, WireFault, line_ends_of
from sim.world.chance import keyed_generator

if TYPE_CHECKING:
    import numpy as np

    from sim.wires.session import Dialect


class FaultKind(StrEnum):
    """Kinds of faults: the last five occur in the instrument, all others on its wire."""

    DROP = "drop"
    """The command is carried out; the connection is closed without a reply."""
    REFUSE = "refuse"
    """As DROP; new connections are then refused, for `seconds` or until the control accepts them again."""
    LATE = "late"
    """The reply comes `seconds` late."""
    TWICE = "twice"
    """The reply comes twice."""
    CUT = "cut"
    """The reply breaks off, without its terminator."""
    GARBLE = "garble"
    """Every character of the reply is wrong."""
    SILENCE = "silence"
    """The command is carried out; the reply is lost."""
    HANG = "hang"
    """This command and later ones are lost, for `seconds` or until a device clear or power cycle."""
    POWER_CYCLE = "power-cycle"
    """The instrument is switched off and on just before the command and loses its settings."""
    OVERLOAD = "overload"
    """Samples taken during this command are beyond every range."""
    LOCAL = "local"
    """The LOCAL key is pressed just before the command."""
    ERROR = "error"
    """The error number `error` enters the instrument's queue just before the command."""


_NEEDS_REPLY: Final = frozenset({FaultKind.LATE, FaultKind.TWICE, FaultKind.CUT, FaultKind.GARBLE})
_TAKES_SECONDS: Final = frozenset({FaultKind.LATE, FaultKind.REFUSE, FaultKind.HANG})
_KEYS: Final = ("fault", "probability", "at", "matching", "seconds", "error", "instrument")
_DATA_OUT_OF_RANGE: Final = -222


_NEEDS: Final = {
    FaultKind.POWER_CYCLE: ("power_cycle", "cannot be switched off and on"),
    FaultKind.LOCAL: ("press_local", "has no LOCAL key"),
    FaultKind.ERROR: ("report", "has no error queue"),
    FaultKind.OVERLOAD: ("overloaded", "has no input to overload"),
}
"""The member of an instrument that a fault needs, and what to say of an instrument without it."""

OF_INSTRUMENT: Final = frozenset({*_NEEDS, FaultKind.HANG})
"""The faults of the instrument itself; all others are faults of its wire."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of fault and the condition under which it strikes.

    Only commands that contain `matching`, in upper or lower case, count. The fault strikes each of them with
    `probability`, or only the `at`-th (from 1), or all if neither is stated. A fault that delays or alters
    the reply cannot strike a command without one; if the `at`-th command has no reply, it strikes the next
    reply. `instrument` is a name on the bench, empty for all.
    """

    kind: FaultKind
    probability: float | None = None
    at: int | None = None
    matching: str = ""
    seconds: float = 0.0
    error: int = _DATA_OUT_OF_RANGE
    instrument: str = ""

    def __post_init__(self) -> None:
        """Raise `ValueError` with one sentence for inconsistent settings."""
        if self.probability is not None and not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"give a probability between 0 and 1, not {self.probability:g}")
        if self.at is not None and self.at < 1:
            raise ValueError(f"count exchanges from 1; 'at' is {self.at}")
        if self.probability is not None and self.at is not None:
            raise ValueError("'probability' and 'at' exclude each other; remove one of the two")
        if self.probability is None and self.at is None and not self.matching:
            raise ValueError(f"say when '{self.kind}' strikes: give probability, at or matching")
        if not 0.0 <= self.seconds < math.inf:
            raise ValueError(f"give seconds of 0 or more, not {self.seconds:g}")
        if self.seconds and self.kind not in _TAKES_SECONDS:
            raise ValueError(f"'{self.kind}' has no duration; leave out seconds")
        if self.kind is FaultKind.LATE and not self.seconds:
            raise ValueError("state 'seconds', the delay of 'late'")

    @classmethod
    def parse(cls, data: Mapping[str, object]) -> Fault:
        """Return the fault that the mapping `data` states; numbers may be given as text.

        Raises `ValueError` with one sentence for an unknown key or kind, an invalid number or inconsistent
        settings.
        """
        unknown = sorted(set(data) - set(_KEYS))
        if unknown:
            raise ValueError(f"a fault has no {', '.join(unknown)}; it has {', '.join(_KEYS)}")
        named = str(data.get("fault", "")).replace("_", "-")
        if named not in set(FaultKind):
            raise ValueError(f"expected fault to be one of {', '.join(FaultKind)}, got '{named}'")
        if "error" in data and named != FaultKind.ERROR:
            raise ValueError(f"'{named}' puts no error into the queue; leave out error")
        error = _whole(data, "error")
        return cls(
            FaultKind(named),
            probability=_number(data, "probability"),
            at=_whole(data, "at"),
            matching=str(data.get("matching", "")),
            seconds=_number(data, "seconds") or 0.0,
            error=_DATA_OUT_OF_RANGE if error is None else error,
            instrument=str(data.get("instrument", "")),
        )

    def told(self) -> dict[str, object]:
        """Return the fault as plain data, which `parse` accepts."""
        fields: dict[str, object] = {
            "probability": self.probability,
            "at": self.at,
            "matching": self.matching or None,
            "seconds": self.seconds or None,
            "error": self.error if self.kind is FaultKind.ERROR else None,
            "instrument": self.instrument or None,
        }
        return {"fault": str(self.kind)} | {key: value for key, value in fields.items() if value is not None}


def _number(data: Mapping[str, object], key: str) -> float | None:
    """Return a number of the data, or None if the key is missing. Raises `ValueError` for an invalid number."""
    if key not in data:
        return None
    try:
        number = float(str(data[key]))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"expected {key} to be a number, got '{data[key]}'")
    return number


def _whole(data: Mapping[str, object], key: str) -> int | None:
    number = _number(data, key)
    if number is None:
        return None
    if number != round(number):
        raise ValueError(f"expected {key} to be a whole number, got '{data[key]}'")
    return round(number)


class _Armed:
    """An armed fault with its exchange count and its random generator."""

    def __init__(self, fault: Fault, generator: np.random.Generator) -> None:
        self.fault = fault
        self._generator = generator
        self._count = 0
        self._due = False

    def strikes(self, message: bytes, reply: bytes | None) -> bool:
        """Count one exchange and return whether the fault strikes it; `reply` is None if there is none (yet)."""
        fault = self.fault
        awaits_reply = fault.kind in _NEEDS_REPLY and reply is None
        if fault.matching.lower().encode("utf-8") in message.lower():
            self._count += 1
            if fault.at is not None:
                self._due |= self._count == fault.at
            elif not awaits_reply:
                self._due = fault.probability is None or self._generator.random() < fault.probability
        if not self._due or awaits_reply:
            return False
        self._due = False
        return True

    def cut(self, reply: bytes) -> WireFault:
        """Return the wire fault that keeps only the beginning of a reply, of random length."""
        return WireFault.cut(reply, int(self._generator.integers(1, max(2, len(reply)))))


class FaultyInstrument:
    """A `Dialect` with injected faults; its method `wire_fault` is the `FaultHook` of its wires.

    The random numbers depend on `seed` and `name`. `failure` is the last mistake of the simulation itself. Only one
    thread at a time may call it, as `sim.wires.session.ServedInstrument` ensures. Raises `ValueError` for a fault
    that the instrument cannot have.
    """

    def __init__(
        self, dialect: Dialect, name: str, seed: int, faults: Sequence[Fault] = (), clock: Clock | None = None
    ) -> None:
        self.dialect: Any = dialect
        self.name = name
        self._seed = seed
        self._clock = clock or SystemClock()
        self._armed: list[_Armed] = []
        self._added = 0
        self._hung_until_s: float | None = None
        self._hangs_now = False
        self.failure: BenchError | None = None
        for fault in faults:
            self.add(fault)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that are armed."""
        return tuple(armed.fault for armed in self._armed)

    @property
    def line_ends(self) -> LineEnds:
        """The line ends of the instrument."""
        return line_ends_of(self.dialect)

    def can_have(self, kind: FaultKind) -> bool:
        """Whether the instrument has the feature that a fault of this kind needs, such as a LOCAL key."""
        return kind not in _NEEDS or hasattr(self.dialect, _NEEDS[kind][0])

    def _require(self, kind: FaultKind) -> None:
        if not self.can_have(kind):
            raise ValueError(f"{self.name} {_NEEDS[kind][1]}")

    def add(self, fault: Fault) -> None:
        """Arm a fault and start its count. Raises `ValueError` if this instrument cannot have it."""
        self._require(fault.kind)
        self._armed.append(_Armed(fault, keyed_generator(self._seed, "fault", self.name, self._added)))
        self._added += 1

    def clear(self) -> None:
        """Disarm all faults and end a hang."""
        self._armed.clear()
        self._hung_until_s = None

    # --- as a dialect -------------------------------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out a message with the instrument's own faults; return None if it hangs, else its reply."""
        struck = {
            a.fault.kind: a.fault
            for a in self._armed
            if a.fault.kind in OF_INSTRUMENT and a.strikes(message, None)
        }
        if hang := struck.get(FaultKind.HANG):
            self._hung_until_s = self._clock.now_s() + hang.seconds if hang.seconds else math.inf
        if FaultKind.POWER_CYCLE in struck:
            self.power_cycle()
        self._hangs_now = self._hung_until_s is not None and self._clock.now_s() < self._hung_until_s
        if self._hangs_now:
            return None
        if FaultKind.LOCAL in struck:
            self.dialect.press_local()
        if error := struck.get(FaultKind.ERROR):
            self.dialect.report(error.error)
        overloaded = FaultKind.OVERLOAD in struck
        if overloaded:
            self.dialect.overloaded = True
        try:
            reply: bytes | None = self.dialect.handle(message, interrupted)
            if reply is not None and not isinstance(reply, bytes):
                raise TypeError(f"handle returns {reply!r}; return bytes or None")
            return reply
        except Exception as error:  # it ends the connection, which the driver reports as a lost instrument
            error.add_note(f"the simulation of {self.name} failed at {message!r}: correct it")
            what = f"{type(error).__name__}: {error}".removesuffix(": ")
            cause = f"its simulation failed at {message.decode('ascii', 'replace')} with {what}"
            self.failure = BenchError(self.name, cause, "correct the simulation")
            raise
        finally:
            if overloaded:
                self.dialect.overloaded = False

    def sent_by(self, left: Callable[[], bool]) -> None:
        """Pass `left`, which returns whether the client has disconnected, to an instrument that measures."""
        if hasattr(self.dialect, "cycle"):
            self.dialect.cycle.sent_by(left)

    def device_clear(self) -> None:
        """Abort the command in progress and end a hang."""
        self._hung_until_s = None
        self.dialect.device_clear()

    def input_overflow(self) -> None:
        """Report a message that exceeded the input buffer."""
        self.dialect.input_overflow()

    def power_cycle(self) -> None:
        """Switch the instrument off and on, which ends a hang. Raises `ValueError` if it has no power switch."""
        self._hung_until_s = None
        self._require(FaultKind.POWER_CYCLE)
        self.dialect.power_cycle()

    def press_local(self) -> None:
        """Press the LOCAL key. Raises `ValueError` if there is none."""
        self._require(FaultKind.LOCAL)
        self.dialect.press_local()

    # --- as a fault hook ----------------------------------------------------------------------------

    def wire_fault(self, message: bytes, reply: bytes | None) -> WireFault | None:
        """Return the wire fault that strikes this exchange, or None.

        Each armed wire fault counts the exchange. If several strike it, only the one armed first takes effect.
        """
        struck = [a for a in self._armed if a.fault.kind not in OF_INSTRUMENT and a.strikes(message, reply)]
        if self._hangs_now or not struck:
            return None
        fault, answer = struck[0].fault, reply or b""
        made = SILENCE
        match fault.kind:
            case FaultKind.DROP:
                made = DROP
            case FaultKind.REFUSE:
                made = WireFault(drop=True, refuse=True, refuse_s=fault.seconds)
            case FaultKind.LATE:
                made = WireFault(lines=(answer,), delay_s=fault.seconds)
            case FaultKind.TWICE:
                made = WireFault(lines=(answer, answer))
            case FaultKind.CUT:
                made = struck[0].cut(answer)
            case FaultKind.GARBLE:
                made = WireFault.garble(answer)
        return made
