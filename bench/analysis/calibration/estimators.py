"""The estimators, each once: what `calibrate`, `budget`, `require` and their help texts know of them.

A further one is a module of its own and one line in `ESTIMATORS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from bench.analysis.calibration import gls, outliers
from bench.analysis.calibration.closed_form import closed_form_gain, nominal_angles_rad
from bench.analysis.calibration.design import Problem
from bench.analysis.calibration.linear import least_squares_gain
from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats
from bench.readings.table import Readings

GLS: Final = "gls"
"""The name of the one that is used where none is asked for."""
CLOSED_FORM: Final = "closed-form"
ROBUST: Final = "robust"


@dataclass(frozen=True)
class Task:
    """Readings to weigh: their `signal` (n, 3) in V, `fit` by generalised least squares, and how to fit anew.

    `refit` takes the shifts of readings that are to have no weight.
    """

    problem: Problem
    signal: Floats
    fit: gls.Fit
    refit: Callable[[tuple[gls.Shift, ...]], gls.Fit]


def _as_it_is(task: Task) -> gls.Fit:
    return task.fit


def _without_outliers(task: Task) -> gls.Fit:
    return outliers.search(task.problem, task.fit, task.refit, outliers.most_outliers(task.problem))


@dataclass(frozen=True)
class Estimator:
    """One way from readings to coefficients; `phrase` says it in a few words, `also` are further names.

    `gain` gives the map (12, n, 3) of one that weighs the readings in a fixed manner; it takes oriented
    readings alone. Without it `weigh` gives the fit. Its map in a budget is then the one at which it comes to
    rest from readings without errors, in which nothing is an outlier: a budget is linear, and so shows what the
    estimator does to usual errors, not what it gains or loses where a reading is an outlier. Where that map is
    another estimator's, `counts_as` names it. `angles_rad` gives the angles (n,) that it takes for granted and
    raises `CalibrationError` for other readings; left out, they are those of the readings.
    """

    name: str
    phrase: str
    weigh: Callable[[Task], gls.Fit] = _as_it_is
    gain: Callable[[Problem, Readings], Floats] | None = None
    angles_rad: Callable[[Readings], Floats] | None = None
    drops_outliers: bool = False
    also: tuple[str, ...] = ()
    counts_as: str = ""

    @property
    def weighs_all(self) -> bool:
        """Whether it can take readings whose modulus alone is known."""
        return self.gain is None


ESTIMATORS: Final[Mapping[str, Estimator]] = {
    estimator.name: estimator
    for estimator in (
        Estimator(GLS, "all readings, weighed"),
        Estimator(
            CLOSED_FORM,
            "the paper's (7)-(8)",
            gain=lambda _, rows: closed_form_gain(rows),
            angles_rad=nominal_angles_rad,
        ),
        Estimator(
            "least-squares",
            "all readings alike",
            gain=lambda problem, _: least_squares_gain(problem),
            also=("ols",),
        ),
        Estimator(
            ROBUST,
            "gls without the weight of outliers",
            _without_outliers,
            drops_outliers=True,
            counts_as=GLS,
        ),
    )
}


def find_estimator(asked: str) -> Estimator:
    """Return the estimator of a name. Raises `CalibrationError` for another."""
    for estimator in ESTIMATORS.values():
        if asked in {estimator.name, *estimator.also}:
            return estimator
    raise CalibrationError(f"no estimator {asked!r}; there are {', '.join(ESTIMATORS)}")


def in_a_budget(asked: str) -> Estimator:
    """Return the estimator whose linear map is that of the one asked for. Raises `CalibrationError`."""
    estimator = find_estimator(asked)
    return ESTIMATORS[estimator.counts_as or estimator.name]


def estimators_in_words(*, budget: bool = False) -> str:
    """Return the names and what they are as a help text; `budget` adds what some count as in a budget."""
    phrases = [f"{' or '.join((e.name, *e.also))} ({e.phrase})" for e in ESTIMATORS.values()]
    text = f"{', '.join(phrases[:-1])}, or {phrases[-1]}"
    counted = [f"{e.name} counts as {e.counts_as}" for e in ESTIMATORS.values() if e.counts_as]
    return f"{text}; where nothing is an outlier, {', '.join(counted)}." if budget and counted else f"{text}."
