"""Requests that measure: runs, dry runs, and the test, commissioning or simulation of instruments."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import (
    BenchField,
    GuardBandField,
    LatestField,
    LimitField,
    ModelField,
    RuleField,
    RunsField,
    UntilField,
)

BenchNameField = Annotated[
    str | None,
    Option("Bench file, by path or name (default: BENCH_FILE).", metavar="FILE", completes="bench_files"),
]
SeedField = Annotated[int, Option("Random numbers of a dry run.", least=0)]
WireLogField = Annotated[
    Path | None, Option("Write every message to and from the instruments.", metavar="FILE")
]
AnswersField = Annotated[
    str | None,
    Option(
        "Where a person answers the questions, also those of a dry run: terminal, or folder (the run's).",
        metavar="PLACE",
    ),
]
PanelField = Annotated[
    bool,
    Option(
        "Open the operator's panel for this run and print its link; a dry run's questions are asked, too.",
        ("--panel",),
    ),
]


@dataclass(frozen=True)
class DryRunRequest:
    """A procedure to be run on simulated instruments."""

    procedure: Annotated[
        str | Path,
        Option("Procedure file, by path or shipped name.", argument=True, completes="procedures", typed=str),
    ]
    bench: BenchField = None
    _: KW_ONLY
    seed: SeedField = 1
    model: ModelField = None
    name: Annotated[str | None, Option("Name of the run (default: procedure and time).")] = None
    runs: RunsField = None


@dataclass(frozen=True, kw_only=True)
class RunRequest(DryRunRequest):
    """A procedure to be run on a bench, or dry on simulated instruments."""

    dry_run: Annotated[bool, Option("Simulated instruments, virtual clock.", ("--dry-run",))] = False
    operator: Annotated[str, Option("Who stands at the bench, for the record.")] = ""
    unit: Annotated[
        str | None, Option("Serial number of the block, in place of the bench file's.", metavar="SERIAL")
    ] = None
    limit: LimitField = None
    rule: RuleField = None
    guard_band: GuardBandField = None
    until: UntilField = None
    wire_log: WireLogField = None
    check_block: Annotated[
        bool, Option("Hold a dry run, too, to the check block of the bench file.", ("--check-block",))
    ] = False
    despite_check: Annotated[
        str | None, Option("Begin whatever the check block says; the record keeps why.", metavar="REASON")
    ] = None
    follow: Annotated[bool, Option("Then diagnose, and run at once what would tell more.", ("--follow",))] = (
        False
    )
    answers: AnswersField = None
    panel: PanelField = False

    @property
    def living(self) -> bool:
        """Whether a person answers the questions of a dry run."""
        return self.dry_run and (self.panel or self.answers is not None)


@dataclass(frozen=True)
class ResumeRequest:
    """An interrupted run, to be resumed."""

    name: LatestField = None
    _: KW_ONLY
    wire_log: WireLogField = None
    answers: AnswersField = None
    panel: PanelField = False
    runs: RunsField = None


@dataclass(frozen=True, kw_only=True)
class InstrumentsRequest:
    """The instruments of a bench, to be tested or commissioned."""

    bench: BenchNameField = None
    discover: Annotated[
        bool, Option("List what the interfaces offer; address no instrument.", ("--discover",))
    ] = False
    commission: Annotated[
        bool, Option("Go through a first evening with the hardware, asked step by step.", ("--commission",))
    ] = False
    out: Annotated[
        Path | None,
        Option("With --commission: folder for page and wire log (default: a new one).", metavar="DIR"),
    ] = None
    dry_run: Annotated[
        bool, Option("With --commission: the simulated bench and a scripted person.", ("--dry-run",))
    ] = False
    seed: SeedField = 1
    wire_log: WireLogField = None


@dataclass(frozen=True)
class SimulateRequest:
    """Simulated instruments, to be served."""

    command: Annotated[
        str | None,
        Option("With --control: what to do on a bench that is served, such as 'turn 45 deg'.", argument=True),
    ] = None
    _: KW_ONLY
    bench: BenchNameField = None
    model: ModelField = None
    seed: Annotated[int, Option("Random numbers of the simulated bench.", least=0)] = 1
    speed: Annotated[float, Option("How many times faster than real time it goes.")] = 1.0
    host: Annotated[str, Option("Address to listen on; loopback keeps others out.")] = "127.0.0.1"
    port: Annotated[int | None, Option("First TCP port, the others follow (default: free ones).")] = None
    ready_file: Annotated[
        Path | None, Option("JSON with all addresses, once everything listens.", metavar="FILE")
    ] = None
    no_pty: Annotated[bool, Option("TCP alone, no pseudo-terminals.", ("--no-pty",))] = False
    control: Annotated[str | None, Option("Send COMMAND to a bench that is served.", metavar="HOST:PORT")] = (
        None
    )
