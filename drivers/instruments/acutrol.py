"""A rate table with an ACUTROL controller as dividing head: commands over TCP, degrees in plain text.

Every command has a reply: a prefix of eight characters, then OK or a number. There is no query for "in
position": position and rate are polled. Commands `:utility`, `:interlock`, `:mode`, `:demand`, `:read`.
Sources: see `drivers.facts.acutrol`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final

from drivers.facts import acutrol as facts
from drivers.interfaces import Identity, InstrumentRefused, message
from drivers.making_safe import SEE_IT_STANDS, Attempts
from drivers.motion import MotorisedHead, Travel

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_PREFIX: Final = rf"[\x20-\x7e]{{{facts.PREFIX_CHARACTERS}}}"
_ANY: Final = rf"{_PREFIX}[\x20-\x7e]*"
_NUMBER: Final = rf"{_PREFIX} *[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)? *"


class AcutrolHead(MotorisedHead):
    """A `DividingHead` on one axis of an ACUTROL.

    A table slower than `still_rad_s` counts as at rest. The controller determines the speed of a move; the
    driver uses the speed in `travel` only to detect a stalled or overlong move. Angles are sent rounded to
    0.001°. Raises `ValueError` if the tolerance is less than the rounding error, 0.0005°.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        travel: Travel,
        *,
        axis: int = 1,
        still_rad_s: float = math.radians(facts.STILL_DEG_S),
    ) -> None:
        if math.degrees(travel.tolerance_rad) < facts.FINEST_DEMAND_DEG:
            raise ValueError(
                f"rounding changes a demand by up to {facts.FINEST_DEMAND_DEG:g}°, more than the tolerance of "
                "the head; widen the tolerance"
            )
        super().__init__(name, session, clock, travel, identity=Identity(facts.MAKER, facts.MODEL))
        self._axis = axis
        self._still_rad_s = still_rad_s
        self._positioning = False

    # --- the head -----------------------------------------------------------------------------------

    def open(self) -> Identity:
        """Connect, switch the controller's lockout on, then open, reset and close the interlock.

        The table is then powered but does not move. The controller has no identity query: the format of its
        replies identifies it. Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._positioning = False
        super().open()
        self._session.repeating(self._start_up)
        return self._identity

    def _release(self, attempts: Attempts) -> None:
        """Switch the axis off and open the interlock, after the table was set to rate 0."""
        attempts.make(message("switch its axis off at the controller"), self._switch_off)
        attempts.make(
            message("open its interlock at the controller"),
            partial(self._tell, f":interlock:open {self._axis}", urgent=True),
        )

    # --- the axis -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Enter the position mode; first demand the present angle, because an old demand would move the table."""
        self._session.repeating(self._session.ensure_proved)
        if not self._positioning:
            self._demand(self.position_rad())
            self._tell(f":mode:position {self._axis}")
            self._clock.sleep(facts.MODE_GAP_S)
            self._positioning = True

    def position_rad(self) -> float:
        """Return the table's angle, read from the controller, rad."""
        return math.radians(self._read("position"))

    def start(self, target_rad: float) -> None:
        """Begin to move to an angle, rounded to 0.001°."""
        self._demand(target_rad)

    def moving(self) -> bool:
        """Return whether the table turns faster than `still_rad_s`."""
        return abs(math.radians(self._read("rate"))) > self._still_rad_s

    def stop(self) -> None:
        """Stop the table by rate mode at rate 0; if the controller refuses, switch the axis off.

        The driver demands rate 0 before it enters the rate mode: a rate demanded earlier would turn the table.
        Raises `InstrumentRefused` or `InstrumentLost` unless rate 0 was accepted.
        """
        self._positioning = False
        attempts = Attempts()
        rate_0 = partial(self._tell, f":demand:rate {self._axis}, {_degrees(0.0)}", urgent=True)
        rate_mode = partial(self._tell, f":mode:rate {self._axis}", urgent=True)
        if not (attempts.make("", rate_0) and attempts.make("", rate_mode)):
            attempts.make("", self._switch_off)
        attempts.refuse_failed(
            self.name,
            message("it did not accept rate 0, so the driver sent the command to switch its axis off"),
            SEE_IT_STANDS,
        )

    # --- messages -----------------------------------------------------------------------------------

    def _switch_off(self) -> None:
        self._tell(f":mode:off {self._axis}", urgent=True)

    def _start_up(self) -> None:
        """Send the maker's start-up sequence, with a pause of a quarter of a second after each command.

        It is not repeated after a later reconnection: opening the interlock would halt a moving table, and a
        controller that was switched off in the meantime refuses to position.
        """
        for command in (
            ":utility:lockout on",
            f":interlock:open {self._axis}",
            f":interlock:reset {self._axis}",
            f":interlock:close {self._axis}",
        ):
            self._tell(command)
            self._clock.sleep(facts.STARTUP_GAP_S)

    def _prove(self) -> None:
        """Identify the controller by the format of a reply."""
        self._read("position")

    def _demand(self, angle_rad: float) -> None:
        self._tell(f":demand:position {self._axis}, {_degrees(angle_rad)}")

    def _read(self, what: str) -> float:
        reply = self._session.ask(
            f":read:{what} {self._axis}",
            _NUMBER,
            message(f"a prefix of {facts.PREFIX_CHARACTERS} characters and a number"),
        )
        return float(reply[facts.PREFIX_CHARACTERS :])

    def _tell(self, command: str, urgent: bool = False) -> None:
        """Send a command. Raises `InstrumentRefused` for any reply but OK."""
        send = self._session.urgent if urgent else self._session.command
        reply = send(command, _ANY, message(f"a prefix of {facts.PREFIX_CHARACTERS} characters and OK"))
        answer = reply[facts.PREFIX_CHARACTERS :].strip()
        if answer.upper() != "OK":
            raise InstrumentRefused(
                self.name,
                f"the controller answers {command} with {answer!r}, not OK",
                "check the interlock, the emergency stop and the controller's own display",
            )


def _degrees(angle_rad: float) -> str:
    """Return an angle (rad) or rate (rad/s) in degrees, in the controller's format: "045.000", "-010.500"."""
    degrees = round(math.degrees(angle_rad), facts.DEMAND_DECIMALS)
    return f"{'-' if degrees < 0.0 else ''}{abs(degrees):07.{facts.DEMAND_DECIMALS}f}"
