"""Planning of a calibration: uncertainty budgets, requirements on the bench, and test points."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.computing import tracked
from bench.base.languages import message
from bench.base.units import ACCELERATION, DURATION, SCALE_FACTOR, VOLTAGE, QuantityKind
from bench.calibration.budget.assessment import Question, assess
from bench.calibration.budget.coefficients import Setup, make_setup, meters_of
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.propagation import require_trials
from bench.calibration.budget.sources import assumed_stand, bench_sources, signed_sources
from bench.calibration.estimators import ESTIMATORS, in_a_budget
from bench.calibration.mistakes import refuse_singular
from bench.calibration.noise import KnownStand
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.config.model_file import load_model
from bench.config.procedure.check import check as check_against
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Plan
from bench.config.shipped import find_procedure
from bench.model import ForwardModel, Mounting
from bench.model.geometry import COEFFICIENTS, Block, specific_force_on_platform
from bench.planning import optimal_design as design
from bench.planning.points import (
    VERIFICATION_DEG,
    ChosenPoints,
    Sites,
    Times,
    best_within,
    cheapest,
    procedure_text,
)
from bench.planning.requirements import (
    Cost,
    Limit,
    Requirement,
    Setting,
    Target,
    fitted,
    of_acceleration,
    of_coefficient,
    of_delta_g,
    settings_of,
)
from bench.readings.corrected import VOLTS
from bench.readings.table import UNORIENTED, VERIFICATION
from bench.results.budget import BudgetResult, budget_result
from bench.results.planning import (
    AlternativePart,
    LimitPart,
    PlannedPoints,
    Requirements,
    RequireResult,
    plan_points_result,
)
from bench.run.sentences import duration
from bench.services.arguments import python_call
from bench.services.bench_selection import BenchTaken, find_bench_file
from bench.services.coefficients import read_coefficients
from bench.services.errors import Refused, named, quantity
from bench.services.requests.measuring import Budget, PlanPoints, Require
from bench.services.source import NO_GRAVITY, check_gravity
from bench.services.traceability import take_learned, with_effects
from bench.services.verification import VerdictOptions, judgement_of
from drivers.clock import utc_now

MOST_ANGLES: Final = 72


def planned(request: PlanPoints) -> PlannedPoints:
    """Return test points that reach goals in the least time, or the least u in a given time. Raises `Refused`."""
    _refuse_contradictions(request)
    taken = find_bench_file(request.bench)
    file = taken.file
    try:
        stand = stand_of(file, ForwardModel(file.installation_models()), day=utc_now().date())
    except CalibrationError as reason:
        raise CalibrationError(f"{taken.where}: {reason}") from None
    verified = request.verify and VERIFICATION in stand.model.installations
    goals = _goals(request, stand, file)
    times = _times(request)
    cost = times.cost(file.line_frequency, verified=verified)
    sites = Sites(
        stand, mountings(file, request.installations, request.visits), even_angles(file, request.angles)
    )
    if request.time is None:
        weighed = cost if request.least == "time" else Cost(1.0, 1e-6)
        found = cheapest(stand, sites, goals, weighed, request.most_settings, request.most_mountings)
        found = replace(found, cost=cost)
    else:
        limit_s = duration_s("--time", request.time)
        found = best_within(stand, sites, goals, cost, limit_s, request.most_mountings)
    paper_settings, u_paper = _of_paper(stand, goals)
    written = None
    if request.out is not None:
        _write_procedure(request.out, found, times, file, verified=verified, asked=request.has_goals)
        written = str(request.out)
    result = plan_points_result(found, u_paper, taken.part(), written, asked=request.has_goals)
    return PlannedPoints(result, paper_settings, taken.learned_path is not None, request.time)


def _refuse_contradictions(request: PlanPoints) -> None:
    if not request.has_goals and request.time is None:
        raise Refused(
            "no goal given; give a goal (--u all=5e-5, --delta-g 1e-4, --modulus 1e-3 --up-to 5) or a "
            "duration (--time 4h)"
        )
    if request.up_to is not None and request.modulus is None:
        raise Refused("--up-to needs --modulus (the uncertainty of |a| up to so many g); add it")
    if request.least not in {"time", "settings"}:
        raise Refused(f"--least {request.least}: choose from time, settings")
    if not 3 <= request.angles <= MOST_ANGLES:
        raise Refused(f"--angles {request.angles}: give a number of angles from 3 to {MOST_ANGLES}")
    out = request.out
    if out is not None and out.exists():
        raise Refused(f"--out {out}: this file exists and was not overwritten; choose another name")
    if out is not None and not out.absolute().parent.is_dir():
        raise Refused(f"--out {out}: no such folder; create it or name another")


def stand_of(
    bench: BenchFile, model: ForwardModel, known: KnownStand | None = None, day: datetime.date | None = None
) -> design.Stand:
    """Return the stand for planning on a bench, with all errors whose u a calibration includes.

    `known` are learned errors of the stand. `day` is the day up to which the instruments drift after their
    certificates. Raises `CalibrationError` if the bench file states no noise.
    """
    sizes = {name: d.u for name, d in (bench.stand_distributions() | assumed_stand(bench)).items()}
    hidden = signed_sources(bench, model, day)
    meters = meters_of(bench)
    return design.Stand(model, bench.simulated_block(), sizes, known, hidden, meters)


def _goals(request: PlanPoints, stand: design.Stand, bench: BenchFile) -> list[design.Goal]:
    goals = design.coefficient_goals(dict(_size(text) for text in request.u or ()))
    if request.delta_g is not None:
        goals += delta_g_of(stand, request.delta_g, "--delta-g")
    if request.modulus is not None:
        up_to_g = bench.unit_under_test.range
        if request.up_to is not None:
            up_to_g = quantity("--up-to", request.up_to, ACCELERATION)
        goals += design.modulus_goals(stand.block, up_to_g, request.modulus)
    return [*goals, design.whole_goal(stand.block, goals)] if goals else [design.vector_goal(stand.block)]


def delta_g_of(stand: design.Stand, asked_g: float, option: str) -> list[design.Goal]:
    """Return the goals u(Δg) ≤ `asked_g` (g), one for each verification point of the bench. Raises `Refused`."""
    if VERIFICATION not in stand.model.installations:
        raise Refused(
            f"{option} needs the installation V of the verification points; add it to the bench file"
        )
    angles = np.radians(np.array(VERIFICATION_DEG, dtype=np.float64))
    turn = stand.model.installations[VERIFICATION].block_from_platform
    force = specific_force_on_platform(angles, np.zeros((len(angles), 5))) @ turn.T
    at = [Setting(Mounting(1, VERIFICATION), 1, i, float(a), 1) for i, a in enumerate(angles, start=1)]
    return design.delta_g_goals(stand.block, force, stand.noise.reading, asked_g, at)


def _size(text: str) -> tuple[str, float]:
    """Return name and SI value in a text such as "Kyx=20 uV/g"; a plain number is in V/g, for a bias in V."""
    name, size = named("--u", text, "Kyx=20e-6 (a standard uncertainty, V/g)")
    return name, quantity("--u", size, VOLTAGE if name.startswith("U0") else SCALE_FACTOR)


def duration_s(option: str, text: str) -> float:
    """Return the time (s) in the `text` of an option. Raises `Refused` for an invalid time."""
    seconds = quantity(option, text, DURATION, plain=False)
    if seconds < 0:
        raise Refused(f"{option} {text}: the time is negative; give a time of 0 or more")
    return seconds


def _times(request: PlanPoints) -> Times:
    times = Times(
        duration_s("--cost-setting", request.cost_setting),
        duration_s("--cost-remount", request.cost_remount),
        duration_s("--cost-soak", request.cost_soak),
        duration_s("--warm-up", request.warm_up),
    )
    if times.turn_s <= 0:
        raise Refused("--cost-setting: a setting takes no time; give at least 1 s")
    return times


def mountings(bench: BenchFile, installations: str | None, visits: int) -> list[Mounting]:
    """Return `visits` mountings in each of the `installations` (None: all of the bench). Raises `Refused`."""
    known = [label for label in bench.installation_models() if label not in {VERIFICATION, *UNORIENTED}]
    labels = known
    if installations is not None:
        labels = list(dict.fromkeys(label.strip() for label in installations.split(",")))
    strange = [label for label in labels if label not in known]
    if strange:
        raise Refused(
            f"--installations: {bench.name} has no installation {', '.join(strange)} for a calibration "
            f"(it has {', '.join(known)}); name one of these, or add one to the bench file"
        )
    return [Mounting(series, label) for series in range(1, visits + 1) for label in labels]


def even_angles(bench: BenchFile, count: int) -> Floats:
    """Return the angles (m,), rad, of `count` equal steps a turn that the head can reach from both sides."""
    angles = 2 * np.pi * np.arange(count) / count
    if bench.head_limits_rad is None:
        return angles
    low, high = bench.head_limits_rad
    backoff = bench.head_backoff_rad
    allowed = (angles - backoff >= low - 1e-9) & (angles + backoff <= high + 1e-9)
    wrapped = angles - 2 * np.pi
    lower = (wrapped - backoff >= low - 1e-9) & (wrapped + backoff <= high + 1e-9)
    return np.sort(np.concatenate([angles[allowed], wrapped[lower & ~allowed]]))


def _of_paper(stand: design.Stand, goals: Sequence[design.Goal]) -> tuple[int, dict[str, float]]:
    """Return the number of settings in the paper's procedure, and the largest u for each goal name."""
    settings = fitted(settings_of(load_procedure(find_procedure("paper")).expand()))
    promise = stand.promise(settings, goals)
    u: dict[str, float] = {}
    for goal in promise.goals:
        u[goal.name] = max(goal.u(promise.readings), u.get(goal.name, 0.0))
    return len(settings), u


def _write_procedure(
    file: Path, points: ChosenPoints, times: Times, bench: BenchFile, *, verified: bool, asked: bool
) -> None:
    """Write the procedure to a new file, and check it against the bench as `bench check` does."""
    text = procedure_text(
        file.stem, _remarks(points, bench, asked=asked), points.visits, times, verified=verified
    )
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError:
        raise Refused(
            f"--out {file}: this file exists and was not overwritten; choose another name"
        ) from None
    problems = check_against(load_procedure(file).expand(), bench)
    if problems:
        raise Refused(f"{file}: " + "; ".join(problems))


def _remarks(points: ChosenPoints, bench: BenchFile, *, asked: bool) -> str:
    worst = points.worst
    least = f"{worst.name}: u = {points.u(worst):.3g} {worst.unit}"
    if asked:
        least += f" of {worst.asked:.3g} asked"
    return (
        f"Made by bench plan-points for the errors of {bench.name}.\n"
        f"{points.count} settings in {len(points.visits)} mountings, about {duration(points.time_s)}.\n"
        f"Least well reached: {least} (standard uncertainty, generalised least squares).\n"
    )


def budget_of(request: Budget) -> BudgetResult:
    """Return the contribution of each bench error to the coefficients and to any measured acceleration.

    `procedure` states the readings of the calibration. `coefficients` (a result of `bench calibrate --json`)
    describes the block; the default is the block in the bench file. `trials` is the number of Monte Carlo trials
    that check the linear propagation (0: none). `limit` of Δg in g, `rule` ("simple", "guarded" or "non-binary")
    and `guard_band` in U replace the values of the bench file. `same_voltmeters` states that the block will be
    used with the voltmeters of the calibration. `g` is local gravity in m/s². Raises `Refused`,
    `CalibrationError`, `FileMistakes`.
    """
    check_gravity(request.g)
    estimator = in_a_budget(request.estimator).name
    if request.trials:
        try:
            require_trials(request.trials)
        except CalibrationError as error:
            raise Refused(f"--trials: {error}, or 0 for none") from None
    taken = find_bench_file(request.bench)
    file = _with_gravity(taken, request.g)
    judgement = judgement_of(file, VerdictOptions(request.limit, request.rule, request.guard_band))
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


budget = python_call(Budget, budget_of, "budget")


def _with_gravity(taken: BenchTaken, g_m_s2: float | None) -> BenchFile:
    """Return the bench file, with local gravity `g_m_s2` if given. Raises `Refused` if neither states gravity."""
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
    if coefficients is not None:
        block = read_coefficients(Path(coefficients), "V").block
        try:
            refuse_singular(block)
        except CalibrationError as error:
            raise Refused(f"{coefficients}: {error}") from None
        return block, str(coefficients)
    nominal = bench.simulation.block is None
    return bench.simulated_block(), message("nominal scale factors") if nominal else message(
        "block of the bench file"
    )


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


def requirements(request: Require) -> Requirements:
    """Return how large each error may be for k u to meet the accuracy. Raises `Refused`, `CalibrationError`."""
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
        left_out.append(
            message("what no reading shows (gain, temperature, nonlinearity of the block: --all-errors)")
            if of in COEFFICIENTS
            else message(
                "what no reading shows (gain, gravity, temperature, nonlinearity of the block: --all-errors)"
            )
        )
    if not (request.with_reading or of in COEFFICIENTS):
        left_out.append(message("the reading in use (--with-reading)"))
    # the variance not counted: that of the other sources and of the reading in use
    whole = replace(asked, sources=tuple(every), target=_target(request, file, reading=True)[0])
    reached, shares = asked.reached(), asked.shares()
    result = RequireResult.from_object(
        request,
        accuracy=accuracy,
        unit=unit,
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
        together=[LimitPart.of_limit(limit) for limit in together],
        why_not_together=why_not_together,
        alternatives=list(_alternatives(asked, file, plan)),
    )
    return Requirements(
        result, _up_to_g(request.up_to, file) if of in ACCELERATIONS else None, tuple(left_out)
    )


def _target(request: Require, bench: BenchFile, *, reading: bool) -> tuple[Target, str, QuantityKind]:
    """Return the quantity that must be accurate, then unit and kind of quantity of the stated accuracy."""
    of, up_to = request.of, request.up_to
    if up_to is not None and of not in ACCELERATIONS:
        raise Refused("--up-to needs --of acceleration or --of modulus; add one")
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
        raise Refused(f"--up-to {up_to}: give an acceleration above 0, such as 5g")
    return up_to_g


def _costs(share: str, given: Sequence[str], names: Sequence[str]) -> dict[str, float] | None:
    """Return the weight of each error's cost by name; None for equal parts. Raises `Refused`."""
    if share not in {"equal", "cost"}:
        raise Refused(f"--share: give equal or cost, not {share!r}")
    if given and share != "cost":
        raise Refused("--cost needs --share cost; add it")
    if share == "equal":
        return None
    costs = {}
    for text in given:
        name, weight = named("--cost", text, "mounting_error=4")
        if name not in names:
            raise Refused(f"--cost {text}: no error {name!r} to share; choose from {', '.join(names)}")
        try:
            costs[name] = float(weight)
        except ValueError:
            costs[name] = math.nan
        if not (math.isfinite(costs[name]) and costs[name] > 0):
            raise Refused(f"--cost {text}: give a positive weight")
    return costs


def _alternatives(asked: Requirement, bench: BenchFile, plan: Plan) -> Iterator[AlternativePart]:
    """Yield the results of other estimators with the procedure of `plan`, then those of other procedures."""
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
    """Yield the result of the alternative `asked`; nothing if its estimator cannot use the readings."""
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
