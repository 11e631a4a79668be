"""Requests that evaluate readings, of one measurement or of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Protocol

from bench.base.requests import Option, option
from bench.services.requests import shared


class Calibrated(Protocol):
    """The result of a calibration, in memory."""

    @property
    def calibration(self) -> Any:
        """The estimated calibration."""


Given = str | Path | Calibrated | None
"""Coefficients of an earlier calibration: the path of a result of `bench calibrate --json`, or a result in
memory."""

SourceField = Annotated[
    shared.Data, Option("Run (name or path) or readings file.", argument=True, completes="sources")
]
_SOURCES = Option(
    "Runs (name or path) or readings files.",
    metavar="SOURCE…",
    argument=True,
    completes="sources",
    typed=list[str],
)
SourcesField = Annotated[Sequence[shared.Data], _SOURCES]
SeveralField = Annotated[shared.Data, replace(_SOURCES, typed=str)]


@dataclass(frozen=True)
class Calibrate(shared.OnReadings):
    """Options of `bench calibrate`: estimate the coefficients of a block from readings."""

    source: SeveralField
    _: KW_ONLY
    model: shared.ModelField = None
    effects: shared.Effects = None
    estimator: shared.EstimatorField = "gls"
    nominal_angles: shared.NominalField = False
    join_free: shared.JoinFreeField = True
    join_verification: shared.JoinVerificationField = False
    prior: str | Path | None = option(
        None, "Prior for units of this type, from 'bench fleet prior'.", rare=True
    )

    @property
    def otherwise(self) -> bool:
        """Whether an option (other than the model) gives other coefficients than those that a run stores."""
        usual = (self.estimator, self.nominal_angles, self.join_free, self.join_verification, self.prior)
        return usual != ("gls", False, True, False, None)


@dataclass(frozen=True, kw_only=True)
class Judging(shared.OnReadings):
    """Options of a verdict, which replace those of the bench file."""

    model: shared.ModelField = None
    limit: shared.LimitField = None
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    population: shared.PopulationField = None


@dataclass(frozen=True)
class Verify(Judging):
    """Options of `bench verify`: compare Δg at the verification points with the limit."""

    source: SeveralField
    _: KW_ONLY
    effects: shared.Effects = None
    coefficients: Given = option(
        None, "Earlier result of 'calibrate --json' to verify with.", metavar="FILE", typed=Path | None
    )


@dataclass(frozen=True)
class Report(Judging):
    """Options of `bench report`: write the report of a calibration."""

    source: SourceField


@dataclass(frozen=True)
class Coefficients(shared.OnReadings):
    """Options of `bench coefficients`: write calibrations in the forms of navigation software."""

    sources: Annotated[
        Sequence[str],
        Option("Results of calibrate --json, runs or readings files.", metavar="SOURCE…", argument=True),
    ]
    _: KW_ONLY
    model: shared.ModelField = None
    forms: Sequence[str] | None = option(
        None,
        "json, csv, c, excel, kalibr, px4, ardupilot or all; repeatable (default: json).",
        flags=("--as",),
        metavar="FORM",
    )
    nominal: str | None = option(
        None,
        "Nominal scale factors, unit/g (9.80665 m/s²), for kalibr, px4 and ardupilot "
        "(default: the block's, rounded).",
        metavar="X,Y,Z",
        rare=True,
    )
    without_temperature: bool = option(
        False, "Write a result without its temperature correction; the file says so.", rare=True
    )


@dataclass(frozen=True)
class Compensate(shared.OnReadings):
    """Options of `bench compensate`: fit coefficients over temperature."""

    sources: SourcesField
    _: KW_ONLY
    reference: float = option(23.0, "Reference temperature of the polynomials.", metavar="DEGC")
    degree: str = option("auto", "Degree of all polynomials, or chosen from the data.", metavar="auto|N")
    step: float | None = option(
        None, "Temperature step of the table (default: from u).", metavar="K", rare=True
    )


@dataclass(frozen=True)
class Tumble(shared.OnReadings):
    """Options of `bench tumble`: estimate the IEEE 1293 model terms of each axis."""

    sources: SourcesField
    _: KW_ONLY
    terms: str = option(
        "K2,K3,Koq",
        "Nonlinear terms from K2, K3, Koq, Kip, Kio, Kpo, Kpp, Koo, K0p (K0′), K1p (K1′).",
        metavar="TERM,…",
    )
    centrifuge: str | Path | None = option(
        None, "Points above 1 g that join the fit (CSV: ax_ms2, …, u_ms2, u_relative, ux_v, …).", rare=True
    )


@dataclass(frozen=True)
class Confirm(shared.OnReadings):
    """Options of `bench confirm`: test on new readings a model that was found in other readings."""

    source: Annotated[
        shared.Data,
        Option("New readings: a run or a readings file.", metavar="NEW", argument=True, completes="sources"),
    ]
    _: KW_ONLY
    model: Annotated[
        str | Path, Option("Model file that 'diagnose' found in other readings.", metavar="FOUND")
    ]


@dataclass(frozen=True)
class Diagnose(shared.OnReadings):
    """Options of `bench diagnose`: find where readings and model disagree, and which effect is missing.

    With `write`, all files of `bench diagnose` are written: beside the source, or into `out`.
    """

    source: Annotated[shared.Data | Sequence[shared.Data], _SOURCES]
    _: KW_ONLY
    one_block: bool | None = option(
        None,
        "With --together: all runs of one block, or each of another (default: by names and readings).",
        flags=("--one-block/--a-block-each",),
        rare=True,
    )
    accept_first: bool = option(
        False, "If the data cannot decide, write the model with the likeliest effect."
    )
    report: bool | None = option(
        None,
        "Write the HTML page (default: for a single source).",
        flags=("--report/--no-report",),
        rare=True,
    )
    model: shared.ModelField = None
    out: str | Path | None = option(None, "Folder for the result files.", metavar="DIR")
    effects: shared.Effects = None
    write: bool = False

    @property
    def sources(self) -> list[shared.Data]:
        """The sources as a list, also if there is only one."""
        return list(self.source) if isinstance(self.source, list | tuple) else [self.source]


@dataclass(frozen=True)
class Accept:
    """Options of `bench accept`: give a name and a description to unnamed terms of a model file."""

    model: Annotated[
        Path, Option("Model file with unnamed terms (unnamed_1, …).", metavar="MODEL", argument=True)
    ]
    _: KW_ONLY
    name: Annotated[str, Option("Name of the effect: lower-case letters, digits, _.")]
    sentence: Annotated[str, Option("Description of the effect, for reports.")]
    term: list[str] | None = option(None, "Term of the effect; repeatable (default: all unnamed terms).")
    shown_by: str | None = option(None, "Measurement that would show the effect.", metavar="TEXT", rare=True)
    out: Path | None = option(None, "File for the effect (default: NAME.yaml beside MODEL).")


# --- many measurements -----------------------------------------------------------------------------------


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
    bench: shared.BenchField = None
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
class Compare(shared.OnReadings):
    """Options of `bench compare`: compare calibrations of one block."""

    sources: Annotated[
        Sequence[shared.Data],
        Option("Results of calibrate --json, runs or readings files.", metavar="A B…", argument=True),
    ]
    _: KW_ONLY
    date: Sequence[str] | None = option(
        None, "Date of each source, in order, instead of its own.", metavar="YYYY-MM-DD"
    )


@dataclass(frozen=True)
class Monitor(shared.OnReadings):
    """Options of `bench monitor`: chart a few positions over days."""

    sources: Annotated[
        Sequence[shared.Data], Option("Runs of monitor-2 or monitor-4.", metavar="RUN…", argument=True)
    ]
    _: KW_ONLY
    baseline: int = option(5, "Number of first runs that set the limits.", least=3)


@dataclass(frozen=True)
class Learn(shared.OnReadings):
    """Options of `bench learn`: estimate a bench's errors from many of its runs."""

    sources: Annotated[
        Sequence[shared.Data],
        Option("Runs (name or path) or readings files of one bench.", metavar="RUN…", argument=True),
    ]
    _: KW_ONLY
    model: shared.ModelField = None
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
    model: shared.ModelField = None
    bench: shared.BenchField = None
    runs: shared.RunsField = None


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
