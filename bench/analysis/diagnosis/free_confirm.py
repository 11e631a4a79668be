"""A model found in other readings held against free positions: |a| = 1 g without it and with it.

|a| is linear in the values of an effect, so that both are one system: coefficients, and the effects' values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.calibration import CalibrationError
from bench.analysis.diagnosis.confirm import (
    STILL_SEEN,
    Confirmation,
    Estimated,
    Model,
    judged,
    square,
)
from bench.analysis.diagnosis.evidence import KNOWN_SIZE
from bench.analysis.diagnosis.free_positions import diagnose_free
from bench.analysis.diagnosis.free_records import OWN, FreeRows
from bench.base.arrays import Floats
from bench.base.arrays import rms as root_mean_square
from bench.model import ForwardModel
from bench.readings.table import Readings

LEAST_FREEDOM: Final = 1


def confirm_free(tables: Sequence[Readings], model: ForwardModel) -> Confirmation:
    """Hold free positions against a model with effects; what else is in them is looked for as in a diagnosis.

    Raises `CalibrationError` where they do not determine the coefficients, or could not show the effects.
    """
    diagnosis = diagnose_free(tables, None, model)
    rows, noise = diagnosis.rows, diagnosis.noise_g
    unknowns = rows.unknowns
    plausible = np.array([_plausible(model, u.effect, u.parameter) for u in unknowns])
    found = np.array([unknown.prior_mean for unknown in unknowns]) / plausible
    u = np.array([unknown.prior_u if unknown.stated else 0.0 for unknown in unknowns]) / plausible
    freedom = len(rows) - OWN * rows.sensors
    if freedom < LEAST_FREEDOM:
        raise CalibrationError(
            f"{len(rows)} free positions leave nothing to hold a model against; measure more"
        )
    before, _ = _left(rows, rows.response + rows.of_model @ found, noise, 0.0 * u)
    after, chi2 = _left(rows, rows.response, noise, u)
    change, covariance = _estimated(rows, noise, found, diagnosis.columns)
    return Confirmation(
        before=before,
        after=after,
        p_after=float(special.fdtrc(freedom, diagnosis.freedom, chi2 / freedom)),
        effects=judged(model, unknowns, Estimated(plausible, found, u, change, covariance)),
        diagnosis=diagnosis,
    )


def _plausible(model: ForwardModel, effect: int, parameter: str) -> float:
    return next(p.plausible for p in model.effects[effect].effect.parameters if p.name == parameter)


def _left(rows: FreeRows, response: Floats, noise: float, u: Floats) -> tuple[Model, float]:
    """Return what the coefficients, and effects with these u about their values, leave; and its chi-square."""
    design = np.column_stack([rows.coefficients, rows.of_model * u])
    prior = np.concatenate([np.zeros(rows.coefficients.shape[1]), np.full(len(u), noise**2)])
    covariance = _inverse(design.T @ design + np.diag(prior))
    mean = covariance @ (design.T @ response)
    error = response - design @ mean
    chi2 = float(error @ error / noise**2 + np.sum(mean[rows.coefficients.shape[1] :] ** 2))
    expected = noise * np.sqrt(np.maximum(1.0 - np.einsum("ni,ij,nj->n", design, covariance, design), 0.0))
    freedom = len(rows) - OWN * rows.sensors
    return Model(chi2 / freedom, root_mean_square(error), root_mean_square(expected)), chi2


def _estimated(
    rows: FreeRows, noise: float, found: Floats, beside: Sequence[Floats]
) -> tuple[Floats, Floats]:
    """Return by how much the effects differ from the values `found`, in plausible sizes, and the covariance.

    What else was found is estimated with them, unless it would hide them: it stands then for their change.
    """
    mine = slice(rows.coefficients.shape[1], rows.fixed.shape[1])

    def fitted(design: Floats) -> tuple[Floats, Floats]:
        prior = np.zeros(design.shape[1])
        prior[mine.start :] = (noise / KNOWN_SIZE) ** 2
        covariance = _inverse(design.T @ design + np.diag(prior))
        mean = covariance @ (design.T @ rows.response)
        return mean[mine], noise**2 * covariance[mine, mine]

    design = rows.fixed
    estimate = fitted(design)
    for columns in beside:
        more = np.column_stack([design, columns])
        again = fitted(more)
        if square(found, again[1]) >= STILL_SEEN * square(found, estimate[1]):
            design, estimate = more, again
    return estimate


def _inverse(normal: Floats) -> Floats:
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(size, size), hermitian=True) / np.outer(size, size))
