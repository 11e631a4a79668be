"""Monitor runs: few positions over days, and the control chart of them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Final

import numpy as np
from scipy.special import fdtrc

from bench.base.arrays import CHANNELS, Floats, Ints
from bench.calibration.gls import noise_floor
from bench.calibration.intrinsic import intrinsic
from bench.calibration.noise import scatter_of_repeats
from bench.calibration.result import CalibrationError
from bench.history.control_chart import CheckRun, ControlChart, control_chart
from bench.model.geometry import COEFFICIENTS, Block
from bench.stats.control_charts import ChartDesign
from bench.stats.repeats_likelihood import sizes_of

LEAST_G: Final = 0.9
"""Least specific force, g, upwards and downwards, at which an axis counts as turned."""
BASELINE: Final = 5
LEAST_BASELINE: Final = 3


def monitor_run(name: str, when: datetime, signal: Floats, force: Floats) -> CheckRun:
    """Return a check run with the bias (g) and the scale factor of each axis that was read up and down.

    With two such axes, it also has the angle (deg) between them. `signal` (n, 3) was read at the nominal specific
    force `force` (n, 3), g. The u follows from the scatter. Raises `CalibrationError` unless there are one or
    two such axes, and enough readings for u.
    """
    up, down = force.max(axis=0, initial=0.0) > LEAST_G, force.min(axis=0, initial=0.0) < -LEAST_G
    turned = np.flatnonzero(up & down)
    columns = np.column_stack([np.ones(len(force)), force[:, turned]])
    if not len(turned) or len(turned) > 2 or len(force) <= columns.shape[1]:
        raise CalibrationError(
            f"{name}: a monitor needs one or two axes up and down, twice, in one installation; run monitor-2 or "
            "monitor-4"
        )
    own = signal[:, turned]
    solver = np.linalg.pinv(columns)
    found = solver @ signal
    left = signal - columns @ found
    dof = float(own.size - found[:, turned].size)
    s = float(np.sqrt(np.sum(left[:, turned] ** 2) / dof))
    between = s**2 * np.eye(own.size)
    if len(turned) > 1:
        between = _with_settings(between, signal, force, found, turned)
    solvers = np.kron(np.eye(len(turned)), solver)
    unseen = np.kron(np.eye(len(turned)), columns @ solver)
    residual = between - unseen @ between - between @ unseen + unseen @ between @ unseen
    if np.any(residual):
        # errors of settings leave scatter in fewer readings than noise does (Satterthwaite)
        dof = float(np.trace(residual) ** 2 / np.sum(residual**2))
    # As in the calibration of a block; an axis that was not turned is a unit vector without uncertainty.
    block, covariance = Block(np.eye(3), np.zeros(3)), np.zeros((len(COEFFICIENTS), len(COEFFICIENTS)))
    for channel in turned:
        block.U0[channel], block.K[channel, turned] = found[0, channel], found[1:, channel]
    places = [place for channel in turned for place in (9 + channel, *(3 * channel + turned))]
    covariance[np.ix_(places, places)] = solvers @ between @ solvers.T
    nine, letters = intrinsic(block, covariance), [CHANNELS[k] for k in turned]
    names = [name for letter in letters for name in (f"b{letter}", f"S{letter}")]
    names += [f"theta_{''.join(letters)}"] * (len(letters) == 2)
    kept = [nine.names.index(name) for name in names]
    spread = nine.covariance[np.ix_(kept, kept)]
    none = np.zeros_like(spread)
    return CheckRun(
        name, when, nine.values[kept], spread, np.sqrt(np.diag(spread)), s, dof, "monitor", (), none, none,
        tuple(names),
    )  # fmt: skip


SETTINGS_P: Final = 0.05
"""P-value below which the errors of the head's settings show in the repeats of a run, beside the noise."""


def _with_settings(alike: Floats, signal: Floats, force: Floats, found: Floats, turned: Ints) -> Floats:
    """Return the covariance (2 n, 2 n) of the signals of two turned axes, one axis after the other.

    `found` (3, 3) has the bias and both slopes of each channel. Noise scatters all readings alike, an error of
    the head's setting only those of a horizontal axis. If repeats do not show it, the covariance is `alike`.
    """
    shaft = np.ones(3)
    shaft[turned] = 0.0
    slope = np.cross(shaft, force)[:, turned] @ found[1:]
    left = signal - found[0] - force[:, turned] @ found[1:]
    _, repeats = np.unique(np.round(force, 3) + 0.0, axis=0, return_inverse=True)
    scatter = scatter_of_repeats(left, slope, repeats.ravel())
    if not scatter.settings:
        return alike
    along = scatter.slope / np.linalg.norm(scatter.slope, axis=1)[:, None]
    moved = float(np.einsum("gi,gij,gj->", along, scatter.matrix, along))
    still = float(np.einsum("gii->", scatter.matrix)) - moved
    # the scatter of three signals has one component along the slope, two across it
    if fdtrc(scatter.settings, 2 * scatter.settings, 2.0 * moved / max(still, 1e-300)) > SETTINGS_P:
        return alike
    by = np.zeros((4, 3))
    by[turned, 0] = by[np.flatnonzero(shaft), 1] = by[3, 2] = 1.0
    floor = noise_floor(signal, 0.0)
    sizes = sizes_of(scatter.matrix[None], scatter.freedom, scatter.slope[None], floor, by)[0]
    turns = np.hstack([np.diag(slope[:, channel]) for channel in turned])
    return np.asarray(sizes[turned[0]] * np.eye(len(alike)) + sizes[3] * turns.T @ turns)


def monitor_chart(runs: Sequence[CheckRun], baseline: int = BASELINE) -> ControlChart:
    """Return the control chart of monitor runs; the first `baseline` of them, by date, set its limits.

    Raises `CalibrationError` if the runs are too few or watch different axes.
    """
    ordered = sorted(runs, key=lambda run: run.when)
    other = next((run for run in ordered if run.names != ordered[0].names), None)
    if other is not None:
        raise CalibrationError(
            f"{ordered[0].name} and {other.name} turned different axes; chart runs of one monitor procedure"
        )
    if len(ordered[:baseline]) < LEAST_BASELINE:
        raise CalibrationError(
            f"{len(ordered[:baseline])} runs are too few to set the limits; name {LEAST_BASELINE} runs or more, "
            "and a baseline of as many"
        )
    return control_chart(ordered[:baseline], ordered[baseline:], ChartDesign())
