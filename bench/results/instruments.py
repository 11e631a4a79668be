"""Results of `bench instruments`, of a commissioning with its page, and where simulated instruments listen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pydantic import Field
from rich.console import Console

from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.results.template import page
from bench.run.commission.session import Finding
from bench.run.instruments import same_serials
from drivers.interfaces import Identity

# --- looked at --------------------------------------------------------------------------------------


class FailurePart(ResultModel):
    """Something that is wrong with an instrument."""

    cause: str
    remedy: str


class InstrumentPart(ResultModel):
    """An instrument that was opened, tested and read."""

    name: str
    address: str
    identity: Identity | None
    settings: str
    self_test: str
    value: dict[str, float] | float | None = Field(description="V by channel or output, rad, or °C")
    shows: str
    failures: list[FailurePart]


class InstrumentsResult(ResultModel):
    """Every instrument of a bench: who answers, what is wrong."""

    bench: str
    passed: bool
    instruments: list[InstrumentPart]

    def print_on(self, out: Console) -> None:
        """Print a line for each instrument, and how many of them respond without a fault."""
        shown = table()
        for heading in ("instrument", "address", "identity", "settings", "self-test", "shows"):
            # an address is copied from the table, so it must not be broken
            whole = heading in {"instrument", "address", "self-test"}
            shown.add_column(heading, overflow="fold", no_wrap=whole)
        for one in self.instruments:
            tested = one.self_test in ("", "none", "manual", "passed")
            unread = one.identity is not None and bool(one.failures) and not one.shows
            identity = "NOT OPENED" if one.identity is None else str(one.identity)
            test, shows = one.self_test if tested else "FAILED", "FAILED" if unread else one.shows
            shown.add_row(one.name, one.address, identity, one.settings, test, shows)
        out.print(shown)
        identities = {one.name: one.identity for one in self.instruments if one.identity is not None}
        for words in same_serials(identities):
            out.print(f"note: {words}")
        well = sum(not one.failures for one in self.instruments)
        out.print(f"{well} of {len(self.instruments)} instruments are well")


# --- commissioned -----------------------------------------------------------------------------------

VERDICTS: Final = {
    0: ("passed", "✓ All that was tried works as expected"),
    1: ("none", "Something is slower or other than expected"),
    2: ("failed", "✗ Something could not be done"),
}
"""By exit status: how the page looks, and what it says."""


class CommissionedPart(ResultModel):
    """An instrument of the bench."""

    name: str
    address: str
    identity: str | None


class CommissionResult(ResultModel):
    """What a first evening with the instruments of a bench found, check by check."""

    bench: str
    bench_file: str
    simulated: bool = Field(description="whether it was the simulated bench")
    began: str = Field(description="UTC, ISO 8601")
    took_s: float = Field(description="by the clock of the bench")
    status: int = Field(
        ge=0,
        le=2,
        description="0: all that was tried works; 1: something is slower or other; 2: something could not be done",
    )
    ended: str = Field(description="reason for early termination; empty where every check was reached")
    instruments: list[CommissionedPart]
    findings: list[Finding]
    to_do: dict[str, str] = Field(description="what a person must still do, by instrument")
    wire_log: str = Field(description="file beside the result")
    versions: dict[str, str] = Field(description="of the program and its libraries")


def render_commissioning(result: Mapping[str, Any]) -> str:
    """Return the page of a commissioning, from its result as JSON has it; the same result gives the same text."""
    findings = result["findings"]
    look, word = VERDICTS[result["status"]]
    return page(
        "commissioning.html.j2",
        result=result,
        look=look,
        word=word,
        troubles=[one for one in findings if one["state"] not in ("works", "skipped")],
        skipped=[one for one in findings if one["state"] == "skipped"],
        rows=[(one, [_shown(figure) for figure in one["figures"]]) for one in findings],
    )


def _shown(figure: Mapping[str, Any]) -> str:
    held = f" ({figure['expected']})" if figure["expected"] else ""
    return f"{figure['what']} {figure['value']:.4g} {figure['unit']}{held}"


# --- simulated --------------------------------------------------------------------------------------


class ServedPart(ResultModel):
    """A simulated instrument that is served."""

    name: str
    model: str
    tcp: str = Field(description="host and port")
    pty: str | None = Field(None, description="pseudo-terminal, where there is one")


class ReadyResult(ResultModel):
    """Where each simulated instrument listens: the file of bench simulate --ready-file."""

    instruments: list[ServedPart]
    control: str = Field("", description="host and port that take commands, such as 'turn 45 deg'")
