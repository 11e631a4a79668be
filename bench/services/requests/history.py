"""Requests on many measurements: control charts, comparisons, learning, stability, the fleet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import BenchField, Data, ModelField, OnReadings, RunsField


@dataclass(frozen=True)
class Chart:
    """The control charts of a check block."""

    runs: Annotated[
        str | Path | Sequence[str | Path] | None,
        Option(
            "Runs of the check block, or a folder of runs in which they are.",
            metavar="RUN…|DIR",
            argument=True,
            typed=list[str] | None,
        ),
    ] = None
    _: KW_ONLY
    bench: BenchField = None
    baseline: Annotated[int | None, Option("How many runs in control say what the block is.", least=1)] = None
    arl: Annotated[float | None, Option("Mean number of runs between false alarms.")] = None
    smoothing: Annotated[float | None, Option("λ of the EWMA.")] = None
    limits: Annotated[str | None, Option("What limits are from: stated, scaled or scatter.")] = None
    real: Annotated[
        bool | None,
        Option("Which runs of a folder, where it has both (default: the latest's).", ("--real/--simulated",)),
    ] = None
    folder: Annotated[
        str | Path | None,
        Option(
            "Folder in which runs live (default: ./runs).",
            ("--runs",),
            metavar="DIR",
            environment="BENCH_RUNS",
            typed=Path | None,
        ),
    ] = None


@dataclass(frozen=True)
class Compare(OnReadings):
    """A comparison of calibrations of one block."""

    sources: Annotated[
        Sequence[Data],
        Option(
            "Results of calibrate --json, runs or readings files.",
            metavar="A B…",
            argument=True,
            typed=list[str],
        ),
    ]
    _: KW_ONLY
    date: Annotated[
        Sequence[str] | None,
        Option(
            "Date of each, in their order, where they do not say it.",
            metavar="YYYY-MM-DD",
            typed=list[str] | None,
        ),
    ] = None


@dataclass(frozen=True)
class Learn(OnReadings):
    """The estimation of a bench's errors from many of its runs."""

    sources: Annotated[
        Sequence[Data],
        Option(
            "Runs (name or path) or readings files of one bench.",
            metavar="RUN…",
            argument=True,
            typed=list[str],
        ),
    ]
    _: KW_ONLY
    model: ModelField = None
    by_installation: Annotated[
        bool, Option("Each installation has mean angles of its own (brackets).", ("--by-installation",))
    ] = False
    expires: Annotated[
        date | str | None,
        Option("Until when it counts (default: 365 days).", metavar="DATE|DAYS", typed=str | None),
    ] = None


@dataclass(frozen=True)
class Stability:
    """Noise and drift of a record at rest."""

    record: Annotated[
        str,
        Option(
            "Static record (CSV: time_s,ux_v,uy_v,uz_v), or a run.",
            metavar="FILE",
            argument=True,
        ),
    ]
    _: KW_ONLY
    size: Annotated[
        float | None,
        Option("Noise that a reading may have, unit of the signals (default: where it flattens)."),
    ] = None
    integration: Annotated[
        float | None,
        Option("How long the meter integrated for each sample (default: all the time).", metavar="S"),
    ] = None
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class OfFleet:
    """Calibrations selected from a catalogue."""

    query: Annotated[
        Sequence[str] | None,
        Option(
            "Which calibrations: KEY=VALUE, as of 'bench catalogue'; all if none.",
            metavar="QUERY…",
            argument=True,
            typed=list[str] | None,
        ),
    ] = None
    _: KW_ONLY
    catalogue: Annotated[
        str | None,
        Option("Catalogue (default: TRIAXIAL_BENCH_CATALOGUE, or the own).", metavar="FILE|URL"),
    ] = None


@dataclass(frozen=True)
class CompareBenches(OfFleet):
    """A comparison of benches by units that several of them measured."""

    reference: Annotated[
        str | None,
        Option(
            "weighted-mean, mandel-paule or dersimonian-laird (default: the first where it holds, else the "
            "second)."
        ),
    ] = None


@dataclass(frozen=True)
class DriftOfUnit(OfFleet):
    """The drift of a unit."""

    at: Annotated[str | None, Option("Foretell the coefficients at this date.", metavar="YYYY-MM-DD")] = None


@dataclass(frozen=True)
class Capability(OfFleet):
    """The calibration and measurement capability of the laboratory."""

    quantile: Annotated[
        float, Option("Share of everyday calibrations that reach it.", least=0.01, most=0.99)
    ] = 0.5
