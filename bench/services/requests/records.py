"""Requests on the records of runs: to list, show, seal, export, import, abort and control them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option, option
from bench.services.requests.shared import BenchField, LatestField, OperatorField, RunField, RunsField


@dataclass(frozen=True, kw_only=True)
class ListRuns:
    """Options of `bench runs`: list the runs of a folder."""

    runs: RunsField = None


@dataclass(frozen=True)
class ShowRun:
    """Options of `bench show`: the content of a run, and with `verify` or a key the evidence for its record."""

    run: RunField
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
    runs: RunsField = None

    @property
    def proved(self) -> bool:
        """Whether the evidence for the record is requested."""
        return self.verify or any(given is not None for given in (self.head, self.key, self.authority))


@dataclass(frozen=True)
class SealRun:
    """Options of `bench seal`: seal a run that has ended."""

    run: RunField
    _: KW_ONLY
    key: Path | None = option(None, "Private key for the signature; 'bench key' makes one.")
    timestamp: str | None = option(None, "Server for the time stamp (RFC 3161).", metavar="URL")
    runs: RunsField = None


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

    run: RunField
    _: KW_ONLY
    csv: str | None = option(None, "Readings file (default: RUN.csv); - for standard output.", metavar="FILE")
    runs: RunsField = None


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
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class AbortRun:
    """Options of `bench abort`: end an interrupted run for good."""

    name: LatestField = None
    _: KW_ONLY
    operator: OperatorField = ""
    runs: RunsField = None


@dataclass(frozen=True)
class ControlRun:
    """Options of `bench control`: send a command such as pause or skip to the program that carries out a run."""

    run: RunField
    wish: Annotated[
        str,
        Option("pause, continue, redo (the point), redo-pass, remount, skip, stop or abort.", argument=True),
    ]
    reason: str = option("", "Reason, for the record; required for skip.", argument=True)
    _: KW_ONLY
    operator: OperatorField = ""
    runs: RunsField = None
