"""What the readings cannot show is assumed; each sentence says what it costs if the assumption is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.calibration.design import FIXED, SYMBOLS, Problem, StandUnknown
from bench.calibration.result import ARCSEC, CalibrationError
from bench.model.block import COEFFICIENTS, Block
from bench.model.geometry import STAND_ANGLES

Floats = NDArray[np.float64]

MATTERS = 0.02
"""A coefficient is named when it takes more than this part of the largest effect of an assumption."""


def require_rank(force: Floats) -> None:
    """Refuse readings whose specific forces (n, 3) do not determine the twelve coefficients.

    Raises `CalibrationError` naming what is missing.
    """
    columns = np.column_stack([force, np.ones(len(force))])
    _, size, directions = np.linalg.svd(np.linalg.qr(columns, mode="r"))
    size = np.concatenate([size, np.zeros(4 - len(size))])
    if size[-1] > 1e-3 * max(size[0], 1e-300):
        return
    null = directions[size <= 1e-3 * max(size[0], 1e-300)]
    axes = [axis for axis, part in zip("xyz", np.abs(null).max(axis=0), strict=False) if part > 1e-3]
    lost = [f"K{i}{axis}" for i in "xyz" for axis in axes]
    raise CalibrationError(
        f"{len(force)} readings do not determine {', '.join(lost) or 'the biases'}: the acceleration along "
        f"{', '.join(axes) or 'every axis'} hardly changes in them; add the other installation "
        "(or further angles) to the procedure"
    )


def assumptions(problem: Problem, block: Block, gain: Floats, unit: str) -> tuple[str, ...]:
    """Return sentences on what the fit takes for granted, with the price of each.

    `gain` (12, n, 3) is the estimator's map from readings to coefficients.
    """
    sentences = [_absent(problem, block, gain, unit, name) for name in _assumed_angles(problem)]
    undetermined = _undetermined_by_data(problem, block)
    if undetermined:
        sentences.append(
            f"{', '.join(undetermined)}: in some combination a common turn of the block's axes, which no "
            "reading shows; only the limits of the bench file hold it"
        )
    sentences += [
        "voltmeter gain: 1 ppm of it is 1 ppm of every coefficient, and nothing shows it",
        f"voltmeter offset: it goes whole into the biases, {unit} for {unit}, and nothing shows it",
        "local gravity: coefficients are per local g; a wrong value of it changes none of them, but "
        "whatever is computed from them in m/s^2",
    ]
    return tuple(sentences)


def _assumed_angles(problem: Problem) -> list[str]:
    taken = {STAND_ANGLES[s.column] for s in problem.stand}
    return [name for name in ("mounting_roll",) if name not in taken]


def _absent(problem: Problem, block: Block, gain: Floats, unit: str, name: str) -> str:
    """Say what an arcsecond of a stand angle that is assumed zero puts into the coefficients."""
    column = STAND_ANGLES.index(name)
    mounts = problem.conditions.mounts
    parts = []
    for mount in range(len(mounts)):
        alone = replace(problem, stand=(StandUnknown(mount, column, ARCSEC),), effects=())
        step = np.array([ARCSEC])
        shift = alone.predict(block, step) - alone.predict(block, 0 * step)
        change = np.einsum("pni,ni->p", gain[:FIXED], shift)
        largest = float(np.max(np.abs(change)))
        told = [j for j in np.argsort(-np.abs(change)) if abs(change[j]) > max(MATTERS * largest, 1e-15)]
        if told:
            what = ", ".join(f"{_small(change[j], unit)}/g into {COEFFICIENTS[j]}" for j in told[:3])
            parts.append(f"1 arcsec in installation {mounts[mount]} puts {what}")
    return (
        f"{name} ({SYMBOLS[name]}, the third mounting angle) is assumed zero and nothing in these readings "
        f"shows it: " + ("; ".join(parts) if parts else "it does not act here")
    )


def _small(value: float, unit: str) -> str:
    """Return a small amount of a signal as text, volts in microvolts."""
    return f"{value * 1e6:+.3g} µV" if unit == "V" else f"{value:+.3g} {unit}"


def _undetermined_by_data(problem: Problem, block: Block) -> list[str]:
    """Names of the stand angles that only their limits hold: they take part in a null vector of the data.

    At the prior means: away from them terms of second order lend the null vectors a little size.
    """
    others = problem.prior_mean
    jacobian = problem.jacobian(block, others).reshape(-1, FIXED + len(others))
    scaled = jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, size, directions = np.linalg.svd(scaled, full_matrices=False)
    null = directions[size < 1e-4 * size[0]]
    if not len(null):
        return []
    part = np.abs(null[:, FIXED:]).max(axis=0)
    return [name for name, weight in zip(problem.names(), part, strict=True) if weight > 0.05]
