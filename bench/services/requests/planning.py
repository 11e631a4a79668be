"""Requests before a measurement: check of a procedure, budget, requirements on the bench, test points."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import ESTIMATORS_IN_A_BUDGET, Option, option
from bench.services.requests import shared

ProcedureField = Annotated[
    str,
    Option(
        "Procedure file, by path or shipped name.", argument=True, completes="procedures", also="--procedure"
    ),
]
EstimatorField = Annotated[str, Option(ESTIMATORS_IN_A_BUDGET, rare=True)]
UpToField = Annotated[
    str | None, Option("Largest acceleration, such as 5g (default: the block's range).", rare=True)
]


@dataclass(frozen=True)
class Check:
    """Options of `bench check`: check a procedure against a bench or, with `morning`, the bench itself."""

    procedure: str | None = option(
        None, "Procedure file, by path or shipped name.", argument=True, completes="procedures"
    )
    _: KW_ONLY
    bench: shared.BenchField = None
    until: shared.UntilField = None
    morning: bool = option(
        False, "Check the bench instead: identities, self-tests, inputs, head, check block."
    )
    reference: float | None = option(
        None, "With --morning: voltage of the reference, V (default: no reference).", metavar="V", rare=True
    )
    dry_run: bool = option(False, "With --morning: use the simulated bench.", rare=True)
    seed: int = option(1, "Seed of the random numbers of --dry-run.", least=0, rare=True)
    out: Path | None = option(None, "With --morning: folder of page and wire log.", metavar="DIR", rare=True)
    runs: shared.RunsField = None


@dataclass(frozen=True)
class Init:
    """Options of `bench init`: copy the shipped files."""

    folder: Path = option(Path(), "Folder for the copies.", argument=True)


@dataclass(frozen=True)
class Budget:
    """Options of `bench budget`: compute the contribution of each error of a bench to the uncertainty."""

    bench: shared.BenchField = None
    procedure: ProcedureField = "calibration"
    estimator: EstimatorField = "gls"
    _: KW_ONLY
    model: shared.ModelField = None
    coefficients: str | Path | None = option(
        None, "Coefficients from 'calibrate --json', instead of the bench file's.", rare=True
    )
    trials: int = option(20_000, "Number of Monte Carlo trials; 0 for none.", least=0, rare=True)
    rule: shared.RuleField = None
    guard_band: shared.GuardBandField = None
    limit: shared.LimitField = None
    same_voltmeters: bool = option(
        False, "Assume that the block is used with the same voltmeters.", rare=True
    )
    g: shared.GravityField = None


@dataclass(frozen=True, kw_only=True)
class Require:
    """Options of `bench require`: compute how large the errors of a bench may be for a required accuracy."""

    accuracy: Annotated[str, Option("Required accuracy k u, in g (of a coefficient in V/g or V).")]
    of: str = option(
        "delta-g", "Quantity: delta-g, acceleration (vector), modulus, or a coefficient such as Kyx."
    )
    up_to: UpToField = None
    k: float = option(3.0, "Number of standard uncertainties in the accuracy.")
    with_reading: bool = option(False, "Include the errors of a reading when the block is used.", rare=True)
    all_errors: bool = option(
        False, "Include gain, gravity, temperature and nonlinearity, which no reading shows.", rare=True
    )
    share: str = option("equal", "How errors share the variance: equal or cost.", rare=True)
    cost: list[str] | None = option(
        None, "Cost of reducing an error (default 1).", metavar="NAME=WEIGHT", rare=True
    )
    estimator: EstimatorField = "gls"
    procedure: ProcedureField = "calibration"
    bench: shared.BenchField = None


@dataclass(frozen=True, kw_only=True)
class PlanPoints:
    """Options of `bench plan-points`: find the test points that give a required uncertainty."""

    bench: shared.BenchField = None
    u: list[str] | None = option(
        None, "Required combined standard uncertainty: Kyx=90e-6 (V/g), U0, K or all.", metavar="NAME=U"
    )
    delta_g: float | None = option(None, "Required u(Δg) at the verification points, g.")
    modulus: float | None = option(None, "Required u(|a|) in every direction, g; see --up-to.")
    up_to: UpToField = None
    time: str | None = option(None, "Find the lowest uncertainty in this bench time, such as 4h.")
    least: str = option("time", "What to minimise: time or settings.", rare=True)
    installations: str | None = option(
        None, "Installations to choose from, such as 1,2,1T90 (default: all).", rare=True
    )
    angles: int = option(24, "Number of angles in a turn to choose from.", rare=True)
    visits: int = option(1, "How often an installation may be mounted.", least=1, most=4, rare=True)
    most_mountings: int = option(3, "Largest number of mountings.", least=1, most=6, rare=True)
    most_settings: int = option(300, "Largest number of settings.", least=4, rare=True)
    cost_setting: str = option("2min", "Time to set the head once.", rare=True)
    cost_remount: str = option("20min", "Time to mount the block.", rare=True)
    cost_soak: str = option("10min", "Settling time after each mounting.", rare=True)
    warm_up: str = option("1h", "Warm-up time before the first reading.", rare=True)
    verify: bool = option(True, "Add verification points at the end.", rare=True)
    out: Path | None = option(None, "Procedure file to write; must not exist yet.")

    @property
    def has_goals(self) -> bool:
        """Whether the options state a goal for an uncertainty, and not only a time."""
        return bool(self.u) or self.delta_g is not None or self.modulus is not None
