"""What a bench must be for an accuracy, error by error and as a balanced set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.budget.setup import Setup, make_setup
from bench.analysis.budget.sources import bench_sources
from bench.analysis.calibration.estimators import ESTIMATORS, in_a_budget
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.planning.requirements import (
    Limit,
    Requirement,
    Target,
    of_acceleration,
    of_coefficient,
    of_delta_g,
)
from bench.api.errors import Refused
from bench.api.quantities import named, quantity
from bench.api.taken import BenchTaken, find_bench_file
from bench.base.progress import tracked
from bench.base.units import ACCELERATION, SCALE_FACTOR, VOLTAGE, QuantityKind
from bench.files.bench.file import BenchFile
from bench.files.shipped import find_procedure
from bench.model.block import COEFFICIENTS
from bench.procedure.load import load_procedure
from bench.procedure.plan import Plan
from drivers.clock import utc_now

PROCEDURES: Final = (
    "quick",
    "paper",
    "calibration",
    "turn-12",
    "turn-24",
    "return",
    "remount-90",
    "remount-180",
)
"""The shipped procedures that calibrate at one temperature."""

DELTA_G, ACCELERATION_OF, MODULUS_OF = "delta-g", "acceleration", "modulus"
ACCELERATIONS: Final = frozenset({ACCELERATION_OF, MODULUS_OF})


@dataclass(frozen=True)
class Alternative:
    """Another estimator or procedure: what it gives on the bench as it is, and the limit of one source."""

    estimator: str
    procedure: str
    settings: int
    time_s: float
    reached: float
    limit: Limit


@dataclass(frozen=True)
class RequirementAnswer:
    """What is found of `of` (with `up_to` as written; in g only where an acceleration is asked about).

    `beside` is k u that was not counted, of what is `left_out`; `share` says how the limits together are made.
    """

    of: str
    up_to: str | None
    share: str
    left_out: tuple[str, ...]
    requirement: Requirement
    unit: str
    up_to_g: float | None
    alone: tuple[Limit, ...]
    balanced: tuple[Limit, ...]
    unbalanced: str
    alternatives: tuple[Alternative, ...]
    beside: float
    taken: BenchTaken
    plan: Plan

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        asked = self.requirement
        shares = asked.shares()
        return {
            "of": self.of,
            "up_to": self.up_to,
            "accuracy": asked.accuracy,
            "unit": self.unit,
            "k": asked.k,
            "bench": self.taken.file.name,
            "bench_file": self.taken.to_dict(),
            "procedure": self.plan.name,
            "estimator": asked.estimator,
            "reached": asked.reached(),
            "kept": asked.keeps(asked.reached()),
            "not_counted": self.beside,
            "alone": [{**limit.to_json(), "part": shares[limit.source.name]} for limit in self.alone],
            "share": self.share,
            "together": [limit.to_json() for limit in self.balanced],
            "why_not_together": self.unbalanced or None,
            "alternatives": [
                {
                    "estimator": other.estimator,
                    "procedure": other.procedure,
                    "settings": other.settings,
                    "time_s": other.time_s,
                    "reached": other.reached,
                    "kept": asked.keeps(other.reached),
                    "limit_alone": other.limit.to_json(),
                }
                for other in self.alternatives
            ],
        }


def requirements(
    accuracy: str,
    of: str,
    *,
    up_to: str | None,
    k: float,
    reading: bool,
    every_source: bool,
    share: str,
    costs: Sequence[str],
    estimator: str,
    procedure: str,
    bench: str | BenchTaken | None,
) -> RequirementAnswer:
    """Return how large each error of a bench may be for k u of `of` to keep to an accuracy.

    `reading` counts the errors of the reading in use, `every_source` those that no reading shows. Raises
    `Refused` for what cannot be asked, `FileMistakes`, `CalibrationError`.
    """
    estimator = in_a_budget(estimator).name
    taken = find_bench_file(bench)
    file = taken.file
    plan = load_procedure(find_procedure(procedure)).expand()
    setup = make_setup(plan, file)
    target, unit, kind = _target(of, up_to, file, reading=reading)
    limit = quantity("--accuracy", accuracy, kind)
    every = bench_sources(file, setup, utc_now().date())
    if of in COEFFICIENTS:
        every = tuple(s for s in every if s.name != "gravity")  # coefficients are stated per local g
    sources = every if every_source else tuple(s for s in every if s.group == "stand")
    asked = Requirement(setup, sources, estimator, target, limit, k)
    names = [s.name for s in sources if s.u > 0]
    balanced, unbalanced = _balanced(asked, names, _costs(share, costs, names))
    left_out = []
    if not every_source:
        gravity = "" if of in COEFFICIENTS else "gravity, "
        left_out.append(
            f"what no reading shows (gain, {gravity}temperature, nonlinearity of the block: --all-errors)"
        )
    if not (reading or of in COEFFICIENTS):
        left_out.append("the reading in use (--with-reading)")
    return RequirementAnswer(
        of,
        up_to,
        share,
        tuple(left_out),
        asked,
        unit,
        _up_to_g(up_to, file) if of in ACCELERATIONS else None,
        tuple(asked.alone(source) for source in tracked(sources, "limits of the errors")),
        balanced,
        unbalanced,
        tuple(_alternatives(asked, file, plan)),
        _beside(asked, every, _target(of, up_to, file, reading=True)[0]),
        taken,
        plan,
    )


def _target(
    of: str, up_to: str | None, bench: BenchFile, *, reading: bool
) -> tuple[Target, str, QuantityKind]:
    """Return what is required, its unit, and how an accuracy of it is written."""
    if up_to is not None and of not in ACCELERATIONS:
        raise Refused("--up-to belongs to --of acceleration and --of modulus")
    if of == DELTA_G:
        return of_delta_g(reading=reading), "g", ACCELERATION
    if of in ACCELERATIONS:
        modulus = of == MODULUS_OF
        return of_acceleration(_up_to_g(up_to, bench), reading=reading, modulus=modulus), "g", ACCELERATION
    try:
        target = of_coefficient(of)
    except CalibrationError as error:
        raise Refused(f"--of {of}: delta-g, acceleration, modulus or a coefficient; {error}") from None
    bias = of.startswith("U0")
    return target, "V" if bias else "V/g", VOLTAGE if bias else SCALE_FACTOR


def _up_to_g(up_to: str | None, bench: BenchFile) -> float:
    if up_to is None:
        return bench.unit_under_test.range
    up_to_g = quantity("--up-to", up_to, ACCELERATION)
    if not (math.isfinite(up_to_g) and up_to_g > 0):
        raise Refused(f"--up-to {up_to}: an acceleration above zero, such as 5g")
    return up_to_g


def _costs(share: str, given: Sequence[str], names: Sequence[str]) -> dict[str, float] | None:
    """Return the weights of costs, None for equal parts of the variance."""
    if share not in {"equal", "cost"}:
        raise Refused(f"--share is equal or cost, not {share!r}")
    if given and share != "cost":
        raise Refused("--cost belongs to --share cost")
    if share == "equal":
        return None
    costs = {}
    for text in given:
        name, weight = named("--cost", text, "mounting_error=4")
        if name not in names:
            raise Refused(f"--cost {text}: no error {name!r} to share; there are {', '.join(names)}")
        try:
            costs[name] = float(weight)
        except ValueError:
            costs[name] = math.nan
        if not (math.isfinite(costs[name]) and costs[name] > 0):
            raise Refused(f"--cost {text}: a weight is a positive number")
    return costs


def _balanced(
    asked: Requirement, names: Sequence[str], costs: dict[str, float] | None
) -> tuple[tuple[Limit, ...], str]:
    try:
        return tuple(asked.balanced(names, costs)), ""
    except CalibrationError as error:
        return (), str(error)


def _beside(asked: Requirement, every: Sequence[ErrorSource], counting_all: Target) -> float:
    """What was not counted adds by itself, as k u: other sources, and the reading in use."""
    whole = replace(asked, sources=tuple(every), target=counting_all)
    return math.sqrt(max(whole.reached() ** 2 - asked.reached() ** 2, 0.0))


def _alternatives(asked: Requirement, bench: BenchFile, plan: Plan) -> Iterator[Alternative]:
    """Every estimator on the procedure, then the estimator on the other procedures that the bench can do."""
    shares = asked.shares()
    dominant = next(s for s in asked.sources if s.name == max(shares, key=shares.__getitem__))
    for estimator in tracked(ESTIMATORS, "other estimators"):
        if in_a_budget(estimator).name == estimator:
            yield from _alternative(replace(asked, estimator=estimator), dominant, plan, bench)
    for name in tracked(PROCEDURES, "other procedures"):
        if name == plan.name:
            continue
        other = load_procedure(find_procedure(name)).expand()
        try:
            setup: Setup = make_setup(other, bench)
        except CalibrationError:
            continue
        yield from _alternative(replace(asked, setup=setup), dominant, other, bench)


def _alternative(
    asked: Requirement, dominant: ErrorSource, plan: Plan, bench: BenchFile
) -> Iterator[Alternative]:
    """What it gives; nothing where the estimator does not know such readings."""
    try:
        reached, limit = asked.reached(), asked.alone(dominant)
    except CalibrationError:
        return
    settings = int(asked.setup.fitted.sum())
    time_s = plan.expected_duration_s(bench.line_frequency)
    yield Alternative(asked.estimator, plan.name, settings, time_s, reached, limit)
