"""Requests for the catalogue, batches, certificates and the panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import (
    EstimatorField,
    GuardBandField,
    JoinFreeField,
    JoinVerificationField,
    LimitField,
    ModelField,
    NominalField,
    OnReadings,
    PopulationField,
    RuleField,
    RunField,
    RunsField,
)

CatalogueField = Annotated[
    str | None,
    Option(
        "Catalogue: a file, or postgresql://USER@HOST/NAME (default: in your cache folder).",
        metavar="FILE|URL",
        environment="TRIAXIAL_BENCH_CATALOGUE",
    ),
]
QueryField = Annotated[
    list[str] | None,
    Option("Conditions; 'bench catalogue keys' lists the keys.", metavar="[KEY=VALUE…]", argument=True),
]


@dataclass(frozen=True)
class Sync:
    """The synchronisation of the catalogue with run folders."""

    folders: Annotated[
        list[Path], Option("Folders that contain run folders, at any depth.", metavar="DIR…", argument=True)
    ]
    _: KW_ONLY
    verify: Annotated[
        bool, Option("Check each event of each record, not only the line hashes.", common=True)
    ] = False
    due: Annotated[
        bool,
        Option("Compute the due dates of changed units now, so that 'due' answers at once.", common=True),
    ] = False
    catalogue: CatalogueField = None


@dataclass(frozen=True)
class Ask:
    """A question to the catalogue."""

    query: QueryField = None
    _: KW_ONLY
    of: Annotated[
        str,
        Option(
            "runs, coefficients, units, benches, operators, instruments, certificates, issued or folders.",
            metavar="WHAT",
            common=True,
        ),
    ] = "runs"
    csv: Annotated[Path | None, Option("Write all rows and columns as CSV.", metavar="FILE", common=True)] = (
        None
    )
    parquet: Annotated[
        Path | None, Option("Write all rows and columns as Parquet.", metavar="FILE", common=True)
    ] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class _Dated:
    limit: Annotated[
        float | None,
        Option("Allowed error, in g at 1 g (default: of the last verification).", metavar="G", common=True),
    ] = None
    interval: Annotated[
        float | None,
        Option("Interval for units with a short history (default: 365).", metavar="DAYS", common=True),
    ] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True)
class Unit(_Dated):
    """The history of a unit: its coefficients over time, its runs, its due date."""

    name: Annotated[str, Option("Serial number, or type and serial number.", metavar="UNIT", argument=True)]
    _: KW_ONLY
    page: Annotated[Path | None, Option("Write an HTML page.", metavar="FILE", common=True)] = None


@dataclass(frozen=True)
class DueUnits(_Dated):
    """The due dates of units, predicted from their drift."""

    query: QueryField = None
    _: KW_ONLY
    before: Annotated[
        str | None, Option("List only units due before this day.", metavar="YYYY-MM-DD", common=True)
    ] = None


# --- batches: the same work over many runs ------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Batch(OnReadings):
    """Many runs to be evaluated again; the results are written into a folder."""

    over: Annotated[
        list[str],
        Option(
            "Runs: a path pattern ('runs/*') or a catalogue query ('unit=Q-17'); repeatable.",
            metavar="QUERY|GLOB",
            common=True,
        ),
    ]
    out: Annotated[
        Path, Option("Folder of the batch; the same command resumes it.", metavar="FOLDER", common=True)
    ]
    model: ModelField = None
    workers: Annotated[
        int | None, Option("Number of processes (default: one per core).", metavar="N", least=1, common=True)
    ] = None
    scheduler: Annotated[
        str | None,
        Option(
            "Dask scheduler (tcp://host:8786) to use instead of local processes.",
            metavar="ADDRESS",
        ),
    ] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class BatchCalibrate(Batch):
    """Coefficients and verdicts of many runs, computed again."""

    estimator: EstimatorField = "gls"
    nominal_angles: NominalField = False
    join_free: JoinFreeField = True
    join_verification: JoinVerificationField = False
    limit: LimitField = None
    rule: RuleField = None
    guard_band: GuardBandField = None
    strict: Annotated[bool, Option("Accept no changed judgement of a fit.", common=True)] = False


@dataclass(frozen=True, kw_only=True)
class BatchDiagnose(Batch):
    """Diagnoses of many runs, computed again."""

    strict: Annotated[bool, Option("Accept no changed effect under the same verdict.", common=True)] = False


@dataclass(frozen=True, kw_only=True)
class BatchReport(Batch):
    """Reports of many runs, written into the folder of the batch."""

    limit: LimitField = None
    rule: RuleField = None
    guard_band: GuardBandField = None
    population: PopulationField = None


# --- certificates -------------------------------------------------------------------------------------

LaboratoryField = Annotated[
    Path | None,
    Option(
        "Laboratory file; 'bench init' copies an example.",
        metavar="FILE",
        environment="BENCH_LABORATORY",
        common=True,
    ),
]
AuthorisedField = Annotated[
    str | None, Option("Authorising person, as named in the laboratory file.", metavar="NAME", common=True)
]
NumberField = Annotated[str, Option("Number of the certificate.", argument=True)]
ReasonField = Annotated[str, Option("Reason, for the register.", metavar="TEXT", common=True)]


@dataclass(frozen=True, kw_only=True)
class Issuing:
    """The laboratory, order, signatory and key with which certificates are issued."""

    laboratory: LaboratoryField = None
    order: Annotated[
        Path | None, Option("Order file; 'bench init' copies an example.", metavar="FILE", common=True)
    ] = None
    authorised_by: AuthorisedField = None
    key: Annotated[
        str | None,
        Option("Key to sign with: a PEM file, or pkcs11:… for a token.", metavar="KEY", common=True),
    ] = None
    chain: Annotated[
        Path | None, Option("Certificates of the key (PEM), if not beside it.", metavar="FILE")
    ] = None
    schema: Annotated[
        Path | None,
        Option("Folder of schemas (DCC 3.3.0, D-SI 2.2.1) to check against.", metavar="DIR"),
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class IssueCertificates(Issuing):
    """The certificates of runs, each issued once."""

    names: Annotated[
        list[str], Option("Runs, by name or path.", metavar="RUN…", argument=True, completes="runs")
    ]
    _: KW_ONLY
    draft: Annotated[
        bool, Option("Write a draft with a watermark; needs no laboratory or order file.", common=True)
    ] = False
    out: Annotated[Path | None, Option("Folder for drafts (default: the run's folder).", metavar="DIR")] = (
        None
    )


@dataclass(frozen=True)
class AmendCertificate(Issuing):
    """A certificate that replaces a valid one."""

    number: NumberField
    run: RunField
    _: KW_ONLY
    reason: ReasonField
    replace: Annotated[
        bool, Option("Replace the whole certificate: another run, other results.", common=True)
    ] = False


@dataclass(frozen=True)
class RevokeCertificate:
    """The revocation of a certificate."""

    number: NumberField
    _: KW_ONLY
    reason: ReasonField
    laboratory: LaboratoryField = None
    authorised_by: AuthorisedField = None


@dataclass(frozen=True)
class CheckRegister:
    """A check of the register of issued certificates."""

    number: Annotated[str | None, Option("Number of a certificate (default: all).", argument=True)] = None
    _: KW_ONLY
    laboratory: LaboratoryField = None
    out: Annotated[
        Path | None,
        Option("Copy the files of certificate NUMBER into this folder.", metavar="DIR", common=True),
    ] = None
    again: Annotated[
        bool, Option("Regenerate the unsigned certificates from their records and compare.", common=True)
    ] = False
    runs: RunsField = None


@dataclass(frozen=True)
class VerifyCertificate:
    """A check of a certificate: its integrity, its signature and whether it is still valid."""

    file: Annotated[Path, Option("Certificate, PDF or XML; the other form must be beside it.", argument=True)]
    _: KW_ONLY
    trust: Annotated[
        Path | None,
        Option("Trusted certificates of signers or authorities (PEM).", metavar="FILE", common=True),
    ] = None
    laboratory: Annotated[
        Path | None,
        Option(
            "Laboratory file with the register (default: the one beside FILE).", metavar="FILE", common=True
        ),
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class PlanKit:
    """The plan of an interlaboratory comparison."""

    plan: Annotated[str | Path, Option("Plan to write (YAML).", argument=True, typed=Path)]
    _: KW_ONLY
    laboratory: Annotated[
        Sequence[str],
        Option("A laboratory, the pilot first (repeatable).", metavar="NAME", common=True, typed=list[str]),
    ]
    block: Annotated[str, Option("Type and serial number of the block.", metavar="TEXT", common=True)] = (
        "block"
    )
    seed: Annotated[int, Option("Draws the order and the blind codes.", least=0, common=True)] = 1


@dataclass(frozen=True)
class SealKit:
    """Seals of results, before any is opened."""

    plan: Annotated[str | Path, Option("Plan of the comparison.", argument=True, typed=Path)]
    results: Annotated[
        Sequence[str],
        Option("Code and result file, or its SHA-256.", metavar="CODE=FILE…", argument=True, typed=list[str]),
    ]


@dataclass(frozen=True)
class EvaluateKit(SealKit):
    """The evaluation of all sealed results."""

    _: KW_ONLY
    check: Annotated[
        Sequence[str],
        Option(
            "Readings of a transport check of a stop: a monitor on arrival, then before departure (repeatable).",
            metavar="CODE=FILE", common=True, typed=list[str],
        ),
    ] = ()  # fmt: skip
    g: Annotated[
        float | None, Option("Local gravity of the stated K, for a foreign certificate.", metavar="M/S2")
    ] = None


@dataclass(frozen=True)
class ReadCertificate:
    """A certificate whose coefficients and covariance are to be read."""

    file: Annotated[
        Path,
        Option("Digital calibration certificate: XML, or PDF with the XML inside.", argument=True),
    ]
    _: KW_ONLY
    out: Annotated[
        Path | None,
        Option(
            "File for the coefficients, for verify --coefficients and compare.", metavar="FILE", common=True
        ),
    ] = None
    into: Annotated[
        Path | None,
        Option(
            "Bench file into which the certificate of --instrument is written.", metavar="FILE", common=True
        ),
    ] = None
    instrument: Annotated[
        str | None,
        Option("With --into: its instrument, such as head or chamber.", metavar="NAME", common=True),
    ] = None
    by: Annotated[
        str | None,
        Option("With --into: who accepts the certificate.", metavar="NAME", common=True),
    ] = None
    g: Annotated[
        float | None, Option("Local gravity of the stated K, for a foreign certificate.", metavar="M/S2")
    ] = None
    noise: Annotated[
        str | None,
        Option("Noise of a reading, such as '50 uV', for a foreign certificate.", metavar="VOLTAGE"),
    ] = None


# --- validation ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Validate:
    """The validation of an installation: to be made, accepted, withdrawn or listed."""

    bench: Annotated[
        str | None,
        Option(
            "Bench file, by path or name (default: BENCH_FILE, else paper-stand).",
            metavar="FILE",
            completes="bench_files",
            common=True,
        ),
    ] = None
    quick: Annotated[bool, Option("Take a minute: fewer simulated files, one kill.", common=True)] = False
    against: Annotated[
        str | None,
        Option("Also recompute past runs (a path pattern or catalogue query) and list changes beyond 0.1 u.",
               metavar="OLD", common=True),
    ] = None  # fmt: skip
    out: Annotated[
        Path | None,
        Option("Folder for page, PDF and result (default: validation-DATE).", metavar="DIR"),
    ] = None
    key: Annotated[Path | None, Option("Private key (Ed25519) that signs the seal.", metavar="FILE")] = None
    release: Annotated[
        Path | None,
        Option("Manifest of a release: the program and its packages must be those.", metavar="FILE"),
    ] = None
    release_key: Annotated[
        Path | None, Option("Public key (Ed25519) that must have signed the manifest.", metavar="FILE")
    ] = None
    laboratory: LaboratoryField = None
    accept: Annotated[
        Path | None,
        Option(
            "Accept the validation in DIR as authorised person: it is registered.", metavar="DIR", common=True
        ),
    ] = None
    withdraw: Annotated[str | None, Option("Withdraw the accepted validation NUMBER.", metavar="NUMBER")] = (
        None
    )
    by: Annotated[
        str | None, Option("Authorised person, as named in the laboratory file.", metavar="NAME", common=True)
    ] = None
    reason: Annotated[str | None, Option("Reason, for the register.", metavar="TEXT")] = None
    register: Annotated[bool, Option("List the register of validations.")] = False
    runs: RunsField = None
    catalogue: CatalogueField = None


class FailureState(StrEnum):
    """The state of a failure in the register."""

    OPEN = "open"
    REMEDIED = "remedied"
    CLOSED = "closed"


@dataclass(frozen=True, kw_only=True)
class Failures:
    """The register of failures: to be brought up to date from the records, amended, or shown for a year."""

    laboratory: LaboratoryField = None
    number: Annotated[
        str | None, Option("Failure whose state and remedy are noted.", metavar="NUMBER", common=True)
    ] = None
    state: Annotated[
        FailureState | None,
        Option("Its state: open, remedied or closed (by an authorised person).", common=True),
    ] = None
    remedy: Annotated[str | None, Option("Cause and remedy, in words.", metavar="TEXT", common=True)] = None
    by: Annotated[str | None, Option("Who notes it.", metavar="NAME", common=True)] = None
    year: Annotated[
        int | None, Option("Show the failures of this year only.", metavar="YYYY", common=True)
    ] = None
    page: Annotated[
        Path | None, Option("Write an HTML page, as for the management review.", metavar="FILE", common=True)
    ] = None
    runs: RunsField = None


# --- persons -----------------------------------------------------------------------------------------


class Right(StrEnum):
    """What a person may do; everybody may look, and stop a run.

    operate: carry out runs. supervise: also take control by force. authorise: issue certificates, accept
    validations, close failures. administer: change the register of persons.
    """

    OPERATE = "operate"
    SUPERVISE = "supervise"
    AUTHORISE = "authorise"
    ADMINISTER = "administer"


class PersonsCommand(StrEnum):
    """A change of the register of persons."""

    ADD = "add"
    CHANGE = "change"
    END = "end"


@dataclass(frozen=True)
class ChangePersons:
    """The register of persons of a laboratory, to be listed or changed."""

    what: Annotated[
        PersonsCommand | None,
        Option("add, change, or end (the rights of) a person (default: list all).", argument=True),
    ] = None
    name: Annotated[str | None, Option("Name of the person.", argument=True)] = None
    _: KW_ONLY
    role: Annotated[str | None, Option("Role in words, as on certificates.", metavar="TEXT", common=True)] = (
        None
    )
    may: Annotated[
        str | None,
        Option(
            "Rights, with commas: operate, supervise, authorise, administer.", metavar="RIGHTS", common=True
        ),
    ] = None
    token: Annotated[bool, Option("Make a new token and print it, this once.", ("--token",), common=True)] = (
        False
    )
    public_key: Annotated[
        Path | None, Option("Public key of the person (Ed25519, the .pub of 'bench key').", metavar="FILE")
    ] = None
    by: Annotated[str | None, Option("Administrator who makes the change.", metavar="NAME", common=True)] = (
        None
    )
    reason: Annotated[str | None, Option("Reason, for the register.", metavar="TEXT", common=True)] = None
    laboratory: LaboratoryField = None


# --- the panel ----------------------------------------------------------------------------------------


class PeopleCommand(StrEnum):
    """A command on access to the panel: make, list or revoke tokens, or make a one-time link."""

    TOKEN = "token"
    TOKENS = "tokens"
    REVOKE = "revoke"
    LINK = "link"


@dataclass(frozen=True)
class ServePanel:
    """The operator's panel over a folder of runs, to be served; or a command on access to it."""

    what: Annotated[
        PeopleCommand | None,
        Option(
            "token NAME makes a token, tokens lists tokens, revoke NAME revokes one, "
            "link makes a one-time link (for NAME) (default: serve the panel).",
            argument=True,
        ),
    ] = None
    name: Annotated[str | None, Option("Name of the person.", argument=True)] = None
    _: KW_ONLY
    role: Annotated[str, Option("Role of the person: viewer, operator or supervisor.", common=True)] = (
        "operator"
    )
    host: Annotated[str, Option("Address to listen on; other than loopback needs tokens.", common=True)] = (
        "127.0.0.1"
    )
    port: Annotated[int, Option("Port to listen on; 0 for a free one.", least=0, most=65535, common=True)] = (
        8741
    )
    address: Annotated[
        str, Option("Address of a TLS proxy in front, such as https://bench.lab.", metavar="URL")
    ] = ""
    laboratory: Annotated[
        Path | None,
        Option(
            "Laboratory file, beside which persons and certificates are registered.",
            metavar="FILE",
            environment="BENCH_LABORATORY",
        ),
    ] = None
    catalogue: Annotated[str, Option("Catalogue for the pages on units; read only.", metavar="FILE|URL")] = ""
    runs: RunsField = None
