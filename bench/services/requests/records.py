"""Requests on the records of runs: to list, show, seal, export, import, abort and control them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import BenchField, LatestField, RunField, RunsField


@dataclass(frozen=True, kw_only=True)
class ListRuns:
    """The runs of a folder."""

    runs: RunsField = None


@dataclass(frozen=True)
class ShowRun:
    """The content of a run; with `verify`, or a head, key or authority, also the evidence for its record."""

    run: RunField
    _: KW_ONLY
    verify: Annotated[bool, Option("Check the record for changed lines.", ("--verify",))] = False
    head: Annotated[str | None, Option("Head of the chain, as noted elsewhere.", metavar="SHA256")] = None
    key: Annotated[Path | None, Option("Public key that the seal must be signed with.", metavar="PUB")] = None
    authority: Annotated[
        Path | None, Option("Certificate that its time stamp must stand on.", metavar="PEM")
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
        Path | None, Option("Private key to sign with ('bench key' makes it).", metavar="FILE")
    ] = None
    timestamp: Annotated[str | None, Option("Server that stamps the time (RFC 3161).", metavar="URL")] = None
    runs: RunsField = None


@dataclass(frozen=True)
class MakeKey:
    """A key of the laboratory: for seals, or for certificates."""

    file: Annotated[
        Path, Option("Where the private key is written; the public one is FILE.pub.", argument=True)
    ]
    _: KW_ONLY
    passphrase: Annotated[
        bool, Option("Ask for a passphrase that covers the private key.", ("--passphrase",))
    ] = False
    certificate: Annotated[
        str | None,
        Option(
            "Make one that signs certificates (P-256) in place of seals, and beside it FILE.crt: an X.509 "
            "certificate in the laboratory's name, signed by itself.",
            metavar="NAME",
        ),
    ] = None


@dataclass(frozen=True)
class ExportReadings:
    """The readings of a run as a readings file."""

    run: RunField
    _: KW_ONLY
    csv: Annotated[str, Option("File; - is standard output.", metavar="FILE")]
    runs: RunsField = None


@dataclass(frozen=True)
class ImportReadings:
    """A readings file measured elsewhere, to be imported as a run."""

    file: Annotated[Path, Option("Readings file.", argument=True)]
    _: KW_ONLY
    name: Annotated[str | None, Option("Name of the run (default: the file's).")] = None
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class AbortRun:
    """An interrupted run, to be aborted."""

    name: LatestField = None
    _: KW_ONLY
    runs: RunsField = None


@dataclass(frozen=True)
class ControlRun:
    """A command such as pause or skip to the program that carries out a run."""

    run: RunField
    wish: Annotated[
        str,
        Option("pause, continue, redo (the point), redo-pass, remount, skip, stop, abort.", argument=True),
    ]
    reason: Annotated[str, Option("Why; a skip needs it.", argument=True)] = ""
    _: KW_ONLY
    runs: RunsField = None
