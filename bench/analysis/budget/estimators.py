"""The estimators as linear maps from readings to coefficients, at the readings of a setup."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from bench.analysis.budget.setup import Setup
from bench.analysis.calibration import gls
from bench.analysis.calibration.assumptions import require_rank
from bench.analysis.calibration.design import FIXED, Problem, make_problem
from bench.analysis.calibration.estimator import Task
from bench.analysis.calibration.estimators import in_a_budget
from bench.analysis.calibration.known import KnownStand
from bench.analysis.calibration.result import Noise
from bench.base.arrays import Floats
from bench.model import STAND_ANGLES


def gain(
    estimator: str, setup: Setup, stated: Mapping[str, float], known: KnownStand | None = None
) -> Floats:
    """Return the map from readings to the 12 coefficients, shape (12, n, 3); zero at verification points.

    `stated` are the standard uncertainties of the stand errors by name (rad, V), from which generalised least
    squares weighs the readings, `known` what was learned in their place.
    An estimator that no fixed weighting is has the map at which it comes to rest
    where nothing is an outlier. Raises `CalibrationError` for another estimator, or when the readings do not
    determine the coefficients or are not those that the closed form knows.
    """
    by = in_a_budget(estimator)
    require_rank(setup.force[setup.fitted])
    stand_u = {name: stated.get(name, 0.0) for name in STAND_ANGLES}
    if known is not None:
        # a mean that is known is taken away: what is left of it lies about nothing
        known = replace(known, mean=np.zeros_like(known.mean))
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), stand_u, known=known)
    whole = np.zeros((FIXED, len(setup.conditions), 3))
    if by.gain is not None:
        whole[:, setup.fitted] = by.gain(problem, setup.readings())
    else:
        whole[:, setup.fitted] = by.weigh(_task(problem, setup, stated, known)).gain[:FIXED]
    return whole


def _task(problem: Problem, setup: Setup, stated: Mapping[str, float], known: KnownStand | None) -> Task:
    """The first step from the truth of noise-free readings has the gain of the last one from real readings."""
    signal = setup.signal[setup.fitted]
    floor = gls.LEAST_NOISE * float(np.max(np.abs(signal)))
    reading, setting = max(stated.get("voltmeter_error", 0.0), floor), stated.get("setting_error", 0.0)
    noise = Noise(reading, setting, np.inf, "given")
    if known is not None and known.noise is not None:
        noise = known.noise.given()
    fit = partial(gls.fit, problem, signal, setup.block, noise)
    return Task(problem, signal, fit(), lambda shifts: fit(shifts=shifts))
