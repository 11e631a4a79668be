"""Requests on many measurements: control charts, comparisons, learning, stability, the fleet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option, option
from bench.services.requests.shared import BenchField, Data, ModelField, OnReadings, RunsField


@dataclass(frozen=True)
class Chart:
    """Options of `bench chart`: draw the control charts of a check block."""

    runs: str | Path | Sequence[str | Path] | None = option(
        None,
        "Runs of the check block, or a folder of runs.",
        metavar="RUN…|DIR",
        argument=True,
        typed=list[str] | None,
    )
    _: KW_ONLY
    bench: BenchField = None
    baseline: int | None = option(None, "Number of runs in control for the baseline.", least=1, rare=True)
    arl: float | None = option(None, "Mean number of runs between false alarms.", rare=True)
    smoothing: float | None = option(None, "Smoothing factor λ of the EWMA.", rare=True)
    limits: str | None = option(None, "Origin of the limits: stated, scaled or scatter.", rare=True)
    real: bool | None = option(
        None,
        "Use only real or only simulated runs (default: as the latest).",
        flags=("--real/--simulated",),
        rare=True,
    )
    folder: str | Path | None = option(
        None,
        "Folder of the runs (default: ./runs).",
        flags=("--runs",),
        metavar="DIR",
        environment="BENCH_RUNS",
        rare=True,
    )


@dataclass(frozen=True)
class Compare(OnReadings):
    """Options of `bench compare`: compare calibrations of one block."""

    sources: Annotated[
        Sequence[Data],
        Option("Results of calibrate --json, runs or readings files.", metavar="A B…", argument=True),
    ]
    _: KW_ONLY
    date: Sequence[str] | None = option(
        None, "Date of each source, in order, instead of its own.", metavar="YYYY-MM-DD"
    )


@dataclass(frozen=True)
class Monitor(OnReadings):
    """Options of `bench monitor`: chart a few positions over days."""

    sources: Annotated[
        Sequence[Data], Option("Runs of monitor-2 or monitor-4.", metavar="RUN…", argument=True)
    ]
    _: KW_ONLY
    baseline: int = option(5, "Number of first runs that set the limits.", least=3)


@dataclass(frozen=True)
class Learn(OnReadings):
    """Options of `bench learn`: estimate a bench's errors from many of its runs."""

    sources: Annotated[
        Sequence[Data],
        Option("Runs (name or path) or readings files of one bench.", metavar="RUN…", argument=True),
    ]
    _: KW_ONLY
    model: ModelField = None
    by_installation: bool = option(False, "Estimate mean angles for each installation (brackets).", rare=True)
    expires: date | str | None = option(
        None,
        "Date or days until the file expires (default: 365 days).",
        metavar="DATE|DAYS",
        typed=str | None,
    )


@dataclass(frozen=True)
class Stability:
    """Options of `bench stability`: estimate noise and drift of a record at rest."""

    record: Annotated[
        str,
        Option(
            "Static record (CSV: time_s,ux_v,uy_v,uz_v), record at a known input, or a run.",
            metavar="FILE",
            argument=True,
        ),
    ]
    _: KW_ONLY
    size: float | None = option(
        None, "Allowed noise of a reading, in the signals' unit (default: where longer averages gain little)."
    )
    integration: float | None = option(
        None, "Integration time of the meter per sample (default: the whole interval).", metavar="S"
    )
    model: ModelField = None
    bench: BenchField = None
    runs: RunsField = None


@dataclass(frozen=True)
class OfFleet:
    """Options of every `bench fleet`: select calibrations from a catalogue."""

    query: Sequence[str] | None = option(
        None, "Conditions KEY=VALUE, as in 'bench catalogue' (default: all).", metavar="QUERY…", argument=True
    )
    _: KW_ONLY
    catalogue: str | None = option(
        None, "Catalogue (default: TRIAXIAL_BENCH_CATALOGUE, or your own).", metavar="FILE|URL"
    )


@dataclass(frozen=True)
class CompareBenches(OfFleet):
    """Options of `bench fleet compare`: compare benches by units that several of them measured."""

    reference: str | None = option(
        None,
        "weighted-mean, mandel-paule or dersimonian-laird (default: the first if consistent, "
        "else the second).",
    )


@dataclass(frozen=True)
class DriftOfUnit(OfFleet):
    """Options of `bench fleet drift`: estimate the drift of a unit."""

    at: str | None = option(None, "Predict the coefficients at this date.", metavar="YYYY-MM-DD")


@dataclass(frozen=True)
class Capability(OfFleet):
    """Options of `bench fleet cmc`: estimate the laboratory's calibration and measurement capability."""

    quantile: float = option(0.5, "Share of everyday calibrations that reach the CMC.", least=0.01, most=0.99)
