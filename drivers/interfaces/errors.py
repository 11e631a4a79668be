"""How an instrument or a person fails: one sentence with place, cause and what to do."""

from __future__ import annotations

from collections.abc import Sequence


class BenchError(Exception):
    """Something went wrong that a person can do something about.

    `instrument` is the name on the bench ("voltmeter.x"), `cause` what happened, `remedy` what to do.
    The text is one sentence with all three.
    """

    def __init__(self, instrument: str, cause: str, remedy: str) -> None:
        super().__init__(f"{instrument}: {cause}; {remedy}")
        self.instrument = instrument
        self.cause = cause
        self.remedy = remedy


class InstrumentLost(BenchError):
    """The instrument does not answer: absent, refused, cut off, or silent past its timeout."""


class InstrumentRefused(BenchError):
    """The instrument answered, and said no: wrong identity, an error in its queue, a setting not taken."""


class BadReading(BenchError):
    """An answer that is not a reading: overload, a cut or garbled reply."""


class LimitExceeded(BenchError):
    """A demand outside what the instrument or the unit under test may be given."""


class WentAstray(BenchError):
    """A head that did not go where it was sent. It was stopped, and is not to be sent again before it is mended."""


class NotConnected(BenchError):
    """One or more instruments could not be opened; `failures` holds all of them."""

    def __init__(self, failures: Sequence[BenchError]) -> None:
        self.failures = tuple(failures)
        super().__init__(
            ", ".join(f.instrument for f in failures),
            "not connected: " + " | ".join(str(f) for f in failures),
            "mend these and start again",
        )


class NoAnswer(BenchError):
    """The person (or the script that stands for one) gave no answer to a prompt."""
