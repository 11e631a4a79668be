"""The register of persons of a laboratory: who may do what, and who changed it."""

from __future__ import annotations

from pydantic import Field
from rich.console import Console

from bench.base.result_model import ResultModel
from bench.base.tables import table


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


class PersonsResult(ResultModel):
    """The persons of a laboratory: `bench persons`."""

    register_: str = Field(alias="register", description="folder of the register")
    head: str = Field(description="SHA-256 of the last line, which depends on all lines before it")
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
