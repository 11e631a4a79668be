"""Requests on the records of runs: to list, show, seal, export, import, abort and control them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import BenchField, LatestField, OperatorField, RunField, RunsField


@dataclass(frozen=True, kw_only=True)
class ListRuns:
    """The runs of a folder."""

    runs: RunsField = None


@dataclass(frozen=True)
class ShowRun:
    """The content of a run; with `verify`, or a head, key or authority, also the evidence for its record."""

    run: RunField
    _: KW_ONLY
    verify: Annotated[bool, Option("Check the record for changed lines.", ("--verify",), common=True)] = False
    head: Annotated[
        str | None, Option("Check that the chain ends with this head, noted elsewhere.", metavar="SHA256")
    ] = None
    key: Annotated[
        Path | None, Option("Check the signature of the seal with this public key.", metavar="PUB")
    ] = None
    authority: Annotated[
        Path | None, Option("Check the time stamp with this certificate.", metavar="PEM")
    ] = None
    runs: RunsField = None

    @property
    def proved(self) -> bool:
        """Whether the evidence for the record is asked for."""
        return self.verify or any(given is not None for given in (self.head, self.key, self.authority))


@dataclass(frozen=True)
class SealRun:
    """A run that has ended, to be sealed."""

    run: RunField
    _: KW_ONLY
    key: Annotated[
        Path | None,
        Option("Private key for the signature; 'bench key' makes one.", metavar="FILE", common=True),
    ] = None
    timestamp: Annotated[
        str | None, Option("Server for the time stamp (RFC 3161).", metavar="URL", common=True)
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class MakeKey:
    """A key of the laboratory: for seals, or for certificates."""

    file: Annotated[
        Path, Option("File for the private key; the public key is written to FILE.pub.", argument=True)
    ]
    _: KW_ONLY
    passphrase: Annotated[
        bool, Option("Ask for a passphrase to encrypt the private key.", ("--passphrase",), common=True)
    ] = False
    certificate: Annotated[
        str | None,
        Option(
            "Make a key for certificates (P-256) and FILE.crt, a self-signed X.509 certificate with this name.",
            metavar="NAME",
            common=True,
        ),
    ] = None


@dataclass(frozen=True)
class ExportReadings:
    """The readings of a run as a readings file."""

    run: RunField
    _: KW_ONLY
    csv: Annotated[
        str | None,
        Option("Readings file (default: RUN.csv); - for standard output.", metavar="FILE", common=True),
    ] = None
    runs: RunsField = None


@dataclass(frozen=True)
class ImportReadings:
    """A readings file measured elsewhere, or with `columns` a log of another program, to be imported as a run."""

    file: Annotated[Path, Option("Readings file.", argument=True)]
    _: KW_ONLY
    name: Annotated[str | None, Option("Name of the run (default: the file's).", common=True)] = None
    columns: Annotated[
        Path | None,
        Option("Mapping of the columns of a stranger's log, as YAML.", metavar="FILE", common=True),
    ] = None
    preview: Annotated[bool, Option("Show the first rows as they would be imported, and import nothing.")] = (
        False
    )
    skip_bad_rows: Annotated[bool, Option("Leave out rows of a log that cannot be read.")] = False
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class AbortRun:
    """An interrupted run, to be aborted."""

    name: LatestField = None
    _: KW_ONLY
    operator: OperatorField = ""
    runs: RunsField = None


@dataclass(frozen=True)
class ControlRun:
    """A command such as pause or skip to the program that carries out a run."""

    run: RunField
    wish: Annotated[
        str,
        Option("pause, continue, redo (the point), redo-pass, remount, skip, stop or abort.", argument=True),
    ]
    reason: Annotated[str, Option("Reason, for the record; required for skip.", argument=True)] = ""
    _: KW_ONLY
    operator: OperatorField = ""
    runs: RunsField = None
