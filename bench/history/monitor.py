"""A stability monitor: two or four positions of one installation, charted over days."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints
from bench.calibration.result import CalibrationError
from bench.history.control_chart import CheckRun, ControlChart, control_chart
from bench.stats.control_charts import ChartDesign

LEAST_G: Final = 0.9
"""An axis counts as turned if it was read at more than this, up and down."""
BASELINE: Final = 5


def monitor_run(name: str, when: datetime, signal: Floats, force: Floats) -> CheckRun:
    """Return bias (g) and scale factor of each axis that was turned, and of two also their angle (deg).

    `signal` (n, 3) at the nominal `force` (n, 3), g. u is that of the scatter of repeats. Raises `CalibrationError`
    if no axis was read up and down, or no position twice.
    """
    turned: Ints = np.flatnonzero((force.max(axis=0) > LEAST_G) & (force.min(axis=0) < -LEAST_G)).astype(
        np.int64
    )
    columns = np.column_stack([np.ones(len(force)), force[:, turned]])
    if not len(turned) or len(turned) > 2 or len(force) <= columns.shape[1]:
        raise CalibrationError(
            f"{name}: a monitor needs one or two axes up and down, twice, in one installation; run monitor-2 or "
            "monitor-4"
        )
    own = signal[:, turned]
    found, *_ = np.linalg.lstsq(columns, own, rcond=None)
    dof = own.size - found.size
    s = float(np.sqrt(np.sum((own - columns @ found) ** 2) / dof))
    of_each = s**2 * np.linalg.inv(columns.T @ columns)
    # unknowns in the order channel by channel: bias, then the row of K in the plane of rotation
    point: Floats = np.array(found.T.ravel(), dtype=np.float64)
    covariance = np.kron(np.eye(len(turned)), of_each)
    step = float(1e-6 * np.max(np.abs(point)))
    shifts: Floats = step * np.eye(len(point))
    J = np.stack([(_numbers(point + d) - _numbers(point - d)) / (2 * step) for d in shifts], axis=1)
    spread: Floats = J @ covariance @ J.T
    none = np.zeros_like(spread)
    return CheckRun(
        name, when, _numbers(point), spread, np.sqrt(np.diag(spread)), s, float(dof), "monitor", (), none, none,
        _names(turned),
    )  # fmt: skip


def _numbers(point: Floats) -> Floats:
    """Return bias and scale factor of each channel, and the angle of two, from their linear fits."""
    channels = 1 if len(point) == 2 else 2
    rows = point.reshape(channels, -1)
    scale = np.linalg.norm(rows[:, 1:], axis=1)
    each = np.stack([rows[:, 0] / scale, scale], axis=1).ravel()
    if channels == 1:
        return each
    cosine = rows[0, 1:] @ rows[1, 1:] / np.prod(scale)
    return np.array([*each, np.degrees(np.arccos(cosine))])


def _names(turned: Ints) -> tuple[str, ...]:
    letters = [CHANNELS[k] for k in turned]
    each = [name for letter in letters for name in (f"b{letter}", f"S{letter}")]
    return (*each, f"theta_{''.join(letters)}") if len(letters) > 1 else tuple(each)


def monitor_chart(runs: Sequence[CheckRun], baseline: int = BASELINE) -> ControlChart:
    """Return the control chart of monitors, the first `baseline` of which set its limits (u scaled to them).

    Raises `CalibrationError` if the runs are too few or watch different axes.
    """
    ordered = sorted(runs, key=lambda run: run.when)
    if len({run.names for run in ordered}) > 1:
        raise CalibrationError("the runs turned different axes; chart runs of one monitor procedure")
    return control_chart(ordered[:baseline], ordered[baseline:], ChartDesign())
