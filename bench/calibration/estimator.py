"""What an estimator is: one way from readings to coefficients. A module that has one has it as `ESTIMATOR`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.base.arrays import Floats
    from bench.calibration.design import Problem
    from bench.calibration.gls import Fit, Shift
    from bench.readings.table import Readings


@dataclass(frozen=True)
class Task:
    """Readings to weigh: their `signal` (n, 3) in V, `fit` by generalised least squares, and how to fit anew.

    `refit` takes the shifts of readings that are to have no weight.
    """

    problem: Problem
    signal: Floats
    fit: Fit
    refit: Callable[[tuple[Shift, ...]], Fit]


def _as_it_is(task: Task) -> Fit:
    return task.fit


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
    weigh: Callable[[Task], Fit] = _as_it_is
    gain: Callable[[Problem, Readings], Floats] | None = None
    angles_rad: Callable[[Readings], Floats] | None = None
    drops_outliers: bool = False
    also: tuple[str, ...] = ()
    counts_as: str = ""

    @property
    def weighs_all(self) -> bool:
        """Whether it can take readings whose modulus alone is known."""
        return self.gain is None
