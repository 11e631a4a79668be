"""Requests of a diagnosis, and of a name for what it found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import Data, Effects, ModelField, OnReadings


@dataclass(frozen=True)
class Diagnose(OnReadings):
    """Where readings and model disagree, and what is missing.

    With `write` everything is written that `bench diagnose` writes: beside the source, or into `out`.
    """

    source: Annotated[
        Data | Sequence[Data],
        Option(
            "Runs (name or path) or readings files.",
            metavar="SOURCE…",
            argument=True,
            completes="sources",
            typed=list[str],
        ),
    ]
    _: KW_ONLY
    one_block: Annotated[
        bool | None,
        Option(
            "With --together: whose runs they are (default: as names and readings say).",
            ("--one-block/--a-block-each",),
        ),
    ] = None
    accept_first: Annotated[
        bool, Option("Write the model also where the data cannot tell: with the likeliest effect.")
    ] = False
    report: Annotated[
        bool | None,
        Option("Write the page (default: for one source, not for several).", ("--report/--no-report",)),
    ] = None
    model: ModelField = None
    out: Annotated[
        str | Path | None,
        Option("Where to write what is derived from a file.", metavar="DIR", typed=Path | None),
    ] = None
    effects: Effects = None
    write: bool = False

    @property
    def sources(self) -> list[Data]:
        """The sources, of which there may be one alone."""
        return list(self.source) if isinstance(self.source, list | tuple) else [self.source]


@dataclass(frozen=True)
class Accept:
    """A name and a sentence for terms without a name."""

    model: Annotated[
        Path,
        Option("Model file with terms that have no name (unnamed_1, …).", metavar="MODEL", argument=True),
    ]
    _: KW_ONLY
    name: Annotated[str, Option("Name of the effect: small letters, digits, _.")]
    sentence: Annotated[str, Option("What it is, for reports.")]
    term: Annotated[
        list[str] | None,
        Option("A term that it is made of; several times (default: all that have no name)."),
    ] = None
    shown_by: Annotated[str | None, Option("Which measurement would show it.", metavar="TEXT")] = None
    out: Annotated[
        Path | None,
        Option("Where the effect is written (default: NAME.yaml beside MODEL).", metavar="FILE"),
    ] = None
