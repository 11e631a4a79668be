"""Requests that measure: runs, dry runs, and the test, commissioning or simulation of instruments."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.languages import message
from bench.base.requests import Option, option
from bench.services.requests import shared

BenchNameField = Annotated[
    str | None,
    Option("Bench file, by path or name (default: BENCH_FILE).", metavar="FILE", completes="bench_files"),
]
SeedField = Annotated[int, Option("Seed of the random numbers of a dry run.", least=0, rare=True)]
WireLogField = Annotated[Path | None, Option("Write all messages to and from the instruments.", rare=True)]
AnswersField = Annotated[
    str | None,
    Option(
        "Where a person answers the questions, also in a dry run: terminal, or folder (of the run).",
        metavar="PLACE",
        rare=True,
    ),
]
PanelField = Annotated[
    bool,
    Option(
        "Open the operator's panel for this run and print its link; a dry run then asks its questions.",
    ),
]


@dataclass(frozen=True)
class DryRunRequest:
    """Options of a dry run: a procedure carried out on simulated instruments."""

    procedure: Annotated[
        str | Path,
        Option("Procedure file, by path or shipped name.", argument=True, completes="procedures", typed=str),
    ]
    bench: shared.BenchField = None
    _: KW_ONLY
    seed: SeedField = 1
    model: shared.ModelField = None
    name: str | None = option(None, message("Name of the run (default: procedure and time)."))
    runs: shared.RunsField = None


@dataclass(frozen=True, kw_only=True)
class RunRequest(DryRunRequest):
    """Options of `bench run`: carry out a procedure on a bench, or dry on simulated instruments."""

    dry_run: bool = option(False, "Simulate instruments and clock; touch no hardware.")
    operator: shared.OperatorField = ""
    unit: str | None = option(
        None, message("Serial number of the block, instead of the bench file's."), metavar="SERIAL"
    )
    limit: shared.LimitField = None
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    until: shared.UntilField = None
    wire_log: WireLogField = None
    check_block: bool = option(False, "Require the check block in a dry run, too.", rare=True)
    despite_check: str | None = option(
        None,
        "Start although the check block is out of control; REASON is recorded.",
        metavar="REASON",
        rare=True,
    )
    laboratory: Path | None = option(
        None,
        "Laboratory file, which may demand a validated program.",
        environment="BENCH_LABORATORY",
        rare=True,
    )
    follow: bool = option(
        False, "Diagnose the run, then run the procedure that the diagnosis proposes.", rare=True
    )
    answers: AnswersField = None
    panel: PanelField = False

    @property
    def living(self) -> bool:
        """Whether a person, and no script, answers the questions of a dry run."""
        return self.dry_run and (self.panel or self.answers is not None)


@dataclass(frozen=True)
class ResumeRequest:
    """Options of `bench resume`: resume an interrupted run."""

    name: shared.LatestField = None
    _: KW_ONLY
    operator: shared.OperatorField = ""
    wire_log: WireLogField = None
    answers: AnswersField = None
    panel: PanelField = False
    runs: shared.RunsField = None


@dataclass(frozen=True, kw_only=True)
class InstrumentsRequest:
    """Options of `bench instruments`: test or commission the instruments of a bench."""

    bench: BenchNameField = None
    discover: bool = option(False, "List the addresses on the interfaces; send nothing to an instrument.")
    commission: bool = option(False, "Commission new hardware step by step.")
    out: Path | None = option(
        None, "With --commission: folder for page and wire log (default: new).", metavar="DIR", rare=True
    )
    dry_run: bool = option(
        False, "With --commission: use the simulated bench and a scripted operator.", rare=True
    )
    seed: SeedField = 1
    wire_log: WireLogField = None


@dataclass(frozen=True)
class SimulateRequest:
    """Options of `bench simulate`: serve simulated instruments."""

    command: list[str] | None = option(
        None, "With --control: command to the served bench, such as 'turn 45 deg'.", argument=True
    )
    _: KW_ONLY
    bench: BenchNameField = None
    model: shared.ModelField = None
    seed: int = option(1, "Seed of the random numbers.", least=0, rare=True)
    speed: float = option(1.0, "Speed of the clock, as a multiple of real time.")
    host: str = option("127.0.0.1", "Address to listen on; only loopback refuses other computers.", rare=True)
    port: int | None = option(None, "First TCP port; the others follow (default: free ports).")
    ready_file: Path | None = option(None, "Write all addresses as JSON when all instruments listen.")
    hands: Path | None = option(
        None,
        "Have simulated hands turn the head and mount the block as the runs in FOLDER ask.",
        metavar="FOLDER",
    )
    no_pty: bool = option(False, "Serve TCP only, without pseudo-terminals.", rare=True)
    control: str | None = option(None, "Send COMMAND to a served bench.", metavar="HOST:PORT")
