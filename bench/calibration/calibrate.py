"""From a table of readings to a calibration, by the estimator asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.calibration import gls
from bench.calibration.assumptions import assumptions, require_rank
from bench.calibration.closed_form import NOMINAL_RAD, closed_form_gain
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.result import ARCSEC, Calibration, CalibrationError, Estimate, Noise
from bench.model.block import Block
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES
from bench.readings import Readings

Floats = NDArray[np.float64]

ESTIMATORS: Final = ("gls", "closed-form")


def calibrate(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    estimator: str = "gls",
    noise: Noise | None = None,
) -> Calibration:
    """Estimate the twelve coefficients from the oriented rows of a table.

    `stand_u` holds the standard uncertainties of the stand's fixed angles by the names in `STAND_ANGLES`,
    rad; the sizes of the noise are estimated from the readings unless given as `noise`. Coefficients are per
    local g, stated as `g_m_s2`. Raises `CalibrationError` when the readings do not determine them.
    """
    if estimator not in ESTIMATORS:
        raise CalibrationError(f"no estimator {estimator!r}; there are {', '.join(ESTIMATORS)}")
    rows = _usable_rows(readings, model)
    nominal = estimator == "closed-form"
    conditions = rows.conditions()
    if nominal:
        gain = closed_form_gain(rows)
        conditions = replace(conditions, angle_rad=NOMINAL_RAD[rows.point - 1])
    problem = make_problem(model, conditions, stand_u)
    start = first_guess(problem, rows.signal)
    fit = gls.fit(problem, rows.signal, start, noise, rows.resolution)
    fit_test = gls.lack_of_fit(problem, fit)
    if nominal:
        fit = _closed_form(problem, rows, fit, gain)
    return Calibration(
        estimator=estimator,
        unit=readings.unit,
        g_m_s2=g_m_s2,
        block=fit.block,
        covariance=fit.covariance[:FIXED, :FIXED],
        noise=fit.noise,
        lack_of_fit=replace(fit_test, rms=float(np.sqrt(np.mean(fit.residuals**2)))),
        fitted=rows,
        residuals=fit.residuals,
        skipped=len(readings.skipped),
        model=model.name,
        stand={} if nominal else _stand(problem, fit),
        effects={} if nominal else _effects(problem, fit),
        assumed=assumptions(problem, fit.block, fit.gain, readings.unit),
    )


def _usable_rows(readings: Readings, model: ForwardModel) -> Readings:
    """Return the rows to fit; raises `CalibrationError` where none can be, or one is not a number."""
    rows = readings.oriented()
    if len(rows) == 0:
        raise CalibrationError(
            f"{readings.source}: no reading in an installation of known orientation; "
            "a calibration needs installations 1 and 2"
        )
    strange = sorted(set(rows.installation.tolist()) - set(model.installations))
    if strange:
        raise CalibrationError(
            f"{readings.source}: installation {', '.join(strange)} is not known (known are "
            f"{', '.join(model.installations)}); define it in the bench file"
        )
    bad = ~np.isfinite(rows.signal).all(axis=1) | ~np.isfinite(rows.angle_rad)
    if np.any(bad):
        i = int(np.argmax(bad))
        raise CalibrationError(
            f"{readings.source}: installation {rows.installation[i]}, pass {rows.pass_number[i]}, point "
            f"{rows.point[i]} has a signal or an angle that is not a number; leave this reading out"
        )
    return rows


def first_guess(problem: Problem, signal: Floats) -> Block:
    """Ordinary least squares at the nominal geometry. Raises `CalibrationError` for too few orientations."""
    zero = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    unit = Block(np.eye(3), np.zeros(3))
    force = problem.model.specific_force(problem.conditions, zero, unit)
    require_rank(force)
    still = [axis for axis, spread in zip("xyz", np.ptp(signal, axis=0), strict=True) if spread == 0]
    if still:
        raise CalibrationError(
            f"the signal of channel {', '.join(still)} is the same in every reading; "
            "check its cable and the supply of the block"
        )
    columns = np.column_stack([force, np.ones(len(force))])
    solution, *_ = np.linalg.lstsq(columns, signal, rcond=None)
    return Block.from_vector(np.concatenate([solution[:3].T.ravel(), solution[3]]))


def _closed_form(problem: Problem, rows: Readings, fit: gls.Fit, gain: Floats) -> gls.Fit:
    """Replace the estimate by the paper's, with the covariance that the same errors give to it.

    The misfit stays that of the least squares: (8) leaves the stand's angles in its residuals, where they
    would pass for a lack of fit of the model.
    """
    block = Block.from_vector(np.einsum("pni,ni->p", gain, rows.signal))
    others = problem.prior_mean
    noise, slope = fit.noise.widened(), fit.slope
    # G R G^T from R = sigma_u^2 I + sigma_phi^2 d d^T of each reading, then the stand's angles
    along = np.einsum("pni,ni->pn", gain, slope) * noise.setting_rad
    flat = gain.reshape(FIXED, -1) * noise.reading
    columns = problem.jacobian(block, others)[:, :, FIXED:] * problem.prior_u
    fixed = np.einsum("pni,niq->pq", gain, columns)
    covariance = flat @ flat.T + along @ along.T + fixed @ fixed.T
    residuals = rows.signal - problem.predict(block, others)
    return gls.Fit(block, others, covariance, gain, fit.noise, fit.misfit, residuals, slope)


def _stand(problem: Problem, fit: gls.Fit) -> dict[str, Estimate]:
    u = np.sqrt(np.diag(fit.covariance))[FIXED:]
    names = problem.names()
    return {
        names[j]: Estimate(
            float(fit.others[j]) / ARCSEC, float(u[j]) / ARCSEC, "arcsec", unknown.prior_u / ARCSEC
        )
        for j, unknown in enumerate(problem.stand)
    }


def _effects(problem: Problem, fit: gls.Fit) -> dict[str, Estimate]:
    u = np.sqrt(np.diag(fit.covariance))[FIXED:]
    estimates = {}
    for j, name in enumerate(problem.names()):
        if j >= len(problem.stand):
            unknown = problem.effects[j - len(problem.stand)]
            effect = problem.model.effects[unknown.effect].effect
            parameter = next(p for p in effect.parameters if p.name == unknown.parameter)
            estimates[name] = Estimate(
                float(fit.others[j]) / parameter.si_per_unit,
                float(u[j]) / parameter.si_per_unit,
                parameter.unit,
            )
    return estimates
