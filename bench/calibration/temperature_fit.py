"""The fit of temperature polynomials to readings; the data choose the degree of each coefficient."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask, rms, u_of
from bench.base.languages import message
from bench.calibration.calibrate import usable_rows
from bench.calibration.components import note_on_prior
from bench.calibration.design import FIXED, STEP_RAD, Problem, coefficient_columns, make_problem
from bench.calibration.gls import (
    FAR_FROM_STILL,
    MOST_ITERATIONS,
    NEARLY_STILL,
    STANDS_STILL,
    System,
    estimate_noise,
    misfit_test,
    noise_floor,
    solve,
)
from bench.calibration.noise import require_told, whiten
from bench.calibration.noise_growth import grows, growth_of, note_on_growth
from bench.calibration.observability import require_rank
from bench.calibration.result import CalibrationError, LackOfFit, Noise
from bench.calibration.temperature import (
    Plateau,
    PlateauResult,
    TemperatureModel,
    ThermalHysteresis,
    ThermalReadings,
    inner_range,
    sort_readings,
)
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, linear_columns
from bench.readings.table import Readings

WEAKEST: Final = 1e-3
"""Terms are determined if the least singular value of their unit columns exceeds this part of the largest."""


@dataclass(frozen=True)
class ThermalProblem:
    """The input of a fit over temperature: readings, their basis functions, and the unknown terms.

    `signal` (n, 3) are the readings, `basis` (n, m) the values of m basis functions at the readings. `terms` (12,
    m) is true for each coefficient and basis function that the fit estimates. `problem` has the conditions, with an
    index for each mounting, and the stand angles; the size of those in `assumed` is only assumed. `groups` (n,)
    numbers the groups of repeats. `floor` is the lower limit of the noise, in the unit of the signal. `growth` (3,)
    is the noise per signal, divided by the noise at zero signal.
    """

    problem: Problem
    signal: Floats
    basis: Floats
    terms: Mask
    groups: Ints
    floor: float
    assumed: frozenset[str] = frozenset()
    growth: Floats | float = 0.0

    def level(self, values: Floats) -> Floats:
        """Return what makes the noise of all signals (n, 3) of a channel equal, 1 at zero signal."""
        return np.asarray(1.0 / np.hypot(1.0, self.growth * self.without_bias(values)))

    def without_bias(self, values: Floats) -> Floats:
        """Return the signals minus U0, (n, 3)."""
        return np.asarray(self.signal - self.basis @ values[9:].T)

    def force(self, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the specific force of each row on the axes of the block, g, shape (n, 3).

        `others` (q,) are the stand angles, rad; `setting_rad` is the setting error of the head.
        """
        still = Block(np.eye(3), np.zeros(3))
        problem = self.problem
        return problem.model.specific_force(
            problem.conditions, problem.stand_matrix(others), still, setting_rad
        )

    def predict(self, values: Floats, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the readings (n, 3) for values (12, m) of the terms and stand angles `others` (q,)."""
        coefficients = self.basis @ values.T
        return row_outputs(coefficients, self.force(others, setting_rad))

    def slope(self, values: Floats, others: Floats) -> Floats:
        """Return du/dphi (n, 3), as `Problem.slope` does."""
        forward, back = (self.predict(values, others, step) for step in (STEP_RAD, -STEP_RAD))
        return (forward - back) / (2 * STEP_RAD)

    def jacobian(self, values: Floats, others: Floats) -> Floats:
        """Return the derivatives (n, 3, t + q) of the readings by the t unknown terms, then by the q angles."""
        one_each = coefficient_columns(self.force(others))
        coefficient, function = np.nonzero(self.terms)
        by_term = one_each[:, :, coefficient] * self.basis[:, None, function]
        by_angle = np.empty((*self.signal.shape, len(others)))
        for j in range(len(others)):
            step = np.zeros_like(others)
            step[j] = STEP_RAD
            difference = self.predict(values, others + step) - self.predict(values, others - step)
            by_angle[:, :, j] = difference / (2 * STEP_RAD)
        return np.concatenate([by_term, by_angle], axis=2)

    def determined(self) -> bool:
        """Whether the readings determine all terms if every coefficient has all basis functions."""
        force = self.force(self.problem.prior_mean)
        columns = linear_columns(force)
        whole = (columns[:, :, None] * self.basis[:, None, :]).reshape(len(force), -1)
        if whole.shape[1] > whole.shape[0]:
            return False
        length = np.linalg.norm(whole, axis=0)
        if np.any(length == 0):
            return False
        size = np.linalg.svd(whole / length, compute_uv=False)
        return bool(size[-1] > WEAKEST * size[0])


@dataclass(frozen=True)
class ThermalFit:
    """A fit over temperature: estimates `values` (12, m), zero for terms not fitted, and their covariance.

    `covariance` (t, t) has the t fitted terms in the order of `numpy.nonzero(terms)`; `of_assumed` (t, t) is its
    part due to stand angles of merely assumed size. `others` (q,) are the stand angles, rad. `misfit` is the
    chi-square of residuals and priors; `residuals` and `slope` (du/dphi) are (n, 3). If the noise grows with the
    signal, both are multiplied by the level of the task. `left` (n, 3) is the part of its variance that each
    residual keeps, as the fit follows the readings.
    """

    values: Floats
    terms: Mask
    covariance: Floats
    of_assumed: Floats
    others: Floats
    noise: Noise
    misfit: float
    residuals: Floats
    slope: Floats
    left: Floats

    @property
    def vector(self) -> Floats:
        """The fitted terms, shape (t,)."""
        return self.values[self.terms]


def row_outputs(coefficients: Floats, force: Floats) -> Floats:
    """Return U = K a + U0 (n, 3) for coefficients (n, 12) and forces (n, 3), g, row by row."""
    scale = coefficients[:, :9].reshape(-1, 3, 3)
    return np.asarray(np.einsum("nij,nj->ni", scale, force) + coefficients[:, 9:], dtype=np.float64)


def fit(task: ThermalProblem, noise: Noise | None = None) -> ThermalFit:
    """Return the fit of the terms; the noise is estimated from the readings unless given.

    Raises `CalibrationError` if the fit does not converge.
    """
    values, others = _first_guess(task), task.problem.prior_mean
    count = int(task.terms.sum())
    sizes = noise or _estimated_noise(task, values, others)
    moved = np.inf
    for _ in range(MOST_ITERATIONS):
        system = _linearise(task, values, others)
        found = solve(task.problem, system, sizes.widened(), others)
        step, covariance = found.step, found.covariance
        values[task.terms] += step[:count]
        others = others + step[count:]
        moved = float(np.max(np.abs(step) / u_of(covariance)))
        if moved <= STANDS_STILL:
            break
        if noise is None and moved > NEARLY_STILL:
            sizes = _estimated_noise(task, values, others)
    if not moved < FAR_FROM_STILL:
        raise CalibrationError(
            f"the fit over temperature did not converge: after {MOST_ITERATIONS} steps a term still moves by "
            f"{moved:.2g} of its standard uncertainty; check for rows of another installation, block or unit"
        )
    residuals = task.level(values) * (task.signal - task.predict(values, others))
    whitened = whiten(residuals[:, :, None], system.slope, sizes)
    pulls = task.problem.pulls(others)
    misfit = float(np.sum(whitened**2) + np.sum(pulls**2))
    own = covariance[:count, :count]
    at = count + np.flatnonzero([STAND_ANGLES[one.column] in task.assumed for one in task.problem.stand])
    across = covariance[:count, at]
    of_assumed = across @ np.linalg.solve(covariance[np.ix_(at, at)], across.T)
    left = 1.0 - np.sum(found.q[: residuals.size] ** 2, axis=1).reshape(-1, 3)
    return ThermalFit(
        values, task.terms, own, of_assumed, others, sizes, misfit, residuals, system.slope, left
    )


def _linearise(task: ThermalProblem, values: Floats, others: Floats) -> System:
    left = task.signal - task.predict(values, others)
    level = task.level(values)
    slope = level * task.slope(values, others)
    return System(level * left, level[:, :, None] * task.jacobian(values, others), slope, level=level)


def _estimated_noise(task: ThermalProblem, values: Floats, others: Floats) -> Noise:
    system = _linearise(task, values, others)
    return estimate_noise(task.problem, system, task.groups, others, task.floor)


def _first_guess(task: ThermalProblem) -> Floats:
    """Return the terms by ordinary least squares at the nominal geometry, channel by channel."""
    columns = linear_columns(task.force(task.problem.prior_mean))
    values = np.zeros(task.terms.shape)
    for channel in range(3):
        own = [*range(3 * channel, 3 * channel + 3), 9 + channel]
        where, function = np.nonzero(task.terms[own])
        design = columns[:, where] * task.basis[:, function]
        solution, *_ = np.linalg.lstsq(design, task.signal[:, channel], rcond=None)
        values[np.array(own)[where], function] = solution
    return values


def judge(task: ThermalProblem, result: ThermalFit) -> LackOfFit:
    """Test the residuals of a fit against the scatter of repeats at the same temperature (F test)."""
    return misfit_test(
        result.misfit, result.residuals, result.slope, result.noise, task.groups, int(task.terms.sum())
    )


STAYS_P: Final = 0.05
"""Significance level: the highest term of a coefficient is kept if its p-value is at most this."""

NEXT: Final = 2
"""Number of omitted terms, next above the chosen degree, that count in the uncertainty."""


@dataclass(frozen=True)
class DegreeChoice:
    """The chosen `degrees` (12,) of the polynomials, and `doubts` (2, 12, D + 1) about the dropped powers.

    `doubts[i, j]` are the changes of the terms of coefficient j if its polynomial also has the power
    `degrees[j]` + 1 + i of temperature. They are zero if this power exceeds D.
    """

    degrees: Ints
    doubts: Floats


def choose_degrees(full: ThermalFit, highest: int) -> DegreeChoice:
    """Choose the degrees of the polynomials in temperature by backward elimination.

    In the fit `full` every coefficient has the powers 0 to `highest`, as the first columns of its terms. Each step
    tests the highest remaining power of every coefficient by an F test with the noise's degrees of freedom. It
    drops the power with the largest p-value, until no p-value exceeds `STAYS_P`. The power 0 always stays.
    """
    coefficient, function = np.nonzero(full.terms)
    degrees = np.full(len(full.terms), highest, dtype=np.int64)
    while np.any(degrees > 0):
        keep = (function > highest) | (function <= degrees[coefficient])
        value, covariance = held_at_zero(full.vector, full.covariance, keep)
        top = function[keep] == degrees[coefficient[keep]]
        top &= function[keep] > 0
        ratio = value[top] ** 2 / np.diag(covariance)[top]
        p = special.fdtrc(1.0, min(full.noise.dof, 1e9), ratio)
        worst = int(np.argmax(p))
        if p[worst] <= STAYS_P:
            break
        degrees[coefficient[keep][top][worst]] -= 1
    return DegreeChoice(degrees, _doubts(full, highest, degrees))


def held_at_zero(value: Floats, covariance: Floats, keep: Mask) -> tuple[Floats, Floats]:
    """Return the estimate and covariance of the terms in the mask `keep` if all other terms are zero.

    `value` (t,) and `covariance` (t, t) are those of a fit with all t terms. The result equals the least-squares
    estimate of a fit with the kept terms alone.
    """
    pull = np.linalg.solve(covariance[np.ix_(~keep, ~keep)], covariance[np.ix_(~keep, keep)])
    return value[keep] - value[~keep] @ pull, covariance[np.ix_(keep, keep)] - covariance[
        np.ix_(keep, ~keep)
    ] @ pull


def _doubts(full: ThermalFit, highest: int, degrees: Ints) -> Floats:
    coefficient, function = np.nonzero(full.terms)
    doubts = np.zeros((NEXT, len(degrees), highest + 1))
    for step in range(NEXT):
        for j in np.flatnonzero(degrees + step < highest):
            new_one = (coefficient == j) & (function == degrees[j] + 1 + step)
            keep = (function > highest) | (function <= degrees[coefficient]) | new_one
            value, covariance = held_at_zero(full.vector, full.covariance, keep)
            own = (coefficient[keep] == j) & (function[keep] <= highest)
            new = int(np.flatnonzero(new_one[keep])[0])
            change = covariance[:, new] * value[new] / covariance[new, new]
            doubts[step, j, function[keep][own]] = change[own]
    return doubts


# --- the model over temperature -------------------------------------------------------------------


HIGHEST_DEGREE: Final = 4
"""Highest degree of an automatic choice: accelerometers hardly ever need a higher one over their range."""


@dataclass(frozen=True)
class _Body:
    """All readings, prepared for every fit; `scale_k` is the unit of temperature inside the fits, K."""

    sorted: ThermalReadings
    problem: Problem
    repeats: Ints
    floor: float
    reference_c: float
    scale_k: float
    assumed: frozenset[str]
    growth: Floats | float = 0.0

    def powers(self, degree: int, *, of_levels: bool = False) -> Floats:
        """Return the powers 0…degree (n, degree + 1) of the scaled temperature of each row.

        With `of_levels`, the temperature of a row is the mean of its level.
        """
        rows = self.sorted
        temperature = rows.rows.temperature_c
        if of_levels:
            means = np.bincount(rows.level, temperature) / np.bincount(rows.level)
            temperature = means[rows.level]
        offset = (temperature - self.reference_c) / self.scale_k
        return np.asarray(offset[:, None] ** np.arange(degree + 1), dtype=np.float64)

    def task(self, basis: Floats, terms: Mask | None = None) -> ThermalProblem:
        every = np.ones((FIXED, basis.shape[1]), dtype=np.bool_)
        signal = self.sorted.rows.signal
        return ThermalProblem(
            self.problem,
            signal,
            basis,
            every if terms is None else terms,
            self.repeats,
            self.floor,
            self.assumed,
            self.growth,
        )


def temperature_model(
    tables: Sequence[Readings],
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    reference_c: float = 23.0,
    degree: int | None = None,
    *,
    assumed_u: Mapping[str, float] | None = None,
) -> TemperatureModel:
    """Fit the twelve coefficients as polynomials in temperature to the readings of all tables.

    `stand_u` and `assumed_u` are as for `calibrate`; each mounting has angles of its own. Without `degree` the data
    choose the degree of each coefficient (see `choose_degrees`), from the highest that the temperatures allow
    downwards; the covariance then includes the uncertainty due to dropped terms. Raises `CalibrationError` if the
    model has effects, a row has no temperature, the temperatures are fewer than two or do not determine the
    polynomials, or the reference is outside their range.
    """
    body = _body(tables, model, stand_u, assumed_u or {}, reference_c)
    highest, by_side = _highest(body, degree)
    sides = body.sorted.branch / 2.0 * body.sorted.both_sides
    basis = np.column_stack([body.powers(highest), sides] if by_side else [body.powers(highest)])
    full = fit(body.task(basis))
    squared = whiten(full.residuals[:, :, None], full.slope, full.noise)[:, :, 0] ** 2
    told = grows(squared, body.task(basis).without_bias(full.values) ** 2)
    growth = None
    for _ in range(GROWTHS if told else 0):
        growth = _growth(body.task(basis), full)
        body = replace(body, growth=growth)
        full = fit(body.task(basis))
    require_told(full.noise)
    if degree is None:
        choice = choose_degrees(full, highest)
    else:
        choice = DegreeChoice(np.full(FIXED, degree), np.zeros((0, FIXED, highest + 1)))
    terms = np.arange(highest + 1) <= choice.degrees[:, None]
    if by_side:
        terms = np.column_stack([terms, np.ones(FIXED, dtype=np.bool_)])
    task = body.task(basis, terms)
    best = fit(task, full.noise)
    plateaus, free = _plateaus(body, best, basis)
    values, covariance, of_assumed = _in_kelvins(best, choice, body.scale_k)
    temperature_c = body.sorted.rows.temperature_c
    return TemperatureModel(
        unit=body.sorted.rows.unit,
        g_m_s2=g_m_s2,
        reference_c=reference_c,
        minimum_c=float(temperature_c.min()),
        maximum_c=float(temperature_c.max()),
        degrees=choice.degrees,
        values=values,
        covariance=covariance,
        of_assumed=of_assumed,
        hysteresis=_hysteresis(best) if by_side else None,
        plateaus=plateaus,
        noise=full.noise,
        growth=growth,
        fitted=judge(task, best),
        curve=None if free is None else _curve(best, free),
        readings=len(body.sorted.rows),
        skipped=len(body.sorted.rows.skipped),
        notes=(
            *_notes(body, plateaus, by_side),
            *note_on_prior(full.noise, body.sorted.rows.unit),
            *([] if growth is None else note_on_growth(growth * full.noise.by_channel, full.noise.dof)),
        ),
    )


def _body(
    tables: Sequence[Readings],
    model: ForwardModel,
    stand_u: Mapping[str, float],
    assumed_u: Mapping[str, float],
    reference_c: float,
) -> _Body:
    for table in tables:
        usable_rows(table, model)
    if model.effects:
        raise CalibrationError(
            f"model {model.name}: a temperature model has the paper's twelve coefficients and no effects; "
            "remove --model"
        )
    found = sort_readings(tables)
    low, high = float(found.rows.temperature_c.min()), float(found.rows.temperature_c.max())
    if found.levels < 2:
        raise CalibrationError(
            f"{found.rows.source}: all readings lie between {low:.1f} and {high:.1f} °C, too narrow a "
            "range; measure at three or more temperatures (procedure 'temperature'), or use 'bench calibrate'"
        )
    if not low <= reference_c <= high:
        raise CalibrationError(
            f"the reference temperature, {reference_c:g} °C, lies outside the readings "
            f"({inner_range(low, high)}); give one within them with --reference"
        )
    rows = found.rows
    # the forward model gives each series stand angles of its own, so a series stands for a mounting
    conditions = replace(rows, series=found.mounting).conditions()
    key = np.stack([found.visit, rows.point, rows.direction], axis=1)
    _, repeats = np.unique(key, axis=0, return_inverse=True)
    return _Body(
        found,
        make_problem(model, conditions, {**stand_u, **assumed_u}),
        repeats.ravel(),
        noise_floor(rows.signal, rows.resolution),
        reference_c,
        max(high - reference_c, reference_c - low),
        frozenset(assumed_u),
    )


def _highest(body: _Body, degree: int | None) -> tuple[int, bool]:
    """Return the highest degree that the readings determine, and whether they also determine a hysteresis."""
    plain = body.task(body.powers(0))
    require_rank(plain.force(body.problem.prior_mean))
    most = min(HIGHEST_DEGREE, body.sorted.levels - 1)
    asked = range(most, 0, -1) if degree is None else [degree]
    sides = body.sorted.branch / 2.0 * body.sorted.both_sides
    for d in asked:
        if d >= body.sorted.levels or not body.task(body.powers(d, of_levels=True)).determined():
            continue
        both = np.column_stack([body.powers(d, of_levels=True), sides])
        return d, bool(np.any(sides)) and body.task(both).determined()
    temperatures = ", ".join(
        f"{np.mean(body.sorted.rows.temperature_c[body.sorted.level == level]):.0f}"
        for level in range(body.sorted.levels)
    )
    what = "a dependence on temperature" if degree is None else f"polynomials of degree {degree}"
    raise CalibrationError(
        f"{body.sorted.rows.source}: {body.sorted.levels} temperatures ({temperatures} °C) with the installations "
        f"measured at them do not determine {what} of all twelve coefficients; measure both installations at "
        "more temperatures" + ("" if degree is None else ", or give a lower degree")
    )


def _in_kelvins(best: ThermalFit, choice: DegreeChoice, scale_k: float) -> tuple[Floats, Floats, Floats]:
    """Return values (12, D + 1) per K^d, their covariance, and its part due to angles of assumed size.

    The covariance covers the doubts about omitted terms.
    """
    count = choice.doubts.shape[2]
    coefficient, function = np.nonzero(best.terms)
    own = function < count
    at = coefficient[own] * count + function[own]
    covariance = np.zeros((FIXED * count, FIXED * count))
    of_assumed = np.zeros_like(covariance)
    covariance[np.ix_(at, at)] = best.covariance[np.ix_(own, own)]
    of_assumed[np.ix_(at, at)] = best.of_assumed[np.ix_(own, own)]
    for doubt in choice.doubts:
        for j, change in enumerate(doubt):
            block = slice(j * count, (j + 1) * count)
            covariance[block, block] += np.outer(change, change)
    unit = scale_k ** -np.arange(count, dtype=np.float64)
    every = np.outer(*2 * [np.tile(unit, FIXED)])
    return best.values[:, :count] * unit, covariance * every, of_assumed * every


def _hysteresis(best: ThermalFit) -> ThermalHysteresis:
    last = best.terms.shape[1] - 1
    _, function = np.nonzero(best.terms)
    size, covariance = best.values[:, last], best.covariance[np.ix_(function == last, function == last)]
    chi2 = float(size @ np.linalg.solve(covariance, size))
    dof = min(best.noise.dof, 1e9)
    each = special.fdtrc(1.0, dof, size**2 / np.diag(covariance))
    p = float(special.fdtrc(FIXED, dof, chi2 / FIXED))
    return ThermalHysteresis(size, covariance, p, np.minimum(FIXED * each, 1.0))


def _plateaus(
    body: _Body, best: ThermalFit, basis: Floats
) -> tuple[tuple[PlateauResult, ...], ThermalFit | None]:
    """Calibrate each plateau alone at its mean temperature, with stand angles common to all.

    Return the results and their joint fit. If a plateau does not determine its coefficients, the results have no
    values and the fit is None.
    """
    found = body.sorted.plateaus
    force = body.task(basis).force(best.others)
    able = [_determines(force[plateau.rows]) for plateau in found]
    if not all(able):
        return tuple(_plateau(p, None, None) for p in found), None
    each = np.column_stack([plateau.rows for plateau in found]).astype(np.float64)
    # correct the readings, along the polynomials, to the mean temperature of their plateau
    at_mean = each @ (each.T @ basis / each.sum(axis=0)[:, None])
    wandered = row_outputs((basis - at_mean) @ best.values.T, force)
    task = body.task(each)
    free = fit(replace(task, signal=task.signal - wandered), best.noise)
    u = u_of(free.covariance).reshape(FIXED, len(found))
    results = [_plateau(p, free.values[:, k], u[:, k]) for k, p in enumerate(found)]
    return tuple(results), free


def _plateau(plateau: Plateau, value: Floats | None, u: Floats | None) -> PlateauResult:
    return PlateauResult(plateau.temperature_c, plateau.branch, int(plateau.rows.sum()), value, u)


def _determines(force: Floats) -> bool:
    try:
        require_rank(force)
    except CalibrationError:
        return False
    return True


def _curve(best: ThermalFit, free: ThermalFit) -> LackOfFit:
    """Test the polynomials against coefficients free at each plateau (F test of the two fits)."""
    dof = free.terms.size - int(best.terms.sum())
    chi2 = max(best.misfit - free.misfit, 0.0)
    size = rms(best.residuals - free.residuals)
    if dof <= 0:
        return LackOfFit(size, float("nan"), 0, float("nan"))
    return LackOfFit(size, chi2, dof, float(special.fdtrc(dof, min(best.noise.dof, 1e9), chi2 / dof)))


def _notes(body: _Body, plateaus: tuple[PlateauResult, ...], by_side: bool) -> tuple[str, ...]:
    notes = list(body.sorted.rows.notes)
    if any(plateau.value is None for plateau in plateaus):
        notes.append(
            message(
                "some temperatures alone do not determine twelve coefficients; the polynomials use all "
                "together, so that no single temperature checks them"
            )
        )
    if not by_side:
        notes.append(
            message(
                "no temperature was reached both rising and falling, so the uncertainty excludes hysteresis"
            )
        )
    return tuple(notes)


GROWTHS: Final = 3
"""Number of fits with noise that grows with the signal: each changes how much of its variance a residual keeps."""


def _growth(task: ThermalProblem, found: ThermalFit) -> Floats:
    """Return the noise per signal, divided by the noise at zero signal, (3,)."""
    level = task.level(found.values)
    squared = (found.residuals / level) ** 2 / found.left
    turned = (found.noise.setting_rad * found.slope / level) ** 2
    power = task.without_bias(found.values) ** 2
    return np.array([growth_of(squared[:, c], power[:, c], turned[:, c], task.floor) for c in range(3)])
