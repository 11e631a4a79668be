"""The budget of a bench, and its inverse: what the bench must be for an accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rich.console import Console

from bench.base.computing import tracked
from bench.base.units import ACCELERATION, SCALE_FACTOR, VOLTAGE, QuantityKind
from bench.calibration.budget.assessment import Question, assess
from bench.calibration.budget.coefficients import Setup, make_setup
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.propagation import COVERAGE, require_trials
from bench.calibration.budget.sources import bench_sources
from bench.calibration.estimators import ESTIMATORS, in_a_budget
from bench.calibration.mistakes import refuse_singular
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.config.model_file import load_model
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Plan
from bench.config.shipped import find_procedure
from bench.model.forward import ForwardModel
from bench.model.geometry import COEFFICIENTS, Block
from bench.planning.requirements import (
    Limit,
    Requirement,
    Target,
    of_acceleration,
    of_coefficient,
    of_delta_g,
)
from bench.readings.corrected import VOLTS
from bench.results.budget import BudgetResult, budget_result
from bench.results.planning import AlternativePart, LimitPart, RequireResult, print_requirement
from bench.services.arguments import python_call
from bench.services.bench_selection import BenchTaken, find_bench_file
from bench.services.coefficients import read_coefficients
from bench.services.errors import Refused, named, quantity
from bench.services.requests.planning import Budget, Require
from bench.services.source import NO_GRAVITY, check_gravity
from bench.services.traceability import take_learned, with_effects
from bench.services.verification import Asked, judgement_of
from drivers.clock import utc_now


def budget_of(request: Budget) -> BudgetResult:
    """Return the budget of a bench. Raises `Refused`, `CalibrationError`, `FileMistakes`."""
    check_gravity(request.g)
    estimator = in_a_budget(request.estimator).name
    if request.trials:
        _check_trials(request.trials)
    taken = find_bench_file(request.bench)
    file = _with_gravity(taken, request.g)
    judgement = judgement_of(file, Asked(request.limit, request.rule, request.guard_band))
    plan = load_procedure(find_procedure(request.procedure)).expand()
    block, about = _block(request.coefficients, file)
    today = utc_now().date()
    learned = take_learned(taken.learned(), today, VOLTS)
    setup = make_setup(plan, file, with_effects(_model(request.model, file), learned.effects), block)
    question = Question(
        file.unit_under_test.range, judgement.limit_g, judgement.rule, request.trials, request.same_voltmeters,
        judgement.population,
    )  # fmt: skip
    sources = bench_sources(file, setup, today, learned.known)
    found = replace(assess(setup, sources, estimator, question, learned.known), beside=learned.notes)
    return budget_result(
        found, bench=taken.part(), procedure=plan.name, about=about, g_m_s2=float(file.gravity_m_s2 or 0.0)
    )


def _budget(request: Budget) -> BudgetResult:
    """Return what each error of a bench contributes to the coefficients and to any measured acceleration.

    `procedure` says which readings a calibration is of, `coefficients` (a result of `bench calibrate --json`)
    of which block, `trials` how many Monte Carlo trials judge the linear result (0: none), `limit` the limit of
    Δg in g and `rule` ("simple", "guarded" or "non-binary", with `guard_band` in U) how it is judged, the bench
    file's unless given; `same_voltmeters` that the block is used with those of the calibration, `g` local gravity
    in m/s². Raises `Refused`, `CalibrationError`, `FileMistakes`.
    """
    return budget_of(request)


budget = python_call(Budget, _budget)


def _check_trials(trials: int) -> None:
    try:
        require_trials(trials, COVERAGE)
    except CalibrationError as error:
        raise Refused(f"--trials: {error}, or 0 for none") from None


def _with_gravity(taken: BenchTaken, g_m_s2: float | None) -> BenchFile:
    """Return the bench, with the gravity asked for in place of its own."""
    bench = taken.file
    if g_m_s2 is not None:
        bench = bench.model_copy(update={"gravity": g_m_s2})
    if bench.gravity_m_s2 is None:
        raise Refused(f"{taken.where}: {NO_GRAVITY}")
    return bench


def _model(path: str | Path | None, bench: BenchFile) -> ForwardModel:
    model = ForwardModel(bench.installation_models())
    if path is None:
        return model
    file = load_model(Path(path), model.installations)
    return replace(model, effects=file.applied_effects(), name=file.name)


def _block(coefficients: str | Path | None, bench: BenchFile) -> tuple[Block, str]:
    """Return the block about which the budget is, and which one that is."""
    if coefficients is not None:
        block = read_coefficients(Path(coefficients), "V").block
        try:
            refuse_singular(block)
        except CalibrationError as error:
            raise Refused(f"{coefficients}: {error}") from None
        return block, str(coefficients)
    nominal = bench.simulation.block is None
    return bench.simulated_block(), "nominal scale factors" if nominal else "block of the bench file"


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
class Requirements:
    """The result of `bench require`, with what its text needs beside.

    `up_to_g` is the largest acceleration, where one is asked about; `left_out` says what is not counted.
    """

    result: RequireResult
    up_to_g: float | None
    left_out: tuple[str, ...]

    def print_on(self, out: Console) -> None:
        """Print the limits, the alternatives, whether the bench as it is keeps to the accuracy."""
        print_requirement(self.result, out, up_to_g=self.up_to_g, left_out=self.left_out)


def requirements(request: Require) -> Requirements:
    """Return how large each error of a bench may be for k u of a quantity to keep to an accuracy.

    Raises `Refused` for what cannot be asked, `FileMistakes`, `CalibrationError`.
    """
    estimator = in_a_budget(request.estimator).name
    taken = find_bench_file(request.bench)
    file, of = taken.file, request.of
    plan = load_procedure(find_procedure(request.procedure)).expand()
    setup = make_setup(plan, file)
    target, unit, kind = _target(request, file, reading=request.with_reading)
    accuracy = quantity("--accuracy", request.accuracy, kind)
    every = bench_sources(file, setup, utc_now().date())
    if of in COEFFICIENTS:
        every = tuple(s for s in every if s.name != "gravity")  # coefficients are stated per local g
    sources = every if request.all_errors else tuple(s for s in every if s.group == "stand")
    asked = Requirement(setup, sources, estimator, target, accuracy, request.k)
    names = [s.name for s in sources if s.u > 0]
    costs = _costs(request.share, request.cost or (), names)
    together: Sequence[Limit] = ()
    why_not_together = None
    try:
        together = asked.balanced(names, costs)
    except CalibrationError as error:
        why_not_together = str(error)
    left_out = []
    if not request.all_errors:
        gravity = "" if of in COEFFICIENTS else "gravity, "
        left_out.append(
            f"what no reading shows (gain, {gravity}temperature, nonlinearity of the block: --all-errors)"
        )
    if not (request.with_reading or of in COEFFICIENTS):
        left_out.append("the reading in use (--with-reading)")
    # what was not counted adds by itself: other sources, and the reading in use
    whole = replace(asked, sources=tuple(every), target=_target(request, file, reading=True)[0])
    reached, shares = asked.reached(), asked.shares()
    result = RequireResult(
        of=of,
        up_to=request.up_to,
        accuracy=accuracy,
        unit=unit,
        k=request.k,
        bench=file.name,
        bench_file=taken.part(),
        procedure=plan.name,
        estimator=estimator,
        reached=reached,
        kept=asked.keeps(reached),
        not_counted=math.sqrt(max(whole.reached() ** 2 - reached**2, 0.0)),
        alone=[
            LimitPart.of_limit(asked.alone(source), part=shares[source.name])
            for source in tracked(sources, "limits of the errors")
        ],
        share=request.share,
        together=[LimitPart.of_limit(limit) for limit in together],
        why_not_together=why_not_together,
        alternatives=list(_alternatives(asked, file, plan)),
    )
    return Requirements(
        result, _up_to_g(request.up_to, file) if of in ACCELERATIONS else None, tuple(left_out)
    )


def _target(request: Require, bench: BenchFile, *, reading: bool) -> tuple[Target, str, QuantityKind]:
    """Return what is required, its unit, and how an accuracy of it is written."""
    of, up_to = request.of, request.up_to
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


def _alternatives(asked: Requirement, bench: BenchFile, plan: Plan) -> Iterator[AlternativePart]:
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
) -> Iterator[AlternativePart]:
    """What it gives; nothing where the estimator does not know such readings."""
    try:
        reached, limit = asked.reached(), asked.alone(dominant)
    except CalibrationError:
        return
    yield AlternativePart(
        estimator=asked.estimator,
        procedure=plan.name,
        settings=int(asked.setup.fitted.sum()),
        time_s=plan.expected_duration_s(bench.line_frequency),
        reached=reached,
        kept=asked.keeps(reached),
        limit_alone=LimitPart.of_limit(limit),
    )
