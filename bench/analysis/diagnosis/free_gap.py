"""The gap of free positions: every fifth is held out in turn, named and fitted without, and predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import KNOWN_SIZE, Whitened
from bench.analysis.diagnosis.free_noise import LEAST_FREEDOM, grid_of
from bench.analysis.diagnosis.free_records import FreeRows
from bench.analysis.diagnosis.gap import Fold, Gap, HeldOut
from bench.analysis.diagnosis.naming import name
from bench.analysis.diagnosis.posterior import NoiseSize
from bench.analysis.diagnosis.threshold import Threshold
from bench.base.arrays import Floats, Mask

FOLDS: Final = 5


def free_gap(
    rows: FreeRows,
    candidates: Candidates,
    sigma: float,
    limit: Threshold,
    noise: NoiseSize,
    named: Sequence[str],
) -> Gap:
    """Return the gap on readings held out; `sigma` is the scale of the search, `named` what all of them gave."""
    fold_of = np.arange(len(rows)) % FOLDS
    folds, undetermined = [], []
    for number in range(FOLDS):
        train = fold_of != number
        label = f"positions {number + 1}, {number + FOLDS + 1}, …"
        if grid_of(rows, sigma, train).freedom < LEAST_FREEDOM:
            undetermined.append(label)
        else:
            folds.append(_fold(rows, candidates, sigma, limit, noise, train, label))
    return Gap(tuple(folds), noise, "g", noise.freedom, tuple(named), tuple(undetermined))


def _fold(
    rows: FreeRows,
    candidates: Candidates,
    sigma: float,
    limit: Threshold,
    noise: NoiseSize,
    train: Mask,
    label: str,
) -> Fold:
    part = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
    kept = Whitened.of(grid_of(rows, sigma, train), part)
    found = name(kept, kept.reduce(rows.response[train][:, None]), limit).found

    def held_out(but: str | None) -> HeldOut:
        chosen = [i for one in found if one.variant.family != but for i in one.variant.columns]
        return _predicted(rows, candidates.columns[:, chosen], train, noise.reading)

    after = held_out(None)
    gains = {one.variant.family: held_out(one.variant.family).chi2 - after.chi2 for one in found}
    before = _predicted(rows, candidates.columns[:, :0], train, noise.reading)
    return Fold(label, gains, before, after, "")


def _predicted(rows: FreeRows, effects: Floats, train: Mask, noise: float) -> HeldOut:
    design = np.column_stack([rows.fixed, effects])
    prior = np.concatenate([np.zeros(rows.fixed.shape[1]), np.full(effects.shape[1], 1 / KNOWN_SIZE**2)])
    normal = design[train].T @ design[train] / noise**2 + np.diag(prior)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    mean = covariance @ (design[train].T @ rows.response[train]) / noise**2
    held = design[~train]
    error = rows.response[~train] - held @ mean
    spread = noise**2 * np.eye(len(error)) + held @ covariance @ held.T
    chi2 = float(error @ np.linalg.solve(spread, error))
    return HeldOut(error, error, np.sqrt(np.diag(spread)), chi2)
