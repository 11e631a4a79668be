"""The register of failures (ISO/IEC 17025:2017, 7.11.3): its entries, and the page of a year for the review."""

from __future__ import annotations

from collections import Counter

from pydantic import Field
from rich.console import Console

from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.results.tables import page


class NotedRemedy(ResultModel):
    """The remedy for a failure, as a person noted it."""

    time: str
    by: str
    state: str
    remedy: str = Field(description="cause and remedy, in words")


class Failure(ResultModel):
    """A failure that the record of a run states."""

    number: str
    run: str
    event: int = Field(description="number of the event in the record; 0 if the record cannot be read")
    time: str = Field(description="civil time of the event")
    kind: str = Field(description="type of the event, or `damaged`")
    said: str = Field(description="the event as a sentence")
    simulated: bool
    state: str = Field(description="open, remedied or closed")
    noted: list[NotedRemedy]


class FailuresResult(ResultModel):
    """The failures of a laboratory, of one year or of all years: `bench failures`."""

    register_: str = Field(alias="register", description="folder of the register")
    head: str = Field(description="SHA-256 of the last line, which depends on all lines before it")
    year: int | None
    collected: int = Field(description="failures newly found in the records")
    failures: list[Failure]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the number of failures by kind, then by state."""
        kinds: dict[str, Counter[str]] = {}
        for one in self.failures:
            kinds.setdefault(one.kind, Counter())[one.state] += 1
        return {kind: dict(states) for kind, states in sorted(kinds.items())}

    def print_on(self, out: Console) -> None:
        """Print a line for each failure that is not closed, and the counts."""
        left = [one for one in self.failures if one.state != "closed"]
        if left:
            shown = table("number", "time", "run", "kind", "state", "what")
            for one in left:
                shown.add_row(one.number, one.time[:16], one.run, one.kind, one.state, one.said)
            out.print(shown)
        out.print(
            f"{len(self.failures)} failures, {self.collected} of them new; {len(left)} not closed; chain of hashes "
            f"whole, head {self.head}"
        )


def render_failures(result: FailuresResult) -> str:
    """Return the HTML page of the failures; the same result always gives the same text."""
    return page(
        "failures.html.j2", result=result, counts=result.counts(), states=("open", "remedied", "closed")
    )
