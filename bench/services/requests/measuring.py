"""Requests that measure: runs, dry runs, and the test, commissioning or simulation of instruments."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.languages import message
from bench.base.requests import Option
from bench.services.requests.shared import (
    BenchField,
    GuardBandField,
    LatestField,
    LimitField,
    ModelField,
    OperatorField,
    RuleField,
    RunsField,
    UntilField,
)

BenchNameField = Annotated[
    str | None,
    Option(
        "Bench file, by path or name (default: BENCH_FILE).",
        metavar="FILE",
        completes="bench_files",
        common=True,
    ),
]
SeedField = Annotated[int, Option("Seed of the random numbers of a dry run.", least=0)]
WireLogField = Annotated[
    Path | None, Option("Write all messages to and from the instruments.", metavar="FILE")
]
AnswersField = Annotated[
    str | None,
    Option(
        "Where a person answers the questions, also in a dry run: terminal, or folder (of the run).",
        metavar="PLACE",
    ),
]
PanelField = Annotated[
    bool,
    Option(
        "Open the operator's panel for this run and print its link; a dry run then asks its questions.",
        ("--panel",),
        common=True,
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
    name: Annotated[
        str | None, Option(message("Name of the run (default: procedure and time)."), common=True)
    ] = None
    runs: RunsField = None


@dataclass(frozen=True, kw_only=True)
class RunRequest(DryRunRequest):
    """A procedure to be run on a bench, or dry on simulated instruments."""

    dry_run: Annotated[
        bool, Option("Simulate instruments and clock; touch no hardware.", ("--dry-run",), common=True)
    ] = False
    operator: OperatorField = ""
    unit: Annotated[
        str | None,
        Option(
            message("Serial number of the block, instead of the bench file's."), metavar="SERIAL", common=True
        ),
    ] = None
    limit: LimitField = None
    rule: RuleField = None
    guard_band: GuardBandField = None
    until: UntilField = None
    wire_log: WireLogField = None
    check_block: Annotated[bool, Option("Require the check block in a dry run, too.", ("--check-block",))] = (
        False
    )
    despite_check: Annotated[
        str | None,
        Option("Start although the check block is out of control; REASON is recorded.", metavar="REASON"),
    ] = None
    laboratory: Annotated[
        Path | None,
        Option(
            "Laboratory file, which may demand a validated program.",
            metavar="FILE",
            environment="BENCH_LABORATORY",
        ),
    ] = None
    follow: Annotated[
        bool, Option("Diagnose the run, then run the procedure that the diagnosis proposes.", ("--follow",))
    ] = False
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
    operator: OperatorField = ""
    wire_log: WireLogField = None
    answers: AnswersField = None
    panel: PanelField = False
    runs: RunsField = None


@dataclass(frozen=True, kw_only=True)
class InstrumentsRequest:
    """The instruments of a bench, to be tested or commissioned."""

    bench: BenchNameField = None
    discover: Annotated[
        bool,
        Option("List the resources of the interfaces; address no instrument.", ("--discover",), common=True),
    ] = False
    commission: Annotated[
        bool, Option("Commission new hardware step by step.", ("--commission",), common=True)
    ] = False
    out: Annotated[
        Path | None,
        Option("With --commission: folder for page and wire log (default: new).", metavar="DIR"),
    ] = None
    dry_run: Annotated[
        bool, Option("With --commission: use the simulated bench and a scripted operator.", ("--dry-run",))
    ] = False
    seed: SeedField = 1
    wire_log: WireLogField = None


@dataclass(frozen=True)
class SimulateRequest:
    """Simulated instruments, to be served."""

    command: Annotated[
        str | None,
        Option("With --control: command to the served bench, such as 'turn 45 deg'.", argument=True),
    ] = None
    _: KW_ONLY
    bench: BenchNameField = None
    model: ModelField = None
    seed: Annotated[int, Option("Seed of the random numbers.", least=0)] = 1
    speed: Annotated[float, Option("Speed of the clock, as a multiple of real time.", common=True)] = 1.0
    host: Annotated[str, Option("Address to listen on; only loopback is closed to others.")] = "127.0.0.1"
    port: Annotated[
        int | None, Option("First TCP port; the others follow (default: free ports).", common=True)
    ] = None
    ready_file: Annotated[
        Path | None,
        Option("Write all addresses as JSON when all instruments listen.", metavar="FILE", common=True),
    ] = None
    hands: Annotated[
        Path | None,
        Option(
            "Have simulated hands turn the head and mount the block as the runs in FOLDER ask.",
            metavar="FOLDER",
            common=True,
        ),
    ] = None
    no_pty: Annotated[bool, Option("Serve TCP only, without pseudo-terminals.", ("--no-pty",))] = False
    control: Annotated[
        str | None, Option("Send COMMAND to a served bench.", metavar="HOST:PORT", common=True)
    ] = None
