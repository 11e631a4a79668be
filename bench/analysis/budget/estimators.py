"""The estimators as linear maps from readings to coefficients, at the readings of a setup."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from bench.analysis.budget.setup import Setup, rows_of
from bench.analysis.calibration import gls
from bench.analysis.calibration.assumptions import require_rank
from bench.analysis.calibration.closed_form import closed_form_gain
from bench.analysis.calibration.design import FIXED, Problem, make_problem
from bench.analysis.calibration.linear import least_squares_gain
from bench.analysis.calibration.result import CalibrationError, Noise
from bench.base.arrays import Floats
from bench.model import STAND_ANGLES

ESTIMATORS: Final = ("gls", "closed-form", "least-squares")
_ALSO_CALLED: Final = {"ols": "least-squares", "robust": "gls"}


def estimator_name(asked: str) -> str:
    """Return the name of an estimator; "ols" is least squares, "robust" is gls where nothing is an outlier.

    Raises `CalibrationError` for another.
    """
    name = _ALSO_CALLED.get(asked, asked)
    if name not in ESTIMATORS:
        raise CalibrationError(f"no estimator {asked!r}; there are {', '.join(ESTIMATORS)}")
    return name


def gain(estimator: str, setup: Setup, stated: Mapping[str, float]) -> Floats:
    """Return the map from readings to the 12 coefficients, shape (12, n, 3); zero at verification points.

    `stated` are the standard uncertainties of the stand errors by name (rad, V), from which generalised least
    squares weighs the readings. Raises `CalibrationError` for another estimator, or when the readings do not
    determine the coefficients or are not those that the closed form knows.
    """
    require_rank(setup.force[setup.fitted])
    build = {"gls": _gls, "closed-form": _closed_form, "least-squares": _least_squares}[
        estimator_name(estimator)
    ]
    whole = np.zeros((FIXED, len(setup.conditions), 3))
    whole[:, setup.fitted] = build(setup, stated)
    return whole


def _closed_form(setup: Setup, stated: Mapping[str, float]) -> Floats:
    return closed_form_gain(setup.readings())


def _least_squares(setup: Setup, stated: Mapping[str, float]) -> Floats:
    return least_squares_gain(_problem(setup, {}))


def _gls(setup: Setup, stated: Mapping[str, float]) -> Floats:
    """The first step from the truth of noise-free readings has the gain of the last one from real readings."""
    problem = _problem(setup, {name: stated.get(name, 0.0) for name in STAND_ANGLES})
    signal = setup.signal[setup.fitted]
    floor = gls.LEAST_NOISE * float(np.max(np.abs(signal)))
    reading, setting = max(stated.get("voltmeter_error", 0.0), floor), stated.get("setting_error", 0.0)
    fit = gls.fit(problem, signal, setup.block, Noise(reading, setting, np.inf, "given"))
    return fit.gain[:FIXED]


def _problem(setup: Setup, stand_u: Mapping[str, float]) -> Problem:
    return make_problem(setup.model, rows_of(setup.conditions, setup.fitted), stand_u)
