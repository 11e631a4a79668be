"""The paper's closed-form estimator, equations (7)-(8), in its consistent form."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.calibration.gls import Estimator
from bench.calibration.mistakes import NOMINAL_RAD, POINTS
from bench.calibration.result import CalibrationError
from bench.model.geometry import within_half_turn
from bench.readings.table import Readings

FARTHEST_FROM_NOMINAL_RAD = np.radians(3 / 60)


def closed_form(signals: Floats) -> Floats:
    """Return the 12 coefficients for signals (2 installations, 3 channels, 9 test points); K per local g.

    Source: paper (7)-(8); the bias U20z is one eighth of the sum over test points 1 to 8.
    """
    U1, U2 = signals[0], signals[1]
    root2 = np.sqrt(2.0)

    def sine(u: Floats) -> Floats:
        """Return the scale factor along the platform's x from the points where the sine is not zero."""
        return np.asarray((u[2] - u[6] + u[1] + u[3] - u[5] - u[7]) / (2 * (1 + root2)))

    def cosine(u: Floats) -> Floats:
        """Return the scale factor along the axis that is up at test point 1."""
        return np.asarray((u[0] + u[8] - 2 * u[4] + root2 * (u[1] + u[7] - u[3] - u[5])) / 8)

    def across(u: Floats) -> Floats:
        """Return the cross-axis term of the axis that is up at test point 1."""
        return np.asarray((u[0] + u[8] - 2 * u[4]) / 4)

    def level(u: Floats) -> Floats:
        """Return the bias from the points where the axis is up and down."""
        return np.asarray((u[0] + u[8] + 2 * u[4]) / 4)

    x, y, z = 0, 1, 2
    Kxx = (sine(U1[x]) - sine(U2[x])) / 2
    Kyx = ((U1[y][2] - U1[y][6]) / 2 + (U2[y][6] - U2[y][2]) / 2) / 2
    Kzx = ((U1[z][2] - U1[z][6]) / 2 + (U2[z][6] - U2[z][2]) / 2) / 2
    U0x = (level(U1[x]) + level(U2[x])) / 2
    U0y = (np.sum(U1[y][:8]) / 8 + (U2[y][2] + U2[y][6]) / 2) / 2
    U0z = ((U1[z][2] + U1[z][6]) / 2 + np.sum(U2[z][:8]) / 8) / 2
    return np.array(
        [
            Kxx, across(U2[x]), across(U1[x]),
            Kyx, cosine(U2[y]), across(U1[y]),
            Kzx, across(U2[z]), cosine(U1[z]),
            U0x, U0y, U0z,
        ]
    )  # fmt: skip


def closed_form_gain(readings: Readings) -> Floats:
    """Return the linear map (12, n, 3) from n readings to the coefficients, by the paper's closed form.

    Element (i, j, k) is the derivative of coefficient i by the signal of reading j in channel k. The signals
    at each test point are averaged over the passes and then entered in equation (8) of the paper
    (`closed_form`).

    Raises `CalibrationError` if a test point of installations 1 and 2 is missing, a reading belongs to no
    such test point, or an angle differs from the nominal angle that these formulas assume.
    """
    cell, count = _cells(readings)
    unit = np.eye(2 * 3 * POINTS).reshape(2 * 3 * POINTS, 2, 3, POINTS)
    by_signal = np.stack([closed_form(e) for e in unit], axis=1).reshape(12, 2, 3, POINTS)
    by_cell = np.moveaxis(by_signal, 2, 3).reshape(12, 2 * POINTS, 3)
    return by_cell[:, cell, :] / count[cell][None, :, None]


def nominal_angles_rad(readings: Readings) -> Floats:
    """Return the nominal angles (n,) that the closed form assumes. Raises the errors of `closed_form_gain`."""
    _cells(readings)
    return np.asarray(NOMINAL_RAD[readings.point - 1])


def _cells(readings: Readings) -> tuple[Ints, Ints]:
    """Return the test point of each reading (n,), and the number of readings at each test point (18,)."""
    cell = np.full(len(readings), -1)
    for m, label in enumerate(("1", "2")):
        own = readings.installation == label
        cell[own] = m * POINTS + readings.point[own] - 1
    stray = (cell < 0) | (readings.point < 1) | (readings.point > POINTS)
    if np.any(stray):
        first = int(np.argmax(stray))
        raise CalibrationError(
            f"the closed form (8) covers installations 1 and 2 with points 1 to 9 only, not "
            f"installation {readings.installation[first]}, point {readings.point[first]}; "
            "use the default estimator"
        )
    count = np.bincount(cell, minlength=2 * POINTS)
    if np.any(count == 0):
        missing = [f"{c // POINTS + 1}/{c % POINTS + 1}" for c in np.flatnonzero(count == 0)]
        raise CalibrationError(
            f"the closed form (8) needs every test point; missing (installation/point): "
            f"{', '.join(missing)}; measure them, or use the default estimator"
        )
    off = readings.angle_rad - NOMINAL_RAD[readings.point - 1]
    off = np.abs(within_half_turn(off))  # 360° may be written as 0°
    if np.any(off > FARTHEST_FROM_NOMINAL_RAD):
        worst = int(np.argmax(off))
        raise CalibrationError(
            f"the closed form (8) needs point {readings.point[worst]} of installation "
            f"{readings.installation[worst]} at "
            f"{np.degrees(NOMINAL_RAD[readings.point[worst] - 1]):g}°, but the head stood at "
            f"{np.degrees(readings.angle_rad[worst]):.4f}°; use the default estimator"
        )
    return cell, count


ESTIMATOR: Final = Estimator(
    "closed-form",
    "the paper's (7)-(8)",
    gain=lambda _, rows: closed_form_gain(rows),
    angles_rad=nominal_angles_rad,
)
