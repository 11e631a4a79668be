"""require: what the bench must be for an accuracy, error by error and as a balanced set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

from bench.analysis.budget.setup import Setup, make_setup
from bench.analysis.budget.sources import ErrorSource, bench_sources
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
from bench.base.units import ACCELERATION, SCALE_FACTOR, VOLTAGE
from bench.cli import CommandError
from bench.cli.quantities import named, quantity
from bench.cli.require_printing import Alternative, Request, RequirementAnswer, tell
from bench.cli.source import bench_path, check_target, write_json
from bench.files.bench.file import BenchFile, load_bench
from bench.files.shipped import find_procedure
from bench.procedure.load import load_procedure
from bench.procedure.plan import Plan

__all__ = ["Request", "require"]

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


def require(request: Request) -> int:
    """Carry out `bench require`; 1 when the bench as its file states it does not keep to the accuracy."""
    check_target(request.json)
    estimator = in_a_budget(request.estimator).name
    bench = load_bench(bench_path(request.bench))
    plan = load_procedure(find_procedure(request.procedure)).expand()
    setup = make_setup(plan, bench)
    target, unit, kind = _target(request, bench, reading=request.reading)
    accuracy = quantity("--accuracy", request.accuracy, kind)
    every = bench_sources(bench, setup)
    sources = every if request.every_source else tuple(s for s in every if s.group == "stand")
    asked = Requirement(setup, sources, estimator, target, accuracy, request.k)
    names = [s.name for s in sources if s.u > 0]
    costs = _costs(request, names)
    balanced, unbalanced = _balanced(asked, names, costs)
    answer = RequirementAnswer(
        asked,
        unit,
        _up_to_g(request, bench) if request.of in ACCELERATIONS else None,
        tuple(asked.alone(source) for source in sources),
        balanced,
        unbalanced,
        tuple(_alternatives(asked, bench, plan)),
        _beside(asked, every, _target(request, bench, reading=True)[0]),
        bench,
        plan,
    )
    tell(answer, request)
    write_json([_to_json(answer, request)], request.json)
    return 0 if asked.keeps(asked.reached()) else 1


def _target(request: Request, bench: BenchFile, *, reading: bool) -> tuple[Target, str, Any]:
    """Return what is required, its unit, and how an accuracy of it is written."""
    if request.up_to is not None and request.of not in ACCELERATIONS:
        raise CommandError("--up-to belongs to --of acceleration and --of modulus")
    if request.of == DELTA_G:
        return of_delta_g(reading=reading), "g", ACCELERATION
    if request.of in ACCELERATIONS:
        modulus = request.of == MODULUS_OF
        up_to = _up_to_g(request, bench)
        return of_acceleration(up_to, reading=reading, modulus=modulus), "g", ACCELERATION
    try:
        target = of_coefficient(request.of)
    except CalibrationError as error:
        raise CommandError(
            f"--of {request.of}: delta-g, acceleration, modulus or a coefficient; {error}"
        ) from None
    bias = request.of.startswith("U0")
    return target, "V" if bias else "V/g", VOLTAGE if bias else SCALE_FACTOR


def _up_to_g(request: Request, bench: BenchFile) -> float:
    if request.up_to is None:
        return bench.unit_under_test.range
    up_to = quantity("--up-to", request.up_to, ACCELERATION)
    if not (math.isfinite(up_to) and up_to > 0):
        raise CommandError(f"--up-to {request.up_to}: an acceleration above zero, such as 5g")
    return up_to


def _costs(request: Request, names: Sequence[str]) -> dict[str, float] | None:
    """Return the weights of costs, None for equal parts of the variance."""
    if request.share not in {"equal", "cost"}:
        raise CommandError(f"--share is equal or cost, not {request.share!r}")
    if request.costs and request.share != "cost":
        raise CommandError("--cost belongs to --share cost")
    if request.share == "equal":
        return None
    costs = {}
    for text in request.costs:
        name, weight = named("--cost", text, "mounting_error=4")
        if name not in names:
            raise CommandError(f"--cost {text}: no error {name!r} to share; there are {', '.join(names)}")
        try:
            costs[name] = float(weight)
        except ValueError:
            costs[name] = math.nan
        if not (math.isfinite(costs[name]) and costs[name] > 0):
            raise CommandError(f"--cost {text}: a weight is a positive number")
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
    for estimator in ESTIMATORS:
        if in_a_budget(estimator).name == estimator:
            yield from _alternative(replace(asked, estimator=estimator), dominant, plan, bench)
    for name in PROCEDURES:
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


def _to_json(answer: RequirementAnswer, request: Request) -> dict[str, Any]:
    asked = answer.requirement
    shares = asked.shares()
    return {
        "of": request.of,
        "up_to": request.up_to,
        "accuracy": asked.accuracy,
        "unit": answer.unit,
        "k": asked.k,
        "bench": answer.bench.name,
        "procedure": answer.plan.name,
        "estimator": asked.estimator,
        "reached": asked.reached(),
        "kept": asked.keeps(asked.reached()),
        "not_counted": answer.beside,
        "alone": [{**limit.to_json(), "part": shares[limit.source.name]} for limit in answer.alone],
        "share": request.share,
        "together": [limit.to_json() for limit in answer.balanced],
        "why_not_together": answer.unbalanced or None,
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
            for other in answer.alternatives
        ],
    }
