"""What each error of a bench contributes to the coefficients and to any measured acceleration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.analysis.budget.assessment import Assessment, Question, assess
from bench.analysis.budget.monte_carlo import require_trials
from bench.analysis.budget.propagation import COVERAGE
from bench.analysis.budget.setup import make_setup
from bench.analysis.budget.sources import bench_sources
from bench.analysis.calibration.estimators import GLS, in_a_budget
from bench.analysis.calibration.mistakes import refuse_singular
from bench.analysis.calibration.result import CalibrationError
from bench.api.arguments import checked
from bench.api.coefficients import read_coefficients
from bench.api.errors import Refused
from bench.api.learned import take_learned, with_effects
from bench.api.source import NO_GRAVITY, check_gravity
from bench.api.taken import BenchTaken, find_bench_file
from bench.api.verification import Asked, judgement_of
from bench.base.tables import as_html, as_text
from bench.base.whole import write_whole
from bench.files.bench.file import BenchFile
from bench.files.model import load_model
from bench.files.shipped import find_procedure
from bench.model import Block, ForwardModel
from bench.procedure.load import load_procedure
from bench.readings.corrected import VOLTS
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
        from bench.report.budget.page import render_budget

        write_whole(Path(path), render_budget(self.to_dict()))

    def print_on(self, out: Console) -> None:
        """Print coefficients by source, measured accelerations, the check, Monte Carlo and notes."""
        from bench.report.budget.terminal import print_budget

        print_budget(self.head, self.assessment, out)

    def __repr__(self) -> str:
        """Return the tables with what a reader should know."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"

    def _repr_html_(self) -> str:
        from bench.report.budget.terminal import acceleration_table, coefficient_table, headline

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
