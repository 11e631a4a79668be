"""The block as Kalibr writes and reads an IMU of its model scale-misalignment: YAML.

Source: ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu: what is measured is M (C (a - g)) + b in m/s^2
with M lower triangular (the mask of its design variable is [[1,0,0],[1,1,0],[1,1,1]]); its file keeps M as
`accelerometers: M`, and no bias, which Kalibr estimates as a spline for each data set.
"""

from __future__ import annotations

import math

import numpy as np
import yaml

from bench.base.arrays import Floats
from bench.exchange.nominal import lower_triangular, sensor_of
from bench.exchange.result import BlockResult


def kalibr_yaml(result: BlockResult, nominal: Floats | None = None) -> str:
    """Return the file: chain `imu0`, with the model, M, and beside it what Kalibr has no place for."""
    sensor = sensor_of(result, nominal)
    form = lower_triangular(sensor)
    lines = [
        *result.head(),
        *sensor.told(),
        "z = M C a + b in m/s^2, a the specific force on the block's axes: a = C^T M^-1 (z - b)",
        *kalibr_notes(result, nominal),
        "gyroscopes, noise densities, rostopic and update_rate are not known to this bench: add your own",
    ]
    accelerometers = {"M": form.M.tolist(), "bias": form.b.tolist(), "C_accel_block": form.R.tolist()}
    content = {"imu0": {"model": "scale-misalignment", "accelerometers": accelerometers}}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)
    return "".join(f"# {line}\n" for line in lines) + text


def kalibr_notes(result: BlockResult, nominal: Floats | None = None) -> list[str]:
    """Return what Kalibr's form loses."""
    form = lower_triangular(sensor_of(result, nominal))
    arcsec = math.degrees(form.turn_rad) * 3600
    return [
        "Kalibr reads M alone, six of the twelve: the bias is left to its own estimate, and a comes on other axes,",
        f"turned against the block's mounting axes by {arcsec:.4g} arcsec: a vector of 1 g is off by up to "
        f"{2e3 * float(np.sin(form.turn_rad / 2)):.3g} mg, |a| by nothing.",
        "bias (m/s^2) and C_accel_block (the turn) stand in the file; a reader that takes them loses nothing",
    ]
