"""Requests on runs and instruments: planning and checks, runs, their records, tests and simulation."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.languages import message
from bench.base.requests import ESTIMATORS_IN_A_BUDGET, Option, option
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


# --- before a run ----------------------------------------------------------------------------------------


ProcedureField = Annotated[
    str,
    Option(
        "Procedure file, by path or shipped name.", argument=True, completes="procedures", also="--procedure"
    ),
]
EstimatorField = Annotated[str, Option(ESTIMATORS_IN_A_BUDGET, rare=True)]
UpToField = Annotated[
    str | None, Option("Largest acceleration, such as 5g (default: the block's range).", rare=True)
]


@dataclass(frozen=True)
class Check:
    """Options of `bench check`: check a procedure against a bench or, with `morning`, the bench itself."""

    procedure: str | None = option(
        None, "Procedure file, by path or shipped name.", argument=True, completes="procedures"
    )
    _: KW_ONLY
    bench: shared.BenchField = None
    until: shared.UntilField = None
    morning: bool = option(
        False, "Check the bench instead: identities, self-tests, inputs, head, check block."
    )
    reference: float | None = option(
        None, "With --morning: voltage of the reference, V (default: no reference).", metavar="V", rare=True
    )
    dry_run: bool = option(False, "With --morning: use the simulated bench.", rare=True)
    seed: int = option(1, "Seed of the random numbers of --dry-run.", least=0, rare=True)
    out: Path | None = option(None, "With --morning: folder of page and wire log.", metavar="DIR", rare=True)
    runs: shared.RunsField = None


@dataclass(frozen=True)
class Init:
    """Options of `bench init`: copy the shipped files."""

    folder: Path = option(Path(), "Folder for the copies.", argument=True)


@dataclass(frozen=True)
class Budget:
    """Options of `bench budget`: compute the contribution of each error of a bench to the uncertainty."""

    bench: shared.BenchField = None
    procedure: ProcedureField = "calibration"
    estimator: EstimatorField = "gls"
    _: KW_ONLY
    model: shared.ModelField = None
    coefficients: str | Path | None = option(
        None, "Coefficients from 'calibrate --json', instead of the bench file's.", rare=True
    )
    trials: int = option(20_000, "Number of Monte Carlo trials; 0 for none.", least=0, rare=True)
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    limit: shared.LimitField = None
    same_voltmeters: bool = option(
        False, "Assume that the block is used with the same voltmeters.", rare=True
    )
    g: shared.GravityField = None


@dataclass(frozen=True, kw_only=True)
class Require:
    """Options of `bench require`: compute how large the errors of a bench may be for a required accuracy."""

    accuracy: Annotated[str, Option("Required accuracy k u, in g (of a coefficient in V/g or V).")]
    of: str = option(
        "delta-g", "Quantity: delta-g, acceleration (vector), modulus, or a coefficient such as Kyx."
    )
    up_to: UpToField = None
    k: float = option(3.0, "Number of standard uncertainties in the accuracy.")
    with_reading: bool = option(False, "Include the errors of a reading when the block is used.", rare=True)
    all_errors: bool = option(
        False, "Include gain, gravity, temperature and nonlinearity, which no reading shows.", rare=True
    )
    share: str = option("equal", "How errors share the variance: equal or cost.", rare=True)
    cost: list[str] | None = option(
        None, "Cost of reducing an error (default 1).", metavar="NAME=WEIGHT", rare=True
    )
    estimator: EstimatorField = "gls"
    procedure: ProcedureField = "calibration"
    bench: shared.BenchField = None


@dataclass(frozen=True, kw_only=True)
class PlanPoints:
    """Options of `bench plan-points`: find the test points that give a required uncertainty."""

    bench: shared.BenchField = None
    u: list[str] | None = option(
        None, "Required combined standard uncertainty: Kyx=90e-6 (V/g), U0, K or all.", metavar="NAME=U"
    )
    delta_g: float | None = option(None, "Required u(Δg) at the verification points, g.")
    modulus: float | None = option(None, "Required u(|a|) in every direction, g; see --up-to.")
    up_to: UpToField = None
    time: str | None = option(None, "Find the lowest uncertainty in this bench time, such as 4h.")
    least: str = option("time", "What to minimise: time or settings.", rare=True)
    installations: str | None = option(
        None, "Installations to choose from, such as 1,2,1T90 (default: all).", rare=True
    )
    angles: int = option(24, "Number of angles in a turn to choose from.", rare=True)
    visits: int = option(1, "How often an installation may be mounted.", least=1, most=4, rare=True)
    most_mountings: int = option(3, "Largest number of mountings.", least=1, most=6, rare=True)
    most_settings: int = option(300, "Largest number of settings.", least=4, rare=True)
    cost_setting: str = option("2min", "Time to set the head once.", rare=True)
    cost_remount: str = option("20min", "Time to mount the block.", rare=True)
    cost_soak: str = option("10min", "Settling time after each mounting.", rare=True)
    warm_up: str = option("1h", "Warm-up time before the first reading.", rare=True)
    verify: bool = option(True, "Add verification points at the end.", rare=True)
    out: Path | None = option(None, "Procedure file to write; must not exist yet.")

    @property
    def has_goals(self) -> bool:
        """Whether the options state a goal for an uncertainty, and not only a time."""
        return bool(self.u) or self.delta_g is not None or self.modulus is not None


# --- records of runs -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ListRuns:
    """Options of `bench runs`: list the runs of a folder."""

    runs: shared.RunsField = None


@dataclass(frozen=True)
class ShowRun:
    """Options of `bench show`: the content of a run, and with `verify` or a key the evidence for its record."""

    run: shared.RunField
    _: KW_ONLY
    verify: bool = option(False, "Check the record for changed lines.")
    head: str | None = option(
        None, "Check that the chain ends with this head, noted elsewhere.", metavar="SHA256", rare=True
    )
    key: Path | None = option(
        None, "Check the signature of the seal with this public key.", metavar="PUB", rare=True
    )
    authority: Path | None = option(
        None, "Check the time stamp with this certificate.", metavar="PEM", rare=True
    )
    runs: shared.RunsField = None

    @property
    def proved(self) -> bool:
        """Whether the evidence for the record is requested."""
        return self.verify or any(given is not None for given in (self.head, self.key, self.authority))


@dataclass(frozen=True)
class SealRun:
    """Options of `bench seal`: seal a run that has ended."""

    run: shared.RunField
    _: KW_ONLY
    key: Path | None = option(None, "Private key for the signature; 'bench key' makes one.")
    timestamp: str | None = option(None, "Server for the time stamp (RFC 3161).", metavar="URL")
    runs: shared.RunsField = None


@dataclass(frozen=True)
class MakeKey:
    """Options of `bench key`: make a key of the laboratory, for seals or for certificates."""

    file: Annotated[
        Path, Option("File for the private key; the public key is written to FILE.pub.", argument=True)
    ]
    _: KW_ONLY
    passphrase: bool = option(False, "Ask for a passphrase to encrypt the private key.")
    certificate: str | None = option(
        None,
        "Make a key for certificates (P-256) and FILE.crt, a self-signed X.509 certificate with this name.",
        metavar="NAME",
    )


@dataclass(frozen=True)
class ExportReadings:
    """Options of `bench export`: write the readings of a run as a readings file."""

    run: shared.RunField
    _: KW_ONLY
    csv: str | None = option(None, "Readings file (default: RUN.csv); - for standard output.", metavar="FILE")
    runs: shared.RunsField = None


@dataclass(frozen=True)
class ImportReadings:
    """Options of `bench import`: make a run of a readings file or, with `columns`, of another program's log."""

    file: Annotated[Path, Option("Readings file.", argument=True)]
    _: KW_ONLY
    name: str | None = option(None, "Name of the run (default: the file's).")
    columns: Path | None = option(None, "Mapping file (YAML) for the columns of another program's log.")
    preview: bool = option(
        False, "Show the first rows as imported, and what would be refused; import nothing.", rare=True
    )
    skip_bad_rows: bool = option(False, "Leave out rows of a log that cannot be read.", rare=True)
    bench: shared.BenchField = None
    runs: shared.RunsField = None


@dataclass(frozen=True)
class AbortRun:
    """Options of `bench abort`: end an interrupted run for good."""

    name: shared.LatestField = None
    _: KW_ONLY
    operator: shared.OperatorField = ""
    runs: shared.RunsField = None


@dataclass(frozen=True)
class ControlRun:
    """Options of `bench control`: send a command such as pause or skip to the program that carries out a run."""

    run: shared.RunField
    wish: Annotated[
        str,
        Option("pause, continue, redo (the point), redo-pass, remount, skip, stop or abort.", argument=True),
    ]
    reason: str = option("", "Reason, for the record; required for skip.", argument=True)
    _: KW_ONLY
    operator: shared.OperatorField = ""
    runs: shared.RunsField = None
