"""Commands that make the bench safe: each is attempted, and a failure is reported with its manual remedy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from drivers.interfaces import BenchError, Instrument, InstrumentLost, InstrumentRefused, message

SEE_IT_STANDS: Final = message("check that it stands still, and if not, press its emergency stop")
"""The manual remedy for a head whose stop failed."""
STAYS_REMOTE: Final = message("its front panel stays in remote: press its local key")
"""The manual remedy for an instrument that did not return to local control."""


class Attempts:
    """A series of attempts to make the bench safe; a failed attempt does not prevent the next.

    If Ctrl-C or another interruption arrives during an attempt, `end` raises it after all attempts.
    """

    def __init__(self) -> None:
        self._told: list[str] = []
        self._failures: list[BaseException] = []

    def make(self, by_hand: str, action: Callable[[], object]) -> bool:
        """Carry out an action and return whether it succeeded; `by_hand` tells a person what to do if it failed.

        If the action returns text, as `Instrument.close` may, the text is another task for a person.
        """
        try:
            left = action()
        except BaseException as error:
            self._failures.append(error)
            cause = message(f"Cause: {why_failed(error)}")
            self._told.append(f"{by_hand}. {cause}")
            return False
        if isinstance(left, str) and left:
            self._told.append(left)
        return True

    def end(self) -> str:
        """Return what a person must still do, or an empty string if nothing.

        Raises the first interruption (such as Ctrl-C) that arrived during an attempt.
        """
        for error in self._failures:
            if not isinstance(error, Exception):
                raise error
        return "; ".join(self._told)

    def refuse_failed(self, name: str, what: str, remedy: str) -> None:
        """Raise an error of the instrument `name` if an attempt failed; `what` says what failed.

        The error states all causes and the `remedy`. It is `InstrumentLost` if every attempt failed with
        `InstrumentLost`, else `InstrumentRefused`. An interruption (Ctrl-C) is raised instead, as by `end`.
        """
        self.end()
        if self._failures:
            lost = all(isinstance(error, InstrumentLost) for error in self._failures)
            causes = " | ".join(why_failed(error) for error in self._failures)
            raise (InstrumentLost if lost else InstrumentRefused)(name, f"{what}: {causes}", remedy)


def let_go(instrument: Instrument) -> str:
    """Close an instrument; return what a person must still do, or an empty string if nothing."""
    attempts = Attempts()
    attempts.make(
        message("could not be released: check that it stands still, then switch it off and on"),
        instrument.close,
    )
    return attempts.end()


def why_failed(error: BaseException) -> str:
    """Return the cause of a failure in words; any error but a `BenchError` is reported as a driver's failure."""
    if isinstance(error, BenchError):
        return error.cause
    return message(f"its driver failed with {type(error).__name__}: {error}")
