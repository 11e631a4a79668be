"""Requests for the catalogue, batches, certificates and the panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option, option
from bench.services.requests import shared

CatalogueField = Annotated[
    str | None,
    Option(
        "Catalogue: a file, or postgresql://USER@HOST/NAME (default: in your cache folder).",
        metavar="FILE|URL",
        environment="TRIAXIAL_BENCH_CATALOGUE",
        rare=True,
    ),
]
QueryField = Annotated[
    list[str] | None,
    Option("Conditions; 'bench catalogue keys' lists the keys.", metavar="[KEY=VALUE…]", argument=True),
]


@dataclass(frozen=True)
class Sync:
    """Options of `bench catalogue sync`: update the catalogue from run folders."""

    folders: Annotated[
        list[Path], Option("Folders that contain run folders, at any depth.", metavar="DIR…", argument=True)
    ]
    _: KW_ONLY
    verify: bool = option(False, "Check each event of each record, not only the line hashes.")
    due: bool = option(False, "Compute the due dates of changed units now, so that 'due' answers at once.")
    catalogue: CatalogueField = None


@dataclass(frozen=True)
class Ask:
    """Options of `bench catalogue ask`: a question to the catalogue."""

    query: QueryField = None
    _: KW_ONLY
    of: str = option(
        "runs",
        "runs, coefficients, units, benches, operators, instruments, certificates, issued or folders.",
        metavar="WHAT",
    )
    csv: Path | None = option(None, "Write all rows and columns as CSV.")
    parquet: Path | None = option(None, "Write all rows and columns as Parquet.")
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class _Dated:
    limit: float | None = option(
        None, "Allowed error, in g at 1 g (default: limit of the last verification).", metavar="G"
    )
    interval: float | None = option(
        None, "Interval for units with a short history (default: 365).", metavar="DAYS"
    )
    catalogue: CatalogueField = None


@dataclass(frozen=True)
class Unit(_Dated):
    """Options of `bench catalogue unit`: the history of a unit, with coefficients, runs and due date."""

    name: Annotated[str, Option("Serial number, or type and serial number.", metavar="UNIT", argument=True)]
    _: KW_ONLY
    page: Path | None = option(None, "Write an HTML page.")


@dataclass(frozen=True)
class DueUnits(_Dated):
    """Options of `bench catalogue due`: the due dates of units, predicted from their drift."""

    query: QueryField = None
    _: KW_ONLY
    before: str | None = option(None, "List only units due before this day.", metavar="YYYY-MM-DD")


# --- batches: the same work over many runs ------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Batch(shared.OnReadings):
    """Options of every `bench batch`: the runs to evaluate again, and the folder for the results."""

    over: Annotated[
        list[str],
        Option(
            "Runs: a path pattern ('runs/*') or a catalogue query ('unit=Q-17'); repeatable.",
            metavar="QUERY|GLOB",
        ),
    ]
    out: Annotated[Path, Option("Folder of the batch; the same command resumes it.", metavar="FOLDER")]
    model: shared.ModelField = None
    workers: int | None = option(None, "Number of processes (default: one per core).", metavar="N", least=1)
    scheduler: str | None = option(
        None,
        "Dask scheduler (tcp://host:8786) to use instead of local processes.",
        metavar="ADDRESS",
        rare=True,
    )
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class BatchCalibrate(Batch):
    """Options of `bench batch calibrate`: compute coefficients and verdicts of many runs again."""

    estimator: shared.EstimatorField = "gls"
    nominal_angles: shared.NominalField = False
    join_free: shared.JoinFreeField = True
    join_verification: shared.JoinVerificationField = False
    limit: shared.LimitField = None
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    strict: bool = option(False, "Accept no changed judgement of a fit.")


@dataclass(frozen=True, kw_only=True)
class BatchDiagnose(Batch):
    """Options of `bench batch diagnose`: compute diagnoses of many runs again."""

    strict: bool = option(False, "Accept no changed effect under the same verdict.")


@dataclass(frozen=True, kw_only=True)
class BatchReport(Batch):
    """Options of `bench batch report`: write reports of many runs into the folder of the batch."""

    limit: shared.LimitField = None
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    population: shared.PopulationField = None


# --- certificates -------------------------------------------------------------------------------------

LaboratoryField = Annotated[
    Path | None, Option("Laboratory file; 'bench init' copies an example.", environment="BENCH_LABORATORY")
]
AuthorisedField = Annotated[
    str | None, Option("Authorising person, as named in the laboratory file.", metavar="NAME")
]
NumberField = Annotated[str, Option("Number of the certificate.", argument=True)]
ReasonField = Annotated[str, Option("Reason, for the register.", metavar="TEXT")]


@dataclass(frozen=True, kw_only=True)
class Issuing:
    """Options of every command that issues a certificate: laboratory, order, signatory and key."""

    laboratory: LaboratoryField = None
    order: Path | None = option(None, "Order file; 'bench init' copies an example.")
    authorised_by: AuthorisedField = None
    key: str | None = option(None, "Key to sign with: a PEM file, or pkcs11:… for a token.", metavar="KEY")
    chain: Path | None = option(None, "Certificates of the key (PEM), if not beside it.", rare=True)
    schema: Path | None = option(
        None, "Folder of schemas (DCC 3.3.0, D-SI 2.2.1) to check against.", metavar="DIR", rare=True
    )
    runs: shared.RunsField = None


@dataclass(frozen=True)
class IssueCertificates(Issuing):
    """Options of `bench certificate issue`: the runs to be certified, and where drafts are written."""

    names: Annotated[
        list[str], Option("Runs, by name or path.", metavar="RUN…", argument=True, completes="runs")
    ]
    _: KW_ONLY
    draft: bool = option(False, "Write a draft with a watermark; needs no laboratory or order file.")
    out: Path | None = option(
        None, "Folder for drafts (default: the run's folder).", metavar="DIR", rare=True
    )


@dataclass(frozen=True)
class AmendCertificate(Issuing):
    """Options of `bench certificate amend`: issue a certificate that replaces a valid one."""

    number: NumberField
    run: shared.RunField
    _: KW_ONLY
    reason: ReasonField
    replace: bool = option(False, "Replace the whole certificate: another run, other results.")


@dataclass(frozen=True)
class RevokeCertificate:
    """Options of `bench certificate revoke`: revoke a valid certificate."""

    number: NumberField
    _: KW_ONLY
    reason: ReasonField
    laboratory: LaboratoryField = None
    authorised_by: AuthorisedField = None


@dataclass(frozen=True)
class CheckRegister:
    """Options of `bench certificate register`: list and check the issued certificates."""

    number: str | None = option(None, "Number of a certificate (default: all).", argument=True)
    _: KW_ONLY
    laboratory: LaboratoryField = None
    out: Path | None = option(None, "Copy the files of certificate NUMBER into this folder.", metavar="DIR")
    again: bool = option(False, "Regenerate the unsigned certificates from their records and compare.")
    runs: shared.RunsField = None


@dataclass(frozen=True)
class VerifyCertificate:
    """Options of `bench certificate verify`: check integrity, signature and validity of a certificate."""

    file: Annotated[Path, Option("Certificate, PDF or XML; the other form must be beside it.", argument=True)]
    _: KW_ONLY
    trust: Path | None = option(None, "Trusted certificates of signers or authorities (PEM).")
    laboratory: Path | None = option(
        None, "Laboratory file with the register (default: the one beside FILE)."
    )
    runs: shared.RunsField = None


@dataclass(frozen=True)
class PlanKit:
    """Options of `bench kit plan`: plan an interlaboratory comparison."""

    plan: Annotated[str | Path, Option("Plan to write (YAML).", argument=True)]
    _: KW_ONLY
    laboratory: Annotated[Sequence[str], Option("Laboratory, the pilot first (repeatable).", metavar="NAME")]
    block: str = option("block", "Type and serial number of the block.", metavar="TEXT")
    seed: int | None = option(
        None,
        "Seed of the random order and blind codes; keep it secret (default: none).",
        least=0,
    )


@dataclass(frozen=True)
class SealKit:
    """Options of `bench kit seal`: note the seals of all results before any result is opened."""

    plan: Annotated[str | Path, Option("Plan of the comparison.", argument=True)]
    results: Annotated[
        Sequence[str], Option("Code and result file, or its SHA-256.", metavar="CODE=FILE…", argument=True)
    ]


@dataclass(frozen=True)
class EvaluateKit(SealKit):
    """Options of `bench kit evaluate`: evaluate all sealed results."""

    _: KW_ONLY
    check: Sequence[str] = option(
        (),
        "Transport check of a stop: its CODE and monitor run, on arrival, then before departure (repeatable).",
        metavar="CODE=FILE",
    )
    g: float | None = option(
        None, "Local gravity on which K is based, for a foreign certificate.", metavar="M/S2", rare=True
    )


@dataclass(frozen=True)
class ReadCertificate:
    """Options of `bench certificate read`: read coefficients or an instrument's data from a certificate."""

    file: Annotated[
        Path, Option("Digital calibration certificate: XML, or PDF with the XML inside.", argument=True)
    ]
    _: KW_ONLY
    out: Path | None = option(None, "File for the coefficients, for verify --coefficients and compare.")
    into: Path | None = option(None, "Bench file that gets the certificate of --instrument.")
    instrument: str | None = option(
        None, "With --into: instrument of the bench file, such as head or chamber.", metavar="NAME"
    )
    by: str | None = option(None, "With --into: who accepts the certificate.", metavar="NAME")
    g: float | None = option(
        None, "Local gravity on which K is based, for a foreign certificate.", metavar="M/S2", rare=True
    )
    noise: str | None = option(
        None, "Noise of a reading, such as '50 uV', for a foreign certificate.", metavar="VOLTAGE", rare=True
    )


# --- validation ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Validate:
    """Options of `bench validate`: carry out, accept, withdraw or list validations of an installation."""

    bench: str | None = option(
        None,
        "Bench file, by path or name (default: BENCH_FILE, else paper-stand).",
        metavar="FILE",
        completes="bench_files",
    )
    quick: bool = option(False, "Take a minute: simulate fewer files, kill and resume a run only once.")
    against: str | None = option(
        None,
        "Also recompute past runs (a path pattern or catalogue query) and list changes beyond 0.1 u.",
        metavar="OLD",
    )
    out: Path | None = option(
        None, "Folder for page, PDF and result (default: validation-DATE).", metavar="DIR", rare=True
    )
    key: Path | None = option(None, "Private key (Ed25519) that signs the seal.", rare=True)
    release: Path | None = option(
        None, "Manifest of a release, which the program and its packages must match.", rare=True
    )
    release_key: Path | None = option(
        None, "Public key (Ed25519) that verifies the manifest's signature.", rare=True
    )
    laboratory: LaboratoryField = None
    accept: Path | None = option(None, "Accept and register the validation in DIR.", metavar="DIR")
    withdraw: str | None = option(
        None, "Withdraw the accepted validation NUMBER.", metavar="NUMBER", rare=True
    )
    by: str | None = option(None, "Authorised person, as named in the laboratory file.", metavar="NAME")
    reason: str | None = option(None, "Reason, for the register.", metavar="TEXT", rare=True)
    register: bool = option(False, "List the register of validations.", rare=True)
    runs: shared.RunsField = None
    catalogue: CatalogueField = None


class FailureState(StrEnum):
    """The states of a failure in the register."""

    OPEN = "open"
    REMEDIED = "remedied"
    CLOSED = "closed"


@dataclass(frozen=True, kw_only=True)
class Failures:
    """Options of `bench failures`: collect failures from records, note state and remedy, or list a year."""

    laboratory: LaboratoryField = None
    number: str | None = option(
        None, "Number of the failure that gets --state and --remedy.", metavar="NUMBER"
    )
    state: FailureState | None = option(
        None, "State of the failure: open, remedied or closed (by an authorised person)."
    )
    remedy: str | None = option(None, "Cause and remedy, in words.", metavar="TEXT")
    by: str | None = option(None, "Person who notes state and remedy.", metavar="NAME")
    year: int | None = option(None, "Show only the failures of year YYYY.", metavar="YYYY")
    page: Path | None = option(None, "Write an HTML page, as for the management review.")
    runs: shared.RunsField = None


# --- persons -----------------------------------------------------------------------------------------


class Right(StrEnum):
    """A right of a person; everybody may view everything and stop a run.

    operate: carry out runs. supervise: also take control by force. authorise: issue certificates, accept
    validations, close failures. administer: change the register of persons.
    """

    OPERATE = "operate"
    SUPERVISE = "supervise"
    AUTHORISE = "authorise"
    ADMINISTER = "administer"


class PersonsCommand(StrEnum):
    """The kinds of change of the register of persons."""

    ADD = "add"
    CHANGE = "change"
    END = "end"


@dataclass(frozen=True)
class ChangePersons:
    """Options of `bench persons`: list or change the persons of a laboratory."""

    what: PersonsCommand | None = option(
        None, "add, change, or end (a person's rights) (default: list all).", argument=True
    )
    name: str | None = option(None, "Name of the person.", argument=True)
    _: KW_ONLY
    role: str | None = option(None, "Role in words, as on certificates.", metavar="TEXT")
    may: str | None = option(
        None, "Rights, with commas: operate, supervise, authorise, administer.", metavar="RIGHTS"
    )
    token: bool = option(False, "Make a new token, and print it once.")
    public_key: Path | None = option(
        None, "Public key of the person (Ed25519, the .pub of 'bench key').", rare=True
    )
    by: str | None = option(None, "Administrator who makes the change.", metavar="NAME")
    reason: str | None = option(None, "Reason, for the register.", metavar="TEXT")
    laboratory: LaboratoryField = None


# --- the panel ----------------------------------------------------------------------------------------


class PeopleCommand(StrEnum):
    """The kinds of command on access to the panel: make, list or revoke tokens, or make a one-time link."""

    TOKEN = "token"
    TOKENS = "tokens"
    REVOKE = "revoke"
    LINK = "link"


@dataclass(frozen=True)
class ServePanel:
    """Options of `bench panel`: serve the panel over a folder of runs, or manage access to it."""

    what: PeopleCommand | None = option(
        None,
        "token NAME (makes a token), tokens (lists all), revoke NAME, "
        "or link [NAME] (makes a one-time link) (default: serve the panel).",
        argument=True,
    )
    name: str | None = option(None, "Name of the person.", argument=True)
    _: KW_ONLY
    role: str = option("operator", "Role of the person: viewer, operator or supervisor.")
    host: str = option("127.0.0.1", "Address to listen on; any but loopback requires tokens.")
    port: int = option(8741, "Port to listen on; 0 for a free one.", least=0, most=65535)
    address: str = option(
        "", "Address of a TLS proxy in front, such as https://bench.lab.", metavar="URL", rare=True
    )
    laboratory: Path | None = option(
        None,
        "Laboratory file, beside which persons and certificates are registered.",
        environment="BENCH_LABORATORY",
        rare=True,
    )
    catalogue: str = option("", "Catalogue for the pages on units; read only.", metavar="FILE|URL", rare=True)
    runs: shared.RunsField = None
