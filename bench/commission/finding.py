"""What one check of one instrument found: how it is, the figures behind it, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Final


class State(StrEnum):
    """How an instrument did in one check."""

    WORKS = "works"
    SLOWER = "slower"
    """It works, but later than its driver expects."""
    OTHER = "other"
    """It answers, otherwise than its driver or its data sheet has it."""
    COULD_NOT = "could not"
    """The check could not be carried out."""
    SKIPPED = "skipped"
    """The person left it out; the reason is on record."""


DONE, NOT_AS_EXPECTED, NOT_DONE = 0, 1, 2
"""Exit status by the worst that was found."""

_STATUS: Final = {State.SLOWER: NOT_AS_EXPECTED, State.OTHER: NOT_AS_EXPECTED, State.COULD_NOT: NOT_DONE}


@dataclass(frozen=True, slots=True)
class Figure:
    """A number that was measured, in `unit`, and in words what it was held against."""

    what: str
    value: float
    unit: str
    expected: str = ""

    @property
    def text(self) -> str:
        """The figure as a person reads it."""
        held = f" ({self.expected})" if self.expected else ""
        return f"{self.what} {self.value:.4g} {self.unit}".rstrip() + held


@dataclass(frozen=True, slots=True)
class Finding:
    """One check of one instrument; `said` is a clause without its name, `remedy` what is to be done."""

    check: str
    instrument: str
    state: State
    said: str
    figures: tuple[Figure, ...] = ()
    remedy: str = ""

    @property
    def sentence(self) -> str:
        """What was found, in one line."""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.instrument}: {self.check}: {self.said}{remedy}"

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "check": self.check,
            "instrument": self.instrument,
            "state": self.state.value,
            "said": self.said,
            "figures": [asdict(figure) for figure in self.figures],
            "remedy": self.remedy,
        }


def status_of(findings: Sequence[Finding], *, whole: bool) -> int:
    """Return the exit status: 2 where something could not be done or it was not gone through whole, 1, or 0."""
    if not whole or not findings:
        return NOT_DONE
    return max(_STATUS.get(finding.state, DONE) for finding in findings)
