"""Exact geometry of the stand, as turns of the frame around a fixed vertical.

The specific force of a block at rest is 1 g upwards. Its components are followed through the frames: level
ground, shaft, head, platform, bracket, block. Agrees with the paper's (3)-(4) to second order in the angles.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ARCSEC: Final = np.pi / 648000
_HALF = np.sqrt(0.5)

AXES: Final[dict[str, Floats]] = {
    "1": np.eye(3),
    "2": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "1T90": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "2T90": np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
    "1T180": np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "2T180": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "V": np.array([[_HALF, _HALF, 0], [-_HALF, _HALF, 0], [0, 0, 1]]),
}
"""Rows: the block's axes x, y, z written in platform axes. V is turned by 45° about z of the platform."""


def specific_force(
    labels: NDArray[np.str_],
    angle: Floats,
    axis_tilt: Floats | float = 0.0,
    mounting_error: Floats | float = 0.0,
    mounting_roll: Floats | float = 0.0,
) -> Floats:
    """Specific force on the block's axes in g, shape (n, 3).

    `labels` (n,) are keys of `AXES`, `angle` (n,) the true head angle (zero offset and setting error
    included), `axis_tilt` α1, `mounting_error` α3, `mounting_roll` α5, all in rad, (n,) or one for all.
    """
    up_y, up_z = np.sin(axis_tilt), np.cos(axis_tilt)
    x, z = up_z * np.sin(angle), up_z * np.cos(angle)
    x, y = (
        x * np.cos(mounting_error) + up_y * np.sin(mounting_error),
        up_y * np.cos(mounting_error) - x * np.sin(mounting_error),
    )
    y, z = (
        y * np.cos(mounting_roll) + z * np.sin(mounting_roll),
        z * np.cos(mounting_roll) - y * np.sin(mounting_roll),
    )
    platform = np.stack(np.broadcast_arrays(x, y, z), axis=1)
    force = np.zeros_like(platform)
    for label in np.unique(labels):
        rows = labels == label
        force[rows] = platform[rows] @ AXES[str(label)].T
    return force
