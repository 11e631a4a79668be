"""From readings over several temperatures to polynomials, the degree of each chosen by the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask, rms, u_of
from bench.calibration.assumptions import require_rank
from bench.calibration.calibrate import usable_rows
from bench.calibration.components import note_on_prior
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.gls import noise_floor
from bench.calibration.noise import require_told
from bench.calibration.result import CalibrationError, LackOfFit
from bench.calibration.temperature.fit import (
    DegreeChoice,
    ThermalFit,
    ThermalProblem,
    choose_degrees,
    fit,
    judge,
    row_outputs,
)
from bench.calibration.temperature.model import PlateauResult, TemperatureModel, ThermalHysteresis
from bench.calibration.temperature.plateaus import Plateau, ThermalReadings, sort_readings
from bench.model.forward import ForwardModel
from bench.readings.table import Readings

HIGHEST_DEGREE: Final = 4
"""Of an automatic choice: what accelerometers show over their range is hardly ever of higher degree."""


@dataclass(frozen=True)
class _Body:
    """All readings with what every fit to them needs; `scale_k` is the unit of temperature inside the fits."""

    sorted: ThermalReadings
    problem: Problem
    repeats: Ints
    floor: float
    reference_c: float
    scale_k: float

    def powers(self, degree: int, *, of_levels: bool = False) -> Floats:
        """Return powers 0…degree (n, degree + 1) of the scaled temperature, or of its mean at that level.

        What wanders within a level is too little to stand for a second temperature.
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
            self.problem, signal, basis, every if terms is None else terms, self.repeats, self.floor
        )


def temperature_model(
    tables: Sequence[Readings],
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    reference_c: float = 23.0,
    degree: int | None = None,
) -> TemperatureModel:
    """Fit the twelve coefficients as polynomials in temperature to the readings of all tables.

    `stand_u` as for `calibrate`. Without `degree` each coefficient has its own: starting at the highest that
    the temperatures allow, the highest term is dropped as long as an F test finds it no larger than chance
    (p > 0.05), and the doubt about what was dropped stays in the covariance. Raises `CalibrationError` when
    a temperature is missing, there are fewer than two, they do not determine the polynomials, or the
    reference lies outside them.
    """
    body = _body(tables, model, stand_u, reference_c)
    highest, by_side = _highest(body, degree)
    sides = body.sorted.branch / 2.0 * body.sorted.both_sides
    basis = np.column_stack([body.powers(highest), sides] if by_side else [body.powers(highest)])
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
    values, covariance = _in_kelvins(best, choice, body.scale_k)
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
        hysteresis=_hysteresis(best) if by_side else None,
        plateaus=plateaus,
        noise=full.noise,
        fitted=judge(task, best),
        curve=None if free is None else _curve(best, free),
        readings=len(body.sorted.rows),
        skipped=len(body.sorted.rows.skipped),
        notes=(*_notes(body, plateaus, by_side), *note_on_prior(full.noise, body.sorted.rows.unit)),
    )


def _body(
    tables: Sequence[Readings], model: ForwardModel, stand_u: Mapping[str, float], reference_c: float
) -> _Body:
    for table in tables:
        usable_rows(table, model)
    if model.effects:
        raise CalibrationError(
            f"model {model.name}: a temperature model has the paper's twelve coefficients and no effects; "
            "leave the model file away"
        )
    found = sort_readings(tables)
    low, high = float(found.rows.temperature_c.min()), float(found.rows.temperature_c.max())
    if found.levels < 2:
        raise CalibrationError(
            f"{found.rows.source}: all readings lie between {low:.1f} and {high:.1f} °C, which is one temperature; "
            "measure at three or more (procedure 'temperature'), or use 'bench calibrate'"
        )
    if not low <= reference_c <= high:
        raise CalibrationError(
            f"the reference temperature, {reference_c:g} °C, lies outside the readings ({low:.1f} to "
            f"{high:.1f} °C); state one within them with --reference"
        )
    rows = found.rows
    # a mounting is a series to the forward model: the stand's angles are its own
    conditions = replace(rows, series=found.mounting).conditions()
    key = np.stack([found.visit, rows.point, rows.direction], axis=1)
    _, repeats = np.unique(key, axis=0, return_inverse=True)
    return _Body(
        found,
        make_problem(model, conditions, stand_u),
        repeats.ravel(),
        noise_floor(rows.signal, rows.resolution),
        reference_c,
        max(high - reference_c, reference_c - low),
    )


def _highest(body: _Body, degree: int | None) -> tuple[int, bool]:
    """Return the highest degree that the readings determine, and whether they determine a hysteresis, too."""
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
        "more temperatures" + ("" if degree is None else ", or state a lower degree")
    )


def _in_kelvins(best: ThermalFit, choice: DegreeChoice, scale_k: float) -> tuple[Floats, Floats]:
    """Return values (12, D + 1) and their covariance per K^d, the doubts about what was left out in it."""
    count = choice.doubts.shape[2]
    coefficient, function = np.nonzero(best.terms)
    own = function < count
    at = coefficient[own] * count + function[own]
    covariance = np.zeros((FIXED * count, FIXED * count))
    covariance[np.ix_(at, at)] = best.covariance[np.ix_(own, own)]
    for doubt in choice.doubts:
        for j, change in enumerate(doubt):
            block = slice(j * count, (j + 1) * count)
            covariance[block, block] += np.outer(change, change)
    unit = scale_k ** -np.arange(count, dtype=np.float64)
    every = np.tile(unit, FIXED)
    return best.values[:, :count] * unit, covariance * np.outer(every, every)


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
    """Calibrate each plateau by itself, at its mean temperature, the stand's angles common to all.

    Returns the results, and the fit to compare the polynomials with where every plateau determines its own.
    """
    found = body.sorted.plateaus
    force = body.task(basis).force(best.others)
    able = [_determines(force[plateau.rows]) for plateau in found]
    if not all(able):
        return tuple(_plateau(p, None, None) for p in found), None
    each = np.column_stack([plateau.rows for plateau in found]).astype(np.float64)
    # within a plateau the temperature wanders a little: brought to its mean along the polynomials
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
    """Compare the polynomials with coefficients free at each plateau (F test of the two fits)."""
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
            "some temperatures alone do not determine twelve coefficients; all of them together do, and the "
            "polynomials stand on that: no single temperature checks them"
        )
    if not by_side:
        notes.append(
            "no temperature was reached both rising and falling: hysteresis is not known and not in the "
            "uncertainty"
        )
    return tuple(notes)
