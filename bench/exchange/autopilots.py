"""Parameters as PX4 and ArduPilot take them: an offset and a scale per axis, in m/s^2 and single precision.

Sources: PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.hpp, Correct(): (data - offset) times scale,
axis by axis; QGroundControl's developer guide, "Parameters File Format". ArduPilot, libraries/AP_InertialSensor,
AP_InertialSensor_Backend::_rotate_and_correct_accel(): the offset is subtracted, then the scale multiplied; the
ranges of its parameters are those of AP_InertialSensor.cpp.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.exchange.nominal import Sensor, axis_rows, diagonal, sensor_of
from bench.exchange.result import BlockResult

REAL32: Final = 9
"""MAV_PARAM_TYPE_REAL32."""
ARDUPILOT_OFFSET, ARDUPILOT_SCALE = 3.5, (0.8, 1.2)
PX4_SCALE: Final = (0.1, 3.0)


def px4_params(result: BlockResult, nominal: Floats | None = None) -> str:
    """Return a .params file for the calibration in place 0 of PX4, as QGroundControl loads it."""
    sensor = sensor_of(result, nominal)
    lines = [
        "# Onboard parameters for Vehicle 1",
        "#",
        *_head(result, sensor, px4_notes(result, nominal)),
        "# a = (z - CAL_ACC0_iOFF) * CAL_ACC0_iSCALE; PX4 takes them for the sensor whose id is in CAL_ACC0_ID,",
        "# which this file leaves as it is; its axes are the sensor's, turned to the board's by SENS_BOARD_ROT",
        "#",
        "# Vehicle-Id Component-Id Name Value Type",
    ]
    lines += [f"1\t1\tCAL_ACC0_{name}\t{value:.9g}\t{REAL32}" for name, value in _px4_values(sensor)]
    return "\n".join(lines) + "\n"


def _px4_values(sensor: Sensor) -> list[tuple[str, float]]:
    form = diagonal(sensor)
    offsets = [(f"{axis}OFF", value) for axis, value in axis_rows(form.offset)]
    return sorted(offsets + [(f"{axis}SCALE", value) for axis, value in axis_rows(form.scale)])


def px4_notes(result: BlockResult, nominal: Floats | None = None) -> list[str]:
    """Return what the form loses, and what of it PX4 would not take."""
    form = diagonal(sensor_of(result, nominal))
    low, high = PX4_SCALE
    return form.told() + _outside("CAL_ACC0_{}SCALE", form.scale, low, high, "PX4")


def ardupilot_param(result: BlockResult, nominal: Floats | None = None) -> str:
    """Return a .param file for the first accelerometer of ArduPilot, as MAVProxy and Mission Planner load it."""
    sensor = sensor_of(result, nominal)
    form = diagonal(sensor)
    lines = [
        *_head(result, sensor, ardupilot_notes(result, nominal)),
        "# a = (z - INS_ACCOFFS_i) * INS_ACCSCAL_i; ArduPilot takes them for the sensor whose id is in INS_ACC_ID,",
        "# which this file leaves as it is; its axes are the sensor's, turned to the board's by AHRS_ORIENTATION",
    ]
    lines += [f"INS_ACCOFFS_{axis},{value:.9g}" for axis, value in axis_rows(form.offset)]
    lines += [f"INS_ACCSCAL_{axis},{value:.9g}" for axis, value in axis_rows(form.scale)]
    return "\n".join(lines) + "\n"


def ardupilot_notes(result: BlockResult, nominal: Floats | None = None) -> list[str]:
    """Return what the form loses, and what of it ArduPilot would not take."""
    form = diagonal(sensor_of(result, nominal))
    low, high = ARDUPILOT_SCALE
    outside = _outside("INS_ACCOFFS_{}", form.offset, -ARDUPILOT_OFFSET, ARDUPILOT_OFFSET, "ArduPilot")
    return form.told() + outside + _outside("INS_ACCSCAL_{}", form.scale, low, high, "ArduPilot")


def _outside(name: str, values: Floats, low: float, high: float, program: str) -> list[str]:
    """Say which values are beyond what a program allows for a parameter."""
    return [
        f"{name.format(axis)} = {value:.4g} is outside {low:g} to {high:g}, which {program} allows: "
        "take out more before it, by the electronics or by other scale factors (--nominal)"
        for axis, value in axis_rows(values)
        if not low <= value <= high
    ]


def _head(result: BlockResult, sensor: Sensor, notes: list[str]) -> list[str]:
    u = np.sqrt(np.diag(result.covariance))
    to_ms2 = [abs(9.80665 / s) for s in sensor.nominal]
    offsets = ", ".join(f"{result.k * own * size:.2g}" for own, size in zip(u[9:], to_ms2, strict=True))
    parts = result.k * np.hypot(u[[0, 4, 8]] / np.abs(np.diag(result.block.K)), result.gravity_u)
    scales = ", ".join(f"{part:.2g}" for part in parts)
    lines = [
        *result.head(),
        *sensor.told(),
        *notes,
        f"U of the offsets: {offsets} m/s^2; of the scales: {scales}, relative",
    ]
    return [f"# {line}" for line in lines]
