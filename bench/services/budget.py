"""The budget of a bench, and its inverse: what the bench must be for an accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from bench.base.computing import tracked
from bench.base.files import write_whole
from bench.base.tables import as_html, as_text
from bench.base.units import ACCELERATION, SCALE_FACTOR, VOLTAGE, QuantityKind
from bench.calibration.budget.assessment import Assessment, Question, assess
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.propagation import COVERAGE, require_trials
from bench.calibration.budget.setup import Setup, make_setup
from bench.calibration.budget.sources import bench_sources
from bench.calibration.estimators import ESTIMATORS, GLS, in_a_budget
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
from bench.services.arguments import checked
from bench.services.bench_selection import BenchTaken, find_bench_file
from bench.services.coefficients import read_coefficients
from bench.services.errors import Refused
from bench.services.learned import take_learned, with_effects
from bench.services.quantities import named, quantity
from bench.services.source import NO_GRAVITY, check_gravity
from bench.services.verification import Asked, judgement_of
from drivers.clock import utc_now


@dataclass(frozen=True)
class BudgetResult:
    """A budget: `head` says of what, `assessment` holds the sizes, `bench` which bench file they are from."""

    bench: str
    head: Mapping[str, Any]
    assessment: Assessment

    @property
    def capable(self) -> bool | None:
        """Whether every verification point can be passed with the coverage probability; None without points."""
        return self.assessment.capable

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench budget --json` writes it."""
        return {**self.head, **self.assessment.to_json()}

    def report(self, path: str | Path) -> None:
        """Write the page (HTML, with everything in it). Raises `OSError`."""
        from bench.results.budget import render_budget

        write_whole(Path(path), render_budget(self.to_dict()))

    def print_on(self, out: Console) -> None:
        """Print coefficients by source, measured accelerations, the check, Monte Carlo and notes."""
        from bench.results.budget import print_budget

        print_budget(self.head, self.assessment, out)

    def __repr__(self) -> str:
        """Return the tables with what a reader should know."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"

    def _repr_html_(self) -> str:
        from bench.results.budget import acceleration_table, coefficient_table, headline

        found = self.assessment
        tables = coefficient_table(found.budget), acceleration_table(found)
        notes = (f"note: {note}" for note in found.notes)
        return as_html([headline(self.head, found)], *tables) + as_html([f"bench: {self.bench}", *notes])


@checked()
def budget(
    bench: str | Path | BenchFile | BenchTaken | None = None,
    procedure: str = "calibration",
    estimator: str = GLS,
    *,
    model: str | Path | None = None,
    coefficients: str | Path | None = None,
    trials: int = 20_000,
    rule: str | None = None,
    limit: float | None = None,
    guard_band: float | None = None,
    same_voltmeters: bool = False,
    g: float | None = None,
) -> BudgetResult:
    """Return what each error of a bench contributes to the coefficients and to any measured acceleration.

    `procedure` says which readings a calibration is of, `coefficients` (a result of `bench calibrate --json`)
    of which block, `trials` how many Monte Carlo trials judge the linear result (0: none), `limit` the limit of
    Δg in g and `rule` ("simple", "guarded" or "non-binary", with `guard_band` in U) how it is judged, the bench
    file's unless given; `same_voltmeters` that the block is used with those of the calibration, `g` local gravity
    in m/s². Raises `Refused`, `CalibrationError`, `FileMistakes`.
    """
    check_gravity(g)
    estimator = in_a_budget(estimator).name
    if trials:
        _check_trials(trials)
    taken = find_bench_file(str(bench) if isinstance(bench, Path) else bench)
    file = _with_gravity(taken, g)
    judgement = judgement_of(file, Asked(limit, rule, guard_band))
    plan = load_procedure(find_procedure(procedure)).expand()
    block, about = _block(coefficients, file)
    today = utc_now().date()
    learned = take_learned(taken.learned(), today, VOLTS)
    setup = make_setup(plan, file, with_effects(_model(model, file), learned.effects), block)
    question = Question(
        file.unit_under_test.range, judgement.limit_g, judgement.rule, trials, same_voltmeters,
        judgement.population,
    )  # fmt: skip
    found = assess(
        setup, bench_sources(file, setup, today, learned.known), estimator, question, learned.known
    )
    found = replace(found, beside=learned.notes)
    head = {
        "bench": file.name,
        "bench_file": taken.to_dict(),
        "procedure": plan.name,
        "model": setup.model.name,
        "about": about,
        "g_m_s2": file.gravity_m_s2,
        "readings": {"fitted": int(setup.fitted.sum()), "verification": int(setup.verification.sum())},
    }
    return BudgetResult(taken.words, head, found)


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
