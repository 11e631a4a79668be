"""Commands that make the bench safe: each is attempted separately; a failure is reported with its manual remedy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from drivers.interfaces import BenchError, Instrument, InstrumentLost, InstrumentRefused

SEE_IT_STANDS: Final = "see that it stands, and press its emergency stop where it does not"
"""What a person does about a head whose stop failed."""
STAYS_REMOTE: Final = "its front panel stays in remote: press its local key"
"""What a person does about an instrument that was not given back."""


class Attempts:
    """Attempts to make something safe, none of which keeps the next from being made.

    What interrupts one, such as Ctrl-C, is raised by `end` after the others were made.
    """

    def __init__(self) -> None:
        self._told: list[str] = []
        self._failures: list[BaseException] = []

    def make(self, by_hand: str, action: Callable[[], object]) -> bool:
        """Carry out an action and return whether it succeeded; `by_hand` is what a person must do where it failed.

        An action that returns text says what it leaves for a person to do, as `Instrument.close` does.
        """
        try:
            left = action()
        except BaseException as error:
            self._failures.append(error)
            self._told.append(f"{by_hand} ({why_failed(error)})")
            return False
        if isinstance(left, str) and left:
            self._told.append(left)
        return True

    def end(self) -> str:
        """Return what a person must still do, empty for nothing. Raises what interrupted an attempt."""
        for error in self._failures:
            if not isinstance(error, Exception):
                raise error
        return "; ".join(self._told)

    def refuse_failed(self, name: str, what: str, remedy: str) -> None:
        """Raise one error with the cause of every attempt that failed: `InstrumentLost` where all were lost."""
        if self.end():
            lost = all(isinstance(error, InstrumentLost) for error in self._failures)
            causes = " | ".join(why_failed(error) for error in self._failures)
            raise (InstrumentLost if lost else InstrumentRefused)(name, f"{what}: {causes}", remedy)


def let_go(instrument: Instrument) -> str:
    """Close an instrument; return what a person must still do, empty for nothing."""
    attempts = Attempts()
    attempts.make("could not be let go: see that it stands and switch it off and on", instrument.close)
    return attempts.end()


def why_failed(error: BaseException) -> str:
    """Return the cause of a failure; a driver's own mistake by its name."""
    if isinstance(error, BenchError):
        return error.cause
    return f"its driver failed with {type(error).__name__}: {error}"
