"""A stability monitor: runs in two or four positions of one installation, charted over days."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.calibration.intrinsic import intrinsic
from bench.calibration.result import CalibrationError
from bench.history.control_chart import CheckRun, ControlChart, control_chart
from bench.model.geometry import COEFFICIENTS, Block
from bench.stats.control_charts import ChartDesign

LEAST_G: Final = 0.9
"""Least specific force, g, upwards and downwards, at which an axis counts as turned."""
BASELINE: Final = 5
LEAST_BASELINE: Final = 3


def monitor_run(name: str, when: datetime, signal: Floats, force: Floats) -> CheckRun:
    """Return a check run with the bias (g) and the scale factor of each axis that was read up and down.

    With two such axes, it also has the angle (deg) between them. `signal` (n, 3) was read at the nominal specific
    force `force` (n, 3), g. The u follows from the residuals. Raises `CalibrationError` unless there are one or
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
    found, *_ = np.linalg.lstsq(columns, own, rcond=None)
    dof = own.size - found.size
    s = float(np.sqrt(np.sum((own - columns @ found) ** 2) / dof))
    of_each = s**2 * np.linalg.inv(columns.T @ columns)
    # As in the calibration of a block; an axis that was not turned is a unit vector without uncertainty.
    block, covariance = Block(np.eye(3), np.zeros(3)), np.zeros((len(COEFFICIENTS), len(COEFFICIENTS)))
    for column, channel in enumerate(turned):
        block.U0[channel], block.K[channel, turned] = found[0, column], found[1:, column]
        places = [9 + channel, *(3 * channel + turned)]
        covariance[np.ix_(places, places)] = of_each
    nine, letters = intrinsic(block, covariance), [CHANNELS[k] for k in turned]
    names = [name for letter in letters for name in (f"b{letter}", f"S{letter}")]
    names += [f"theta_{''.join(letters)}"] * (len(letters) == 2)
    kept = [nine.names.index(name) for name in names]
    spread = nine.covariance[np.ix_(kept, kept)]
    none = np.zeros_like(spread)
    return CheckRun(
        name, when, nine.values[kept], spread, np.sqrt(np.diag(spread)), s, float(dof), "monitor", (), none, none,
        tuple(names),
    )  # fmt: skip


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
