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
    str,
    Option(
        "Procedure file, by path or shipped name.", argument=True, completes="procedures", also="--procedure"
    ),
]
EstimatorField = Annotated[str, Option(ESTIMATORS_IN_A_BUDGET)]
UpToField = Annotated[str | None, Option("Largest acceleration, such as 5g (default: the block's range).")]


@dataclass(frozen=True)
class Check:
    """A check of a procedure against a bench, or (`morning`) of the bench itself, each morning."""

    procedure: Annotated[
        str | None, Option("Procedure file, by path or shipped name.", argument=True, completes="procedures")
    ] = None
    _: KW_ONLY
    bench: BenchField = None
    until: UntilField = None
    morning: Annotated[
        bool,
        Option(
            "Check the bench instead: identities, self-tests, inputs, head, check block.",
            ("--morning",),
            common=True,
        ),
    ] = False
    reference: Annotated[
        float | None,
        Option("With --morning: voltage of the reference, V (default: no reference).", metavar="V"),
    ] = None
    dry_run: Annotated[bool, Option("With --morning: use the simulated bench.", ("--dry-run",))] = False
    seed: Annotated[int, Option("Seed of the random numbers of --dry-run.", least=0)] = 1
    out: Annotated[Path | None, Option("With --morning: folder of page and wire log.", metavar="DIR")] = None
    runs: RunsField = None


@dataclass(frozen=True)
class Init:
    """Copies of the shipped files."""

    folder: Annotated[Path, Option("Folder for the copies.", argument=True)] = Path()


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
            "Coefficients from 'calibrate --json', instead of the bench file's.",
            metavar="FILE",
            typed=Path | None,
        ),
    ] = None
    trials: Annotated[int, Option("Number of Monte Carlo trials; 0 for none.", least=0)] = 20_000
    rule: RuleField = None
    guard_band: GuardBandField = None
    limit: LimitField = None
    same_voltmeters: Annotated[
        bool, Option("Assume that the block is used with the same voltmeters.", ("--same-voltmeters",))
    ] = False
    g: GravityField = None


@dataclass(frozen=True, kw_only=True)
class Require:
    """Requirements on the errors of a bench for a given accuracy."""

    accuracy: Annotated[
        str, Option("Required accuracy k u, in g (of a coefficient in V/g or V).", common=True)
    ]
    of: Annotated[
        str,
        Option(
            "Quantity: delta-g, acceleration (vector), modulus, or a coefficient such as Kyx.", common=True
        ),
    ] = "delta-g"
    up_to: UpToField = None
    k: Annotated[float, Option("Number of standard uncertainties in the accuracy.", common=True)] = 3.0
    with_reading: Annotated[
        bool,
        Option("Include the errors of the reading in use.", flags=("--with-reading",)),
    ] = False
    all_errors: Annotated[
        bool,
        Option(
            "Include gain, gravity, temperature and nonlinearity, which no reading shows.",
            flags=("--all-errors",),
        ),
    ] = False
    share: Annotated[str, Option("How errors share the variance: equal or cost.")] = "equal"
    cost: Annotated[
        list[str] | None, Option("Cost of reducing an error (default 1).", metavar="NAME=WEIGHT")
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
        Option(
            "Required combined standard uncertainty: Kyx=90e-6 (V/g), U0, K or all.",
            metavar="NAME=U",
            common=True,
        ),
    ] = None
    delta_g: Annotated[float | None, Option("Required u(Δg) at the verification points, g.", common=True)] = (
        None
    )
    modulus: Annotated[
        float | None, Option("Required u(|a|) in every direction, g; see --up-to.", common=True)
    ] = None
    up_to: UpToField = None
    time: Annotated[
        str | None, Option("Find the lowest uncertainty in this bench time, such as 4h.", common=True)
    ] = None
    least: Annotated[str, Option("What to minimise: time or settings.")] = "time"
    installations: Annotated[
        str | None, Option("Installations to choose from, such as 1,2,1T90 (default: all).")
    ] = None
    angles: Annotated[int, Option("Number of angles in a turn to choose from.")] = 24
    visits: Annotated[int, Option("How often an installation may be mounted.", least=1, most=4)] = 1
    most_mountings: Annotated[int, Option("Largest number of mountings.", least=1, most=6)] = 3
    most_settings: Annotated[int, Option("Largest number of settings.", least=4)] = 300
    cost_setting: Annotated[str, Option("Time to set the head once.")] = "2min"
    cost_remount: Annotated[str, Option("Time to mount the block.")] = "20min"
    cost_soak: Annotated[str, Option("Settling time after each mounting.")] = "10min"
    warm_up: Annotated[str, Option("Warm-up time before the first reading.")] = "1h"
    verify: Annotated[bool, Option("Add verification points at the end.")] = True
    out: Annotated[
        Path | None, Option("Procedure file to write; must not exist yet.", metavar="FILE", common=True)
    ] = None

    @property
    def has_goals(self) -> bool:
        """Whether an uncertainty is asked for, and not only a time."""
        return bool(self.u) or self.delta_g is not None or self.modulus is not None
