"""Which settings tell apart what may be missing in the model, where the readings do not fit it.

Every effect given may be there, of about its plausible size. What a setting tells of all of them together, with
coefficients and stand free, is the logarithm by which the volume that they may lie in shrinks (D-optimal design
for some of the unknowns: Atkinson, Donev, Tobias, Optimum Experimental Designs (2007), 10.3). A repeat of what was
read tells little of it, for it sees the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from bench.analysis.calibration.design import FIXED
from bench.analysis.calibration.design import make_problem as problem_of
from bench.analysis.calibration.noise import whiten
from bench.analysis.planning.settings import Setting, conditions_of
from bench.analysis.planning.stand import Stand
from bench.base.arrays import Floats
from bench.model import AppliedEffect, Effect

MOST: Final = 4
"""So many settings are chosen for this at a look."""
WORTH: Final = 0.5
"""A setting that tells less than this part of what the first one does is left."""


def telling_apart(
    stand: Stand, done: Sequence[Setting], candidates: Sequence[Setting], effects: Sequence[Effect]
) -> list[int]:
    """Return the numbers of the candidates that tell most of the effects after readings at `done`, best first."""
    model = replace(stand.model, effects=tuple(AppliedEffect(effect, {}) for effect in effects))
    problem = problem_of(model, conditions_of([*done, *candidates]), stand.sizes)
    linear = problem.linear(stand.block, problem.prior_mean)
    plausible = [problem.parameter(unknown).plausible for unknown in problem.effects]
    stated = [unknown.prior_u for unknown in problem.stand]
    rows = whiten(linear.jacobian, linear.slope, stand.noise) * np.array(
        [*[1.0] * FIXED, *stated, *plausible]
    )
    known = FIXED + len(stated)
    shown = np.isfinite(rows).all(axis=(0, 1))  # what hangs on a temperature that nobody knows is not
    rows = rows[:, :, shown | (np.arange(rows.shape[2]) < known)]
    every = np.eye(rows.shape[2]) + np.einsum("nip,niq->pq", rows[: len(done)], rows[: len(done)])
    chosen: list[int] = []
    first = 0.0
    while len(chosen) < min(MOST, len(candidates)):
        told = _told(every, rows[len(done) :], known)
        told[chosen] = -np.inf
        best = int(np.argmax(told))
        first = first or float(told[best])
        if told[best] <= WORTH * first and chosen:
            break
        chosen.append(best)
        every += rows[len(done) + best].T @ rows[len(done) + best]
    return chosen


def _told(information: Floats, rows: Floats, known: int) -> Floats:
    """What each of rows (c, 3, p) tells of the unknowns from `known` on, those before being free, (c,)."""
    of_all = rows @ np.linalg.solve(information, np.swapaxes(rows, 1, 2))
    own = rows[:, :, :known]
    of_known = own @ np.linalg.solve(information[:known, :known], np.swapaxes(own, 1, 2))
    one = np.eye(3)
    return np.asarray(np.linalg.slogdet(one + of_all)[1] - np.linalg.slogdet(one + of_known)[1])
