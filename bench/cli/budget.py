"""budget: what each error of a bench contributes to the coefficients and to any measured acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.analysis.budget.assessment import Assessment, Question, assess
from bench.analysis.budget.monte_carlo import require_trials
from bench.analysis.budget.propagation import COVERAGE
from bench.analysis.budget.setup import make_setup
from bench.analysis.budget.sources import bench_sources
from bench.analysis.calibration.estimators import in_a_budget
from bench.analysis.calibration.mistakes import refuse_singular
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.calibration.verification import rule_name
from bench.cli import CommandError, budget_printing, printing
from bench.cli.coefficients import read_coefficients
from bench.cli.source import bench_path, check_gravity, check_target, write_json, write_whole
from bench.files.bench.file import BenchFile, load_bench
from bench.files.model import load_model
from bench.files.shipped import find_procedure
from bench.model import Block, ForwardModel
from bench.procedure.load import load_procedure


@dataclass(frozen=True)
class Request:
    """The options of `bench budget`."""

    bench: str | None
    procedure: str
    estimator: str
    model: Path | None
    coefficients: Path | None
    trials: int
    rule: str | None
    limit_g: float | None
    same_voltmeters: bool
    g_m_s2: float | None
    json: str | None
    out: Path | None


def budget(request: Request) -> int:
    """Carry out `bench budget`; 1 when a rule was asked for and the check cannot be passed by it."""
    check_target(request.json)
    check_gravity(request.g_m_s2)
    estimator, rule = in_a_budget(request.estimator).name, rule_name(request.rule or "simple")
    if request.trials:
        _check_trials(request.trials)
    bench = _bench(request)
    plan = load_procedure(find_procedure(request.procedure)).expand()
    block, about = _block(request, bench)
    setup = make_setup(plan, bench, _model(request, bench), block)
    question = Question(
        bench.unit_under_test.range, _limit(request, bench), rule, request.trials, request.same_voltmeters
    )
    found = assess(setup, bench_sources(bench, setup), estimator, question)
    head = {
        "bench": bench.name,
        "procedure": plan.name,
        "model": setup.model.name,
        "about": about,
        "g_m_s2": bench.gravity_m_s2,
        "readings": {"fitted": int(setup.fitted.sum()), "verification": int(setup.verification.sum())},
    }
    result = {**head, **found.to_json()}
    write_json([result], request.json)
    if request.out is not None:
        _write_page(request.out, result, request.json)
    if request.json != "-":
        budget_printing.assessment(head, found)
    return _status(request, found)


def _check_trials(trials: int) -> None:
    try:
        require_trials(trials, COVERAGE)
    except CalibrationError as error:
        raise CommandError(f"--trials: {error}, or 0 for none") from None


def _status(request: Request, found: Assessment) -> int:
    return 1 if request.rule is not None and found.capable is False else 0


def _bench(request: Request) -> BenchFile:
    """Return the bench, with the gravity asked for in place of its own."""
    path = bench_path(request.bench)
    bench = load_bench(path)
    if request.g_m_s2 is not None:
        bench = bench.model_copy(update={"gravity": request.g_m_s2})
    if bench.gravity_m_s2 is None:
        raise CommandError(f"{path}: gives no local gravity; add 'gravity' to it, or say --g 9.81 (m/s²)")
    return bench


def _limit(request: Request, bench: BenchFile) -> float:
    limit_g = bench.verification_limit_g if request.limit_g is None else request.limit_g
    if not (math.isfinite(limit_g) and limit_g > 0):
        raise CommandError(f"--limit {limit_g}: a limit is a positive number of g, such as 3e-4")
    return limit_g


def _model(request: Request, bench: BenchFile) -> ForwardModel:
    model = ForwardModel(bench.installation_models())
    if request.model is None:
        return model
    file = load_model(request.model, model.installations)
    return replace(model, effects=file.applied_effects(), name=file.name)


def _block(request: Request, bench: BenchFile) -> tuple[Block, str]:
    """Return the block about which the budget is, and which one that is."""
    if request.coefficients is not None:
        block = read_coefficients(request.coefficients, "V").block
        try:
            refuse_singular(block)
        except CalibrationError as error:
            raise CommandError(f"{request.coefficients}: {error}") from None
        return block, str(request.coefficients)
    nominal = bench.simulation.block is None
    return bench.simulated_block(), "nominal scale factors" if nominal else "block of the bench file"


def _write_page(folder: Path, result: dict[str, Any], target: str | None) -> None:
    """Write the page and its figures. Raises `OSError`."""
    from bench.report.budget.page import render_budget
    from bench.report.budget.plots import figures

    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "budget.html"
    write_whole(page, render_budget(result))
    out = printing.console(json=target)
    printing.written("page", page, out)
    for figure in figures(result):
        for file in figure.save(folder):
            printing.written("figure", file, out)
