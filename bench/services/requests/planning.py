"""Requests before a measurement: check of a procedure, budget, requirements on the bench, test points."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import ESTIMATORS_IN_A_BUDGET, Option
from bench.services.requests.shared import (
    BenchField,
    GravityField,
    GuardBandField,
    LimitField,
    ModelField,
    RuleField,
    RunsField,
    UntilField,
)

ProcedureField = Annotated[
    str, Option("Procedure, by path or shipped name.", metavar="FILE", completes="procedures")
]
EstimatorField = Annotated[str, Option(ESTIMATORS_IN_A_BUDGET)]
UpToField = Annotated[str | None, Option("Largest acceleration, such as 5g (default: the block's range).")]


@dataclass(frozen=True)
class Check:
    """A check of a procedure against a bench."""

    procedure: Annotated[
        str, Option("Procedure file, by path or shipped name.", argument=True, completes="procedures")
    ]
    _: KW_ONLY
    bench: BenchField = None
    until: UntilField = None
    runs: RunsField = None


@dataclass(frozen=True)
class Init:
    """Copies of the shipped files."""

    folder: Annotated[Path, Option("Folder to write into.", argument=True)] = Path()


@dataclass(frozen=True)
class Budget:
    """An uncertainty budget: the contribution of each error of a bench."""

    bench: BenchField = None
    procedure: ProcedureField = "calibration"
    estimator: EstimatorField = "gls"
    _: KW_ONLY
    model: ModelField = None
    coefficients: Annotated[
        str | Path | None,
        Option(
            "Block as 'calibrate --json' found it, not the bench file's.", metavar="FILE", typed=Path | None
        ),
    ] = None
    trials: Annotated[int, Option("Monte Carlo trials beside the linear result; 0 for none.", least=0)] = (
        20_000
    )
    rule: RuleField = None
    guard_band: GuardBandField = None
    limit: LimitField = None
    same_voltmeters: Annotated[
        bool, Option("The block is used with the calibration's voltmeters.", ("--same-voltmeters",))
    ] = False
    g: GravityField = None


@dataclass(frozen=True, kw_only=True)
class Require:
    """Requirements on the errors of a bench for a given accuracy."""

    accuracy: Annotated[str, Option("What k u must keep to: g (of a coefficient V/g or V).")]
    of: Annotated[
        str, Option("delta-g, acceleration (its vector), modulus, or a coefficient such as Kyx.")
    ] = "delta-g"
    up_to: UpToField = None
    k: Annotated[float, Option("How many standard uncertainties the accuracy is.")] = 3.0
    with_reading: Annotated[
        bool,
        Option(
            "The errors of the reading in use count, not the coefficients' alone.", flags=("--with-reading",)
        ),
    ] = False
    all_errors: Annotated[
        bool,
        Option(
            "So do gain, gravity, temperature, nonlinearity, which no reading shows.", flags=("--all-errors",)
        ),
    ] = False
    share: Annotated[str, Option("Limits together: equal parts of the variance, or cost.")] = "equal"
    cost: Annotated[
        list[str] | None, Option("Cost of making an error small (default 1).", metavar="NAME=WEIGHT")
    ] = None
    estimator: EstimatorField = "gls"
    procedure: ProcedureField = "calibration"
    bench: BenchField = None


@dataclass(frozen=True, kw_only=True)
class PlanPoints:
    """A search for the test points that reach an uncertainty."""

    bench: BenchField = None
    u: Annotated[
        list[str] | None,
        Option("Combined standard uncertainty asked for: Kyx=90e-6 (V/g), U0, K, all.", metavar="NAME=U"),
    ] = None
    delta_g: Annotated[float | None, Option("u(Δg) asked for at the verification points, g.")] = None
    modulus: Annotated[float | None, Option("u(|a|) asked for in every direction, g: see --up-to.")] = None
    up_to: UpToField = None
    time: Annotated[
        str | None, Option("The most uncertainty taken away in so much bench time, such as 4h.")
    ] = None
    least: Annotated[str, Option("What is to be least: time or settings.")] = "time"
    installations: Annotated[
        str | None, Option("Installations to choose from, such as 1,2,1T90 (default: all).")
    ] = None
    angles: Annotated[int, Option("Angles in a turn to choose from.")] = 24
    visits: Annotated[int, Option("How often an installation may be mounted.", least=1, most=4)] = 1
    most_mountings: Annotated[int, Option("Mountings of a plan at most.", least=1, most=6)] = 3
    most_settings: Annotated[int, Option("Settings of a plan at most.", least=4)] = 300
    cost_setting: Annotated[str, Option("Time to set the head once.")] = "2min"
    cost_remount: Annotated[str, Option("Time to mount the block.")] = "20min"
    cost_soak: Annotated[str, Option("Time in which the block settles after it.")] = "10min"
    warm_up: Annotated[str, Option("Time before the first reading.")] = "1h"
    verify: Annotated[bool, Option("Verification points at the end of the procedure.")] = True
    out: Annotated[Path | None, Option("Procedure file to write; never overwritten.", metavar="FILE")] = None

    @property
    def has_goals(self) -> bool:
        """Whether an uncertainty is asked for, and not only a time."""
        return bool(self.u) or self.delta_g is not None or self.modulus is not None
