"""The registers of a laboratory: persons, failures of runs (ISO/IEC 17025:2017, 7.11.3), and validations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import groupby
from typing import Final, Literal

from pydantic import Field
from rich.console import Console

from bench.base.languages import HEADING, message, translated
from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.results.tables import page


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


# --- validations -----------------------------------------------------------------------------------------


NOT_PROVEN: Final = (
    message(
        "that real instruments do as simulated ones: 'bench instruments --commission' and certificates show it"
    ),
    message(
        "that the block, the head and the stand are as the bench file states: the check block and the budget do"
    ),
    message("that the clock is right: no time server was asked"),
    message(
        "that nobody changed a package's files later: 'require_validation: true' compares the program's "
        "files and the packages' lists of files"
    ),
    message(
        "that the laboratory's method suits the customer's purpose (7.2.2): that is the laboratory's judgement"
    ),
    message("that the random parts would pass with every seed: their seeds are fixed"),
)
"""Properties that no validation of a program proves."""


class ValidationCheck(ResultModel):
    """One check: the clause of ISO/IEC 17025:2017, what was done, expected and found."""

    name: str
    family: str
    clause: str
    did: str = Field(description="what was tested")
    source: str = Field(description="source of the expected value; empty if it is this program")
    expected: str
    found: str
    passed: bool
    where: str = Field(description="where the failure is; empty if the check passed")
    change: bool = Field(description="whether the failure is a change that a person may accept")
    took_s: float


class PackagePart(ResultModel):
    """An installed package."""

    version: str
    sha256: str = Field(description="SHA-256 of the package's list of files with their hashes (RECORD)")


class ProgramFingerprint(ResultModel):
    """The program, packages and Python that a validation covers; any change requires a new validation."""

    fingerprint: str = Field(description="SHA-256 of all other members")
    version: str
    python: str
    platform: str
    files: dict[str, str] = Field(description="SHA-256 of each file of the program, by path")
    packages: dict[str, PackagePart]


class ValidatedBench(ResultModel):
    """The bench file of a validation, and the laboratory's own drivers and effects for it."""

    name: str
    file: str
    sha256: str
    plug_ins: dict[str, str] = Field(
        {}, description="SHA-256 of each of your own drivers and effects, by path"
    )


class ChangedRun(ResultModel):
    """A past run whose recomputed coefficients, or their u, differ from the stored ones."""

    run: str
    largest_change_in_u: float
    largest_change_of: str = Field(description="coefficient with the largest change; `u` if that is its u")
    verdict_stored: str | None
    verdict: str | None


class AgainstPart(ResultModel):
    """Past runs whose results were computed again and compared with the stored results."""

    over: list[str]
    runs: int
    compared: int = Field(description="number of runs with a stored result")
    threshold_u: float = Field(description="largest change that is not listed, in units of u")
    changed: list[ChangedRun]
    failed: dict[str, str] = Field(description="reason for each run that could not be computed")


class ValidationResult(ResultModel):
    """The result of `bench validate`; `passed` is true if all checks passed, those on changes included."""

    passed: bool
    quick: bool
    began: str = Field(description="civil time of the start, with the offset from UTC")
    took_s: float
    cpu_s: float
    false_alarm: float = Field(description="highest probability that a correct program fails by chance")
    program: ProgramFingerprint
    bench: ValidatedBench
    machine: dict[str, str]
    checks: list[ValidationCheck]
    against: AgainstPart | None
    not_proven: list[str]
    accepted_before: str
    """number of the accepted validation with which this one was compared"""
    failure: str = Field("", description="number of a failed validation in the register of failures")
    files: list[str] = Field([], description="files that were written")

    @property
    def failed(self) -> list[ValidationCheck]:
        """The failed checks, except those that report a change, because a person may accept the change."""
        return [one for one in self.checks if not one.passed and not one.change]

    @property
    def changes(self) -> list[ValidationCheck]:
        """The checks that report a change, which a person must still accept."""
        return [one for one in self.checks if not one.passed and one.change]

    @property
    def headline(self) -> str:
        """The outcome in one line."""
        count = len(self.checks)
        if self.failed:
            return message(f"NOT VALID: {len(self.failed)} of {count} checks failed")
        if self.changes:
            return message(
                f"CHANGED: {len(self.changes)} of {count} checks changed, and an authorised person must "
                "accept them; all others passed"
            )
        return message(
            f"PASSED: all {count} checks; it becomes a validation when an authorised person accepts it"
        )

    def print_on(self, out: Console) -> None:
        """Print the number of passed checks by family, the checks that failed or changed, and the outcome."""
        for family, rows in families(self.checks):
            good = sum(row.passed for row in rows)
            out.print(f"{translated(family, HEADING)}: {good} of {len(rows)} passed")
        bad = [*self.failed, *self.changes]
        if bad:
            shown = table("not as expected", "clause", "expected", "found", "where")
            for row in bad:
                shown.add_row(row.name, row.clause, row.expected, row.found, row.where)
            out.print(shown)
        if self.against is not None:
            self._print_against(self.against, out)
        out.print(self.headline, style="bold")
        if self.failure:
            out.print(f"in the register of failures: {self.failure}")
        for file in self.files:
            out.print(f"  {file}")
        if self.files and not any(file.endswith(".pdf") for file in self.files):
            out.print("no PDF: typst is not installed; pip install 'triaxial-bench[certificate]'")

    @staticmethod
    def _print_against(against: AgainstPart, out: Console) -> None:
        out.print(
            f"{against.runs} past runs computed again, {against.compared} with a stored result: "
            f"{len(against.changed)} changed by more than {against.threshold_u:g} u"
        )
        shown = table("run", ">largest change", "in", "verdict stored", "now")
        for one in against.changed:
            shown.add_row(
                one.run, f"{one.largest_change_in_u:.2g} u", one.largest_change_of,
                one.verdict_stored or "", one.verdict or "",
            )  # fmt: skip
        if against.changed:
            out.print(shown)


def families(checks: Iterable[ValidationCheck]) -> list[tuple[str, list[ValidationCheck]]]:
    """Return each family of checks with its checks, in order."""
    return [(family, list(rows)) for family, rows in groupby(checks, key=lambda row: row.family)]


def acts(rows: Iterable[ValidationCheck]) -> list[tuple[str, list[ValidationCheck]]]:
    """Return each sentence on what was tested, with the checks in `rows` that it describes, in order."""
    return [(did, list(own)) for did, own in groupby(rows, key=lambda row: row.did)]


def clauses(checks: Iterable[ValidationCheck]) -> list[tuple[str, int, int]]:
    """Return each clause with the number of its checks and of those passed, in the order of the standard."""
    ordered = sorted(checks, key=lambda row: [int(part) for part in row.clause.split(".")])
    found = []
    for clause, rows in groupby(ordered, key=lambda row: row.clause):
        listed = list(rows)
        found.append((clause, len(listed), sum(row.passed for row in listed)))
    return found


def render_validation(result: ValidationResult) -> str:
    """Return the HTML page of a validation; the same result always gives the same text."""
    return page(
        "validation.html.j2",
        result=result,
        look="failed" if result.failed else "conditional" if result.changes else "passed",
        families=[(family, acts(rows)) for family, rows in families(result.checks)],
        clauses=clauses(result.checks),
    )


# --- the register of validations -----------------------------------------------------------------------


class RegisteredValidation(ResultModel):
    """An entry of the register of validations."""

    number: str
    kind: Literal["accepted", "withdrawn"]
    time: str
    by: str
    role: str | None
    reason: str
    fingerprint: str
    bench: str
    bench_sha256: str
    result_sha256: str = Field(description="SHA-256 of the stored result")
    holds: bool
    """whether it is the latest for its program and bench file and was not withdrawn"""
    quick: bool = False
    """whether it was a shortened validation; False for entries of programs that did not note it"""


class ValidationRegisterResult(RegisterResult):
    """The validations of a laboratory (`bench validate --register`), or the one that was just accepted."""

    validations: list[RegisteredValidation]

    def print_on(self, out: Console) -> None:
        """Print a line for each entry, and the head of the chain."""
        for one in self.validations:
            state = f"{', quick' if one.quick else ''}{'' if one.holds else ', holds no longer'}"
            out.print(
                f"{one.number}  {one.time[:16]}  {one.kind} by {one.by}: {one.reason} ({one.bench}{state})"
            )
        out.print(f"{len(self.validations)} entries, chain of hashes whole, head {self.head}")
