"""The registers of a laboratory: its persons, and the failures of its runs (ISO/IEC 17025:2017, 7.11.3)."""

from __future__ import annotations

from collections import Counter

from pydantic import Field
from rich.console import Console

from bench.base.result_model import ResultModel
from bench.base.tables import table


class RegisterResult(ResultModel):
    """The members that the results of all registers have."""

    register_: str = Field(alias="register", description="folder of the register")
    head: str = Field(description="SHA-256 of the last line, which depends on all lines before it")


# --- persons ------------------------------------------------------------------------------------------


class PersonPart(ResultModel):
    """A person of the laboratory."""

    name: str
    role: str
    may: list[str] = Field(description="rights: operate, supervise, authorise, administer")
    has_token: bool
    public_key: str = Field(description="public key (PEM); empty if there is none")
    since: str = Field(description="civil time of the last change")
    ended: str = Field(description="civil time at which the person's rights ended; empty if they have not")


class PersonChange(ResultModel):
    """A line of the register: a change of a person by an administrator."""

    time: str
    kind: str = Field(description="`added`, `changed` or `ended`")
    name: str
    by: str = Field(description="administrator who made the change")
    reason: str
    role: str | None
    may: list[str] | None


class PersonsResult(RegisterResult):
    """The persons of a laboratory: `bench persons`."""

    token: str | None = Field(description="new token of the person, shown only once")
    persons: list[PersonPart]
    changes: list[PersonChange]

    def print_on(self, out: Console) -> None:
        """Print a line for each person, the head of the chain, and a new token."""
        shown = table("name", "role", "may", "proves by", "ended")
        for one in self.persons:
            proofs = ", ".join(["token"] * one.has_token + ["key"] * bool(one.public_key))
            shown.add_row(one.name, one.role, ", ".join(one.may), proofs, one.ended[:10])
        out.print(shown if self.persons else "no register of persons: operators are free text")
        out.print(f"{len(self.changes)} changes, chain of hashes whole, head {self.head}")
        if self.token is not None:
            out.print(f"the token, shown only now: {self.token}", soft_wrap=True)


# --- failures -----------------------------------------------------------------------------------------


class NotedRemedy(ResultModel):
    """The remedy for a failure, as a person noted it."""

    time: str
    by: str
    state: str
    remedy: str = Field(description="cause and remedy, in words")


class Failure(ResultModel):
    """A failure that the record of a run states, or a failed validation."""

    number: str
    run: str = Field(description="name of the run; for a validation, of its folder")
    event: int = Field(description="number of the event in the record; 0 if the record cannot be read")
    time: str = Field(description="civil time of the event")
    kind: str = Field(description="type of the event, `damaged` or `validation`")
    said: str = Field(description="the event as a sentence")
    simulated: bool
    state: str = Field(description="open, remedied or closed")
    noted: list[NotedRemedy]


class FailuresResult(RegisterResult):
    """The failures of a laboratory, of one year or of all years: `bench failures`."""

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
    from bench.results.tables import page  # takes long to import

    return page(
        "failures.html.j2", result=result, counts=result.counts(), states=("open", "remedied", "closed")
    )
