"""How far the true form of a hidden effect, with its size fitted, closes the gap on readings held out."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Mask
from benchmarks.blind_trial.cases import Answer, Case
from benchmarks.blind_trial.designs import make_run
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.signals import SETTING_SIGMA, explained, signals

FREE: Final = 1e-12
"""Weight of the prior of what is free, against unit noise."""


def true_closing(case: Case, answer: Answer) -> float | None:
    """Return the part of the gap that the true form closes, each pass held out; None without a gap to close.

    The fit has coefficients and stand errors as all analyses have, and knows noise and signature.
    """
    row = answer.row
    rows, whitener, top, priors = explained(
        row.design, row.noise_v * row.noise_factor, SETTING_SIGMA * row.noise_factor
    )
    run = make_run(row.design)

    def white(volts: Floats) -> Floats:
        return np.asarray(np.einsum("nij,nj->ni", whitener, volts[rows]).ravel())

    left, form = white(case.readings.signal - signals(run)), white(answer.effects[0].change)
    passes = np.repeat(run.pass_number[rows], 3)
    with_form = np.column_stack([top, form])
    prior = np.column_stack([priors, np.zeros(len(priors))])
    folds = [passes == number for number in np.unique(passes)]
    before = sum(_predicted(left, top, priors, held) for held in folds) / len(left)
    after = sum(_predicted(left, with_form, prior, held) for held in folds) / len(left)
    return (before - after) / (before - 1.0) if before > 1.0 else None


def _predicted(left: Floats, columns: Floats, priors: Floats, held: Mask) -> float:
    """Return the chi-square of rows held out, with the covariance of what was fitted to all others."""
    rest = np.vstack([columns[~held], priors])
    target = np.concatenate([left[~held], np.zeros(len(priors))])
    scale = np.linalg.norm(rest, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    normal = (rest / scale).T @ (rest / scale) + FREE * np.eye(len(scale))
    covariance = np.linalg.inv(normal) / np.outer(scale, scale)
    error = left[held] - columns[held] @ (covariance @ (rest.T @ target))
    spread = np.eye(len(error)) + columns[held] @ covariance @ columns[held].T
    return float(error @ np.linalg.solve(spread, error))
