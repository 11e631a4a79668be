"""A rate table with an ACUTROL controller as dividing head: commands over TCP, degrees in plain text.

Every command is answered: a prefix of eight characters, then OK or a number. There is no query for "in
position": position and rate are polled. Sources: the public ACUTROL client of the maker's robotics group
(`acutrol.py`, `ac117.json`); commands `:utility`, `:interlock`, `:mode`, `:demand`, `:read`.
"""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Final

from drivers.interfaces import Direction, HeadPosition, Identity, InstrumentRefused
from drivers.motion import Mover, Travel
from drivers.wire.proving import ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

PORT: Final = 9888
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"

_PREFIX_CHARACTERS: Final = 8
_PREFIX: Final = r"[\x20-\x7e]{8}"
_ANY: Final = rf"{_PREFIX}[\x20-\x7e]*"
_NUMBER: Final = rf"{_PREFIX} *[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)? *"
_STARTUP_GAP_S: Final = 0.25
_MODE_GAP_S: Final = 0.5
_FINEST_DEG: Final = 0.001
"""The controller takes demands with three decimals."""


class AcutrolHead:
    """A `DividingHead` on one axis of an ACUTROL.

    `still_rad_s` is the rate below which the table stands. The speed of a move is the controller's own:
    the travel's only says how long a move may take. An angle is sent to the nearest 0.001°. Raises
    `ValueError` when the tolerance is finer than that.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        travel: Travel,
        *,
        axis: int = 1,
        still_rad_s: float = math.radians(0.005),
    ) -> None:
        if math.degrees(travel.tolerance_rad) < _FINEST_DEG / 2.0:
            raise ValueError(
                "the tolerance of the head is finer than the 0.0005° to which a demand is rounded"
            )
        self.name = name
        self._session = ProvedSession(session, clock, self._prove)
        self._clock = clock
        self._mover = Mover(name, self, travel, clock)
        self._axis = axis
        self._still_rad_s = still_rad_s
        self._positioning = False

    # --- the head -----------------------------------------------------------------------------------

    def open(self) -> Identity:
        """Connect, take the lockout, go through the interlock; the table is powered, nothing moves.

        The controller has no identity to ask for: what proves it is the form of its replies.
        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._positioning = False
        self._session.open()
        self._session.repeating(self._start_up)
        return Identity("Acutronic", "ACUTROL")

    def close(self) -> None:
        """Stop at rate 0, switch the axis off, open the interlock. Never raises, may be called twice."""
        if self._session.opened:
            with contextlib.suppress(Exception):
                self.stop()
                self._tell(f":mode:off {self._axis}", urgent=True)
                self._tell(f":interlock:open {self._axis}", urgent=True)
        self._session.close()

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad` from the demanded side; return the angle read back.

        Raises `LimitExceeded` before anything is sent, `InstrumentRefused` for a refused command or a
        table that does not arrive, `InstrumentLost`, `BadReading`. The motion is stopped then.
        """
        return self._mover.move(target_rad, direction)

    # --- the axis -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Enter the position mode, demanding first where the table stands: an old demand would move it."""
        self._session.repeating(self._session.ensure_proved)
        if not self._positioning:
            self._demand(self.position_rad())
            self._tell(f":mode:position {self._axis}")
            self._clock.sleep(_MODE_GAP_S)
            self._positioning = True

    def position_rad(self) -> float:
        """Return the angle read back, rad."""
        return math.radians(self._read("position"))

    def start(self, target_rad: float) -> None:
        """Demand an angle, to the nearest 0.001°."""
        self._demand(target_rad)

    def moving(self) -> bool:
        """Whether the table turns faster than it may when it stands."""
        return abs(math.radians(self._read("rate"))) > self._still_rad_s

    def stop(self) -> None:
        """Hold the table still: rate mode at rate 0."""
        self._positioning = False
        self._tell(f":demand:rate {self._axis}, {_degrees(0.0)}", urgent=True)
        self._tell(f":mode:rate {self._axis}", urgent=True)

    # --- messages -----------------------------------------------------------------------------------

    def _start_up(self) -> None:
        """The maker's start-up sequence; the controller wants a quarter of a second after each.

        Not repeated over a connection made anew: opening the interlock would halt a table that moves, and a
        controller that was switched off meanwhile refuses to position.
        """
        for command in (
            ":utility:lockout on",
            f":interlock:open {self._axis}",
            f":interlock:reset {self._axis}",
            f":interlock:close {self._axis}",
        ):
            self._tell(command)
            self._clock.sleep(_STARTUP_GAP_S)

    def _prove(self) -> None:
        """A controller is known by the form of its answer."""
        self._read("position")

    def _demand(self, angle_rad: float) -> None:
        self._tell(f":demand:position {self._axis}, {_degrees(angle_rad)}")

    def _read(self, what: str) -> float:
        reply = self._session.ask(
            f":read:{what} {self._axis}", _NUMBER, f"a prefix of {_PREFIX_CHARACTERS} characters and a number"
        )
        return float(reply[_PREFIX_CHARACTERS:])

    def _tell(self, command: str, urgent: bool = False) -> None:
        """Send a command. Raises `InstrumentRefused` for any answer but OK."""
        send = self._session.urgent if urgent else self._session.command
        reply = send(command, _ANY, f"a prefix of {_PREFIX_CHARACTERS} characters and OK")
        answer = reply[_PREFIX_CHARACTERS:].strip()
        if answer.upper() != "OK":
            raise InstrumentRefused(
                self.name,
                f"the controller answers {command} with {answer!r}, not OK",
                "check the interlock, the emergency stop and the controller's own display",
            )


def _degrees(angle_rad: float) -> str:
    """Format an angle or rate as the controller takes it: "045.000", "-010.500"."""
    degrees = round(math.degrees(angle_rad), 3)
    return f"{'-' if degrees < 0.0 else ''}{abs(degrees):07.3f}"
