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
            "Runs of the check block, or a folder of runs.",
            metavar="RUN…|DIR",
            argument=True,
            typed=list[str] | None,
        ),
    ] = None
    _: KW_ONLY
    bench: BenchField = None
    baseline: Annotated[int | None, Option("Number of runs in control for the baseline.", least=1)] = None
    arl: Annotated[float | None, Option("Mean number of runs between false alarms.")] = None
    smoothing: Annotated[float | None, Option("Smoothing factor λ of the EWMA.")] = None
    limits: Annotated[str | None, Option("Origin of the limits: stated, scaled or scatter.")] = None
    real: Annotated[
        bool | None,
        Option("Use only real or only simulated runs (default: as the latest).", ("--real/--simulated",)),
    ] = None
    folder: Annotated[
        str | Path | None,
        Option(
            "Folder of the runs (default: ./runs).",
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
            "Date of each source, in order, if it has none.",
            metavar="YYYY-MM-DD",
            typed=list[str] | None,
            common=True,
        ),
    ] = None


@dataclass(frozen=True)
class Monitor(OnReadings):
    """The control chart of a few positions over days."""

    sources: Annotated[
        Sequence[Data],
        Option("Runs of monitor-2 or monitor-4.", metavar="RUN…", argument=True, typed=list[str]),
    ]
    _: KW_ONLY
    baseline: Annotated[int, Option("Number of first runs that set the limits.", least=3, common=True)] = 5


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
        bool, Option("Estimate mean angles for each installation (brackets).", ("--by-installation",))
    ] = False
    expires: Annotated[
        date | str | None,
        Option(
            "Date or days until the file expires (default: 365 days).",
            metavar="DATE|DAYS",
            typed=str | None,
            common=True,
        ),
    ] = None


@dataclass(frozen=True)
class Stability:
    """Noise and drift of a record at rest."""

    record: Annotated[
        str,
        Option(
            "Static record (CSV: time_s,ux_v,uy_v,uz_v), record at a known input, or a run.",
            metavar="FILE",
            argument=True,
        ),
    ]
    _: KW_ONLY
    size: Annotated[
        float | None,
        Option(
            "Allowed noise of a reading, in the signals' unit (default: where it levels off).", common=True
        ),
    ] = None
    integration: Annotated[
        float | None,
        Option(
            "Integration time of the meter per sample (default: the whole interval).",
            metavar="S",
            common=True,
        ),
    ] = None
    model: ModelField = None
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class OfFleet:
    """Calibrations selected from a catalogue."""

    query: Annotated[
        Sequence[str] | None,
        Option(
            "Conditions KEY=VALUE, as in 'bench catalogue' (default: all).",
            metavar="QUERY…",
            argument=True,
            typed=list[str] | None,
        ),
    ] = None
    _: KW_ONLY
    catalogue: Annotated[
        str | None,
        Option(
            "Catalogue (default: TRIAXIAL_BENCH_CATALOGUE, or your own).", metavar="FILE|URL", common=True
        ),
    ] = None


@dataclass(frozen=True)
class CompareBenches(OfFleet):
    """A comparison of benches by units that several of them measured."""

    reference: Annotated[
        str | None,
        Option(
            "weighted-mean, mandel-paule or dersimonian-laird (default: the first if consistent, "
            "else the second).",
            common=True,
        ),
    ] = None


@dataclass(frozen=True)
class DriftOfUnit(OfFleet):
    """The drift of a unit."""

    at: Annotated[
        str | None, Option("Predict the coefficients at this date.", metavar="YYYY-MM-DD", common=True)
    ] = None


@dataclass(frozen=True)
class Capability(OfFleet):
    """The calibration and measurement capability of the laboratory."""

    quantile: Annotated[
        float,
        Option("Share of everyday calibrations that reach the CMC.", least=0.01, most=0.99, common=True),
    ] = 0.5
