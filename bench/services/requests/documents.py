"""Requests for the catalogue, batches, certificates and the panel."""

from __future__ import annotations

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
        "The catalogue: a file, or postgresql://USER@HOST/NAME (default: in the user's cache folder).",
        metavar="FILE|URL",
        environment="TRIAXIAL_BENCH_CATALOGUE",
    ),
]
QueryField = Annotated[
    list[str] | None,
    Option("What has to hold; 'bench catalogue keys' lists the keys.", metavar="[KEY=VALUE…]", argument=True),
]


@dataclass(frozen=True)
class Sync:
    """The synchronisation of the catalogue with run folders."""

    folders: Annotated[
        list[Path], Option("Folders with run folders, at any depth.", metavar="DIR…", argument=True)
    ]
    _: KW_ONLY
    verify: Annotated[bool, Option("Read every event of each record, not only the hashes of its lines.")] = (
        False
    )
    due: Annotated[
        bool,
        Option("Then reckon when the units of what changed are due, so that 'due' answers at once."),
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
        ),
    ] = "runs"
    csv: Annotated[Path | None, Option("Write all columns and rows as CSV.", metavar="FILE")] = None
    parquet: Annotated[Path | None, Option("Write them as Parquet.", metavar="FILE")] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class _Dated:
    limit: Annotated[
        float | None,
        Option("Error allowed, in g at 1 g (default: its last verification's).", metavar="G"),
    ] = None
    interval: Annotated[
        float | None, Option("Counts where a history is too short (default: 365).", metavar="DAYS")
    ] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True)
class Unit(_Dated):
    """The history of a unit: its coefficients over time, its runs, its due date."""

    name: Annotated[str, Option("Serial number, or type and serial number.", metavar="UNIT", argument=True)]
    _: KW_ONLY
    page: Annotated[Path | None, Option("Write its page (HTML).", metavar="FILE")] = None


@dataclass(frozen=True)
class DueUnits(_Dated):
    """The due dates of units, predicted from their drift."""

    query: QueryField = None
    _: KW_ONLY
    before: Annotated[str | None, Option("Those that are due before that day.", metavar="YYYY-MM-DD")] = None


# --- batches: the same work over many runs ------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Batch(OnReadings):
    """Many runs to be evaluated anew; the results are written into a folder."""

    over: Annotated[
        list[str],
        Option(
            "Which runs: a pattern of paths ('runs/*'), or words of a query of the catalogue ('unit=Q-17'); may be "
            "given several times.",
            metavar="QUERY|GLOB",
        ),
    ]
    out: Annotated[Path, Option("Folder of the batch; the same command goes on with it.", metavar="FOLDER")]
    model: ModelField = None
    workers: Annotated[
        int | None, Option("Processes on this machine (default: one a core).", metavar="N", least=1)
    ] = None
    scheduler: Annotated[
        str | None,
        Option(
            "Dask scheduler whose workers compute, in place of processes here: tcp://host:8786.",
            metavar="ADDRESS",
        ),
    ] = None
    catalogue: CatalogueField = None


@dataclass(frozen=True, kw_only=True)
class BatchCalibrate(Batch):
    """Coefficients and verdicts of many runs, computed anew."""

    estimator: EstimatorField = "gls"
    nominal_angles: NominalField = False
    join_free: JoinFreeField = True
    join_verification: JoinVerificationField = False
    limit: LimitField = None
    rule: RuleField = None
    guard_band: GuardBandField = None
    strict: Annotated[bool, Option("A fit that is judged otherwise is not accepted, either.")] = False


@dataclass(frozen=True, kw_only=True)
class BatchDiagnose(Batch):
    """Diagnoses of many runs, computed anew."""

    strict: Annotated[bool, Option("Other names under the same verdict are not accepted, either.")] = False


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
    Option("Laboratory file; 'bench init' has one.", metavar="FILE", environment="BENCH_LABORATORY"),
]
AuthorisedField = Annotated[
    str | None, Option("Who authorises, as the laboratory file has it.", metavar="NAME")
]
NumberField = Annotated[str, Option("Number of a certificate.", argument=True)]
ReasonField = Annotated[str, Option("Why; it is written down.", metavar="TEXT")]


@dataclass(frozen=True, kw_only=True)
class Issuing:
    """The laboratory, order, signatory and key with which certificates are issued."""

    laboratory: LaboratoryField = None
    order: Annotated[Path | None, Option("Order file; 'bench init' has one.", metavar="FILE")] = None
    authorised_by: AuthorisedField = None
    key: Annotated[
        str | None, Option("Key to sign with: a file (PEM), or pkcs11:… of one in a token.", metavar="KEY")
    ] = None
    chain: Annotated[
        Path | None, Option("Certificates of the key (PEM), where not beside it.", metavar="FILE")
    ] = None
    schema: Annotated[
        Path | None,
        Option("The institute's schemas (DCC 3.3.0, D-SI 2.2.1): checked against.", metavar="DIR"),
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class IssueCertificates(Issuing):
    """The certificates of runs, each issued once."""

    names: Annotated[
        list[str], Option("Runs, by name or path.", metavar="RUN…", argument=True, completes="runs")
    ]
    _: KW_ONLY
    draft: Annotated[bool, Option("A draft with a water mark; needs neither laboratory nor order.")] = False
    out: Annotated[Path | None, Option("Where drafts go (default: the run's folder).", metavar="DIR")] = None


@dataclass(frozen=True)
class AmendCertificate(Issuing):
    """A certificate that replaces a valid one."""

    number: NumberField
    run: RunField
    _: KW_ONLY
    reason: ReasonField
    replace: Annotated[bool, Option("It replaces the other as a whole: another run, other results.")] = False


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

    number: Annotated[str | None, Option("One certificate; all if left out.", argument=True)] = None
    _: KW_ONLY
    laboratory: LaboratoryField = None
    out: Annotated[
        Path | None, Option("Hand the files of NUMBER out again, into a folder.", metavar="DIR")
    ] = None
    again: Annotated[
        bool, Option("Make the unsigned certificates from their records again, and compare.")
    ] = False
    runs: RunsField = None


@dataclass(frozen=True)
class VerifyCertificate:
    """A check of a certificate: its integrity, its signature and whether it is still valid."""

    file: Annotated[
        Path, Option("Certificate, PDF or XML; the other form is found beside it.", argument=True)
    ]
    _: KW_ONLY
    trust: Annotated[
        Path | None,
        Option("Certificates (PEM) of signers or authorities that are believed.", metavar="FILE"),
    ] = None
    laboratory: Annotated[
        Path | None,
        Option("Laboratory file: its register is asked (default: the one beside FILE).", metavar="FILE"),
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class ReadCertificate:
    """A certificate whose coefficients and covariance are to be read."""

    file: Annotated[
        Path,
        Option("Digital calibration certificate, anybody's: XML, or the PDF that has it.", argument=True),
    ]
    _: KW_ONLY
    out: Annotated[
        Path | None,
        Option("Where the coefficients go, for verify --coefficients and compare.", metavar="FILE"),
    ] = None
    g: Annotated[
        float | None, Option("Local gravity for which K of another's is stated.", metavar="M/S2")
    ] = None
    noise: Annotated[
        str | None, Option("Noise of a reading, '50 uV', where the maker is another.", metavar="VOLTAGE")
    ] = None


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
            "token NAME makes a person's token, tokens lists, revoke NAME takes it back; link makes a one-time "
            "link. Left out: the panel itself.",
            argument=True,
        ),
    ] = None
    name: Annotated[str | None, Option("Of which person.", argument=True)] = None
    _: KW_ONLY
    role: Annotated[str, Option("viewer, operator or supervisor.")] = "operator"
    host: Annotated[str, Option("Where to listen; beyond loopback only with tokens.")] = "127.0.0.1"
    port: Annotated[int, Option("0 takes a free one.", least=0, most=65535)] = 8741
    address: Annotated[
        str, Option("Address of a proxy with TLS before it, such as https://bench.lab.", metavar="URL")
    ] = ""
    laboratory: Annotated[
        Path | None,
        Option("Laboratory file, whose register holds the certificates of the runs.", metavar="FILE"),
    ] = None
    catalogue: Annotated[
        str, Option("Catalogue, which its pages on units show; only read.", metavar="FILE|URL")
    ] = ""
    runs: RunsField = None
