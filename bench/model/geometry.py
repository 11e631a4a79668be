"""Exact geometry of a block on a dividing head, normal gravity, the block, and distributions of bench errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bench.base.arrays import Floats

# --- geometry ---------------------------------------------------------------------------------------

STAND_ANGLES: Final = ("axis_tilt", "zero_offset", "mounting_error", "mounting_offset", "mounting_roll")
"""The angles that stay constant during one mounting, in the column order of `stand_errors`.

`axis_tilt` is alpha1, `zero_offset` alpha2, `mounting_error` alpha3 (rotation about z of the platform),
`mounting_offset` a rotation about the shaft (adds to alpha2), `mounting_roll` the third mounting angle (rotation
about x of the platform), which the paper omits.
"""


def stand_errors(**angles_rad: float) -> Floats:
    """Return the stand angles of one mounting as a vector, rad, shape (5,); unnamed angles are zero.

    Raises `KeyError` for a name that is not in `STAND_ANGLES`.
    """
    unknown = set(angles_rad) - set(STAND_ANGLES)
    if unknown:
        raise KeyError(
            f"unknown stand angle: {', '.join(sorted(unknown))}; choose from {', '.join(STAND_ANGLES)}"
        )
    return np.array([angles_rad.get(name, 0.0) for name in STAND_ANGLES], dtype=np.float64)


def within_half_turn(angle_rad: Floats) -> Floats:
    """Return angles of any shape, rad, reduced by whole turns to the range from -pi to pi."""
    return angle_rad - 2 * np.pi * np.round(angle_rad / (2 * np.pi))


def frame_rotation(axis: str, angle_rad: float) -> Floats:
    """Return the 3x3 matrix that transforms components to a frame rotated by `angle_rad` about `axis`.

    Raises `ValueError` for an `axis` other than "x", "y" or "z".
    """
    s, c = np.sin(angle_rad), np.cos(angle_rad)
    match axis:
        case "x":
            rows = [[1, 0, 0], [0, c, s], [0, -s, c]]
        case "y":
            rows = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        case "z":
            rows = [[c, s, 0], [-s, c, 0], [0, 0, 1]]
        case _:
            raise ValueError(f"state an axis x, y or z, not {axis!r}")
    return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class Installation:
    """The orientation of the block on the platform.

    `block_from_platform` (3x3, a proper rotation) transforms components on platform axes to components on block
    axes. Installation 1 of the paper is the identity; installation 2 is (-x, z, y).
    """

    label: str
    block_from_platform: Floats

    @classmethod
    def from_axes(
        cls, label: str, axes: Sequence[str], turned_rad: float = 0.0, about: str = "z"
    ) -> Installation:
        """Return the installation in which the block axes lie along these platform axes, such as ("-x", "z", "y").

        The block is then rotated by `turned_rad` about the platform axis `about` (the paper's psi). Raises
        `ValueError` unless the axes form a right-handed set.
        """
        return cls(label, axes_matrix(axes) @ frame_rotation(about, turned_rad))


def axes_matrix(axes: Sequence[str]) -> Floats:
    """Return the matrix (3, 3), a signed permutation, for three axis names such as ("-x", "z", "y").

    Raises `ValueError` for an unknown name, or unless the axes form a right-handed set.
    """
    identity = np.eye(3)
    unit = {sign + "xyz"[i]: float(sign + "1") * identity[i] for sign in ("", "+", "-") for i in range(3)}
    for name in axes:
        if name not in unit:
            raise ValueError(f"state an axis x, y, z, -x, -y or -z, not {name!r}")
    matrix = np.array([unit[name] for name in axes], dtype=np.float64)
    if matrix.shape != (3, 3) or np.linalg.det(matrix) < 0.5:  # it is -1, 0 or 1
        raise ValueError(
            f"the axes {', '.join(axes)} are not three different axes in right-handed order "
            "(installation 1 is [x, y, z], installation 2 is [-x, z, y])"
        )
    return matrix


INSTALLATION_1: Final = Installation("1", axes_matrix(("x", "y", "z")))
INSTALLATION_2: Final = Installation("2", axes_matrix(("-x", "z", "y")))


def specific_force_on_platform(angle_rad: Floats, stand_rad: Floats) -> Floats:
    """Return the specific force on the axes of the platform, with all stand angles applied, in g, shape (n, 3).

    `angle_rad` (n,) is the true angle of the head, including the setting error alpha4; `stand_rad` (n, 5) holds the
    stand angles of each row in the order of `STAND_ANGLES`. Source: paper (3)-(4), which are of first order in the
    angles; here the exact form.
    """
    tilt, offset, yaw, pitch, roll = stand_rad.T
    turns = np.array([angle_rad + offset + pitch, tilt, yaw, roll])
    (sin, sin_tilt, sin_yaw, sin_roll), (cos, cos_tilt, cos_yaw, cos_roll) = np.sin(turns), np.cos(turns)
    x, y, z = sin * cos_tilt, sin_tilt, cos * cos_tilt
    x, y = cos_yaw * x + sin_yaw * y, -sin_yaw * x + cos_yaw * y
    y, z = cos_roll * y + sin_roll * z, -sin_roll * y + cos_roll * z
    return np.stack([x, y, z], axis=-1)


# Constants of WGS 84: gravity at the equator, Somigliana's k, the ellipsoid, and m = omega² a² b / GM.
_EQUATOR_M_S2: Final = 9.7803253359
_SOMIGLIANA_K: Final = 0.00193185265241
_ECCENTRICITY_SQUARED: Final = 0.00669437999014
_SEMI_MAJOR_M: Final = 6378137.0
_FLATTENING: Final = 1 / 298.257223563
_M: Final = 0.00344978650684


def normal_gravity_m_s2(latitude_rad: float, height_m: float = 0.0) -> float:
    """Return normal gravity in m/s² at a geodetic latitude and a height above the ellipsoid.

    Local anomalies (about 1e-4 to 1e-3 m/s²) are not included. Raises `ValueError` for a latitude beyond the
    poles.
    """
    if not abs(latitude_rad) <= math.pi / 2 + 1e-9:
        raise ValueError(f"state a latitude between -90° and 90°, not {math.degrees(latitude_rad):g}°")
    s2 = math.sin(latitude_rad) ** 2
    on_ellipsoid = _EQUATOR_M_S2 * (1 + _SOMIGLIANA_K * s2) / math.sqrt(1 - _ECCENTRICITY_SQUARED * s2)
    h = height_m / _SEMI_MAJOR_M
    return on_ellipsoid * (1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * s2) * h + 3 * h**2)


# --- the block, U = K a + U0 (paper (1)) and its inverse a = N (U - U0) (paper (2)) -----------------

COEFFICIENTS: Final = (
    "Kxx", "Kxy", "Kxz", "Kyx", "Kyy", "Kyz", "Kzx", "Kzy", "Kzz", "U0x", "U0y", "U0z",
)  # fmt: skip
"""The twelve coefficients, in the order of every coefficient vector and covariance matrix of this project."""

HIDDEN: Final = 1e-3
"""Singular values up to this fraction of the largest count as zero; so do null-space components up to this size."""


def linear_columns(force: Floats) -> Floats:
    """Return the design matrix (n, 4) of one channel: the specific force (n, 3) and a column of ones."""
    return np.column_stack([force, np.ones(len(force))])


def hidden_axes(force: Floats) -> list[str]:
    """Return what readings at these forces do not determine: "x", "y", "z" for axes, "0" for the biases.

    `force` (n, 3) is in g. An axis is listed if the null space of the design matrix has a component along it; the
    list is empty if the readings determine all twelve coefficients.
    """
    _, size, directions = np.linalg.svd(np.linalg.qr(linear_columns(force), mode="r"))
    size = np.concatenate([size, np.zeros(4 - len(size))])
    null = np.abs(directions[size <= HIDDEN * max(size[0], 1e-300)])
    largest = null.max(axis=0, initial=0.0)
    return [axis for axis, part in zip("xyz0", largest, strict=True) if part > HIDDEN]


@dataclass(frozen=True)
class Block:
    """A triaxial accelerometer block: scale factors and cross-axis terms `K` (3x3, V/g), biases `U0` (3, V)."""

    K: Floats
    U0: Floats

    @classmethod
    def from_vector(cls, coefficients: Floats) -> Block:
        """Return the block with these 12 coefficients, in the order of `COEFFICIENTS`."""
        vector = np.asarray(coefficients, dtype=np.float64)
        return cls(vector[:9].reshape(3, 3), vector[9:])

    @property
    def vector(self) -> Floats:
        """The 12 coefficients in the order of `COEFFICIENTS`, shape (12,)."""
        return np.concatenate([self.K.ravel(), self.U0])

    def output(self, specific_force_g: Floats) -> Floats:
        """Return the signals in volts for specific forces (n, 3) in g. Source: paper (1)."""
        return specific_force_g @ self.K.T + self.U0

    def specific_force(self, signal_v: Floats) -> Floats:
        """Return the specific force (n, 3) in g for signals in volts. Source: paper (2).

        Raises `numpy.linalg.LinAlgError` when K is singular.
        """
        return np.asarray(np.linalg.solve(self.K, (signal_v - self.U0).T).T, dtype=np.float64)


# --- distribution of a bench error ------------------------------------------------------------------


@dataclass(frozen=True)
class Distribution:
    """The distribution of a bench error with zero mean, in SI units.

    `limit` is the half-width of a rectangular distribution, or `k` standard deviations of a normal one.
    Source: JCGM 100:2008, 4.3.4-4.3.7.
    """

    limit: float
    shape: Literal["normal", "rectangular"] = "normal"
    k: float = 1.0

    @property
    def u(self) -> float:
        """Standard uncertainty, in the unit of `limit`."""
        return self.limit / (self.k if self.shape == "normal" else float(np.sqrt(3.0)))

    def draw(self, rng: np.random.Generator) -> float:
        """Return one random value, in the unit of `limit`."""
        if self.shape == "normal":
            return float(rng.normal(0.0, self.u))
        return float(rng.uniform(-self.limit, self.limit))


ZERO = Distribution(0.0)


def modulus_slopes(force: Floats, block: Block) -> tuple[Floats, Floats]:
    """Return the derivatives of |a| with respect to the 12 coefficients, (n, 12), and to the signals, (n, 3).

    `force` (n, 3) is the measured specific force a = K⁻¹ (U - U0), g.
    """
    # w = d|a|/dU = (a/|a|)^T N; d|a|/dK_ij = -w_i a_j; d|a|/dU0 = -w
    modulus = np.linalg.norm(force, axis=1)
    by_signal = (force / modulus[:, None]) @ np.linalg.inv(block.K)
    by_k = -(by_signal[:, :, None] * force[:, None, :]).reshape(len(force), 9)
    return np.concatenate([by_k, -by_signal], axis=1), by_signal
