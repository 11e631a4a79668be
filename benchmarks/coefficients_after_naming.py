"""After naming, are the twelve coefficients within their covariance? Over the blind trial's effects, by name.

    python -m benchmarks.coefficients_after_naming --rho 15 30 --each 4
    python -m benchmarks.coefficients_after_naming --only hysteresis --design both --each 20

Cases are those of the blind trial (`Row("single", design, rho)`): its own forms, not the catalogue's. Counted are
those in which the true effect alone was found, with ties or without; a chi-square of the twelve errors that chance
exceeds in 1 % or less is a miss, so 99 % are due where all is right (promised: 96 %). `rms pull` is the root mean
square of the twelve errors in units of their u. The coefficients are those at 20 °C, from which a model counts
temperature: the trial's effects of temperature, which are nothing at 23 °C, have what they do at 20 °C in them.
Each share is followed by the counts and the Wilson 95 % interval.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.stats import chi2

from bench.base.arrays import Floats
from bench.model import CATALOGUE as NAMES
from benchmarks.blind_trial.adapter import diagnose_case
from benchmarks.blind_trial.cases import Row, make_case
from benchmarks.blind_trial.effects import CATALOGUE
from benchmarks.blind_trial.score import (
    MODEL_COUNTS_FROM_C,
    SIGNIFICANT,
    Outcome,
    Task,
    coefficients_at,
    run_trial,
)
from benchmarks.campaign import Share, arguments


def tasks(seed: int, row: Row, each: int, only: Sequence[str]) -> list[Task]:
    """Return so many cases of each effect whose turn it is in the row."""
    names = list(CATALOGUE)
    turns = [i for i, name in enumerate(names) if not only or name in only]
    return [Task(seed, row, turn + k * len(names)) for k in range(each) for turn in turns]


def judged(outcome: Outcome) -> tuple[str, str, bool, Floats, float] | None:
    """Return name, shape, whether it stands alone, the pulls (12,) and p; None where it is not what was found."""
    task = outcome.task
    _, answer = make_case(task.seed, task.row, task.index)
    diagnosis = outcome.diagnosis
    truth = answer.effects[0]
    if diagnosis is None or diagnosis["verdict"] not in {"named", "confounded"}:
        return None
    if {effect["name"] for effect in diagnosis["effects"]} != {truth.name}:
        return None
    estimate = diagnosis["coefficients"]["after"]
    true = coefficients_at(MODEL_COUNTS_FROM_C, task.seed, task.row, task.index)
    error, covariance = np.array(estimate["value"]) - true, np.array(estimate["covariance"])
    p = float(chi2.sf(error @ np.linalg.solve(covariance, error), len(error)))
    return truth.name, truth.shape, diagnosis["verdict"] == "named", error / np.sqrt(np.diag(covariance)), p


def has_shape(name: str) -> bool:
    """Whether an effect has a shape in which the readings are not linear."""
    return any(parameter.is_shape for parameter in NAMES[name].parameters)


def share(ps: Iterable[float]) -> str:
    """Return how many are above 1 %, with the interval."""
    values = list(ps)
    return str(Share(sum(p > SIGNIFICANT for p in values), len(values)))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases and print the table; return the exit status."""
    given = arguments(
        __doc__, argv, seed=11, rho=[15.0, 30.0], design=["paper"],
        each=(4, "cases of each effect at each rho and design"),
        only={"nargs": "+", "default": [], "choices": list(CATALOGUE), "metavar": "EFFECT"}, workers=1,
    )  # fmt: skip
    rows = [Row("single", design, rho) for design in given.design for rho in given.rho]
    todo = [task for row in rows for task in tasks(given.seed, row, given.each, given.only)]
    start = time.perf_counter()
    by_form: dict[tuple[str, str], list[tuple[bool, Floats, float]]] = defaultdict(list)
    for outcome in run_trial(todo, diagnose_case, given.workers):
        found = judged(outcome)
        if found is not None:
            by_form[found[:2]].append(found[2:])
    print("| effect | its form | within | rms pull | largest of a coefficient |\n|---|---|---|---|---|")
    for (name, shape), cases in sorted(by_form.items()):
        pulls = np.sqrt(np.mean([pull**2 for _, pull, _ in cases], axis=0))
        rms = float(np.sqrt(np.mean(pulls**2)))
        print(f"| {name} | {shape or '–'} | {share(p for *_, p in cases)} | {rms:.2f} | {pulls.max():.2f} |")
    for words, alone_only, shaped in (
        ("named, all", True, None),
        ("named, with a shape", True, True),
        ("named, without", True, False),
        ("named or tied, all", False, None),
        ("named or tied, with a shape", False, True),
    ):
        ps = [
            p
            for (name, _), cases in by_form.items()
            for alone, _, p in cases
            if (alone or not alone_only) and shaped in (None, has_shape(name))
        ]
        print(f"{words}: {share(ps)}")
    print(f"{len(todo)} cases, seed {given.seed}, {time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
