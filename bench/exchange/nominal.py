"""The block as a sensor that gives m/s^2, as autopilots and Kalibr expect one; and what their forms leave out.

The signals are turned into m/s^2 by a scale factor that is stated in the file, S_i in unit per g of 9.80665 m/s^2:
z_i = 9.80665 U_i / S_i. What the block is other than S goes into the parameters: z = M a + b, a in m/s^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.exchange.result import BlockResult

STANDARD_GRAVITY: Final = 9.80665
"""m/s^2 (3rd CGPM, 1901): what a data sheet's "V/g" means by g."""
DIGITS: Final = 3
"""Significant digits of the scale factors that are taken where none are stated."""


@dataclass(frozen=True)
class Sensor:
    """z = M a + b in m/s^2; z = 9.80665 U / `nominal` (3,), a scale factor in unit/g."""

    nominal: Floats
    M: Floats
    b: Floats
    unit: str

    def signal(self, signal: Floats) -> Floats:
        """Return z (n, 3) in m/s^2 for signals (n, 3)."""
        return np.asarray(STANDARD_GRAVITY * signal / self.nominal)

    def told(self) -> list[str]:
        """Return in words how z is had from the signals."""
        if self.unit == "m/s^2":
            return ["the signals are in m/s^2 and taken as they are: z = U"]
        factors = ", ".join(f"{float(s)!r}" for s in self.nominal)
        return [
            f"the block gives {self.unit}, this form takes m/s^2: feed it z_i = 9.80665 U_i / S_i with the scale "
            "factors",
            f"S = ({factors}) {self.unit}/g, chosen for it; what the block differs from S is in the values below",
        ]


def sensor_of(result: BlockResult, nominal: Floats | None = None) -> Sensor:
    """Return the block as a sensor in m/s^2, with scale factors asked for (unit/g) or its own, rounded."""
    if result.unit == "m/s^2":
        own = np.full(3, STANDARD_GRAVITY)
    elif result.unit == "g":
        own = np.ones(3)
    else:
        found = np.diag(result.block.K) * STANDARD_GRAVITY / result.g_m_s2
        own = np.array([float(f"{value:.{DIGITS}g}") for value in found])
    S = own if nominal is None else nominal
    to_ms2 = STANDARD_GRAVITY / S
    M = result.block.K * (to_ms2 / result.g_m_s2)[:, None]
    return Sensor(S, M, to_ms2 * result.block.U0, result.unit)


@dataclass(frozen=True)
class Diagonal:
    """The form of autopilots: a_i = (z_i - offset_i) scale_i, m/s^2; the cross-axis terms are left out.

    `modulus_g` and `vector_g` are the most by which |a| and a are then off at 1 g, in any direction, in g.
    """

    offset: Floats
    scale: Floats
    modulus_g: float
    vector_g: float

    def told(self) -> list[str]:
        """Return in words what is lost."""
        return [
            "the six cross-axis terms are left out, for this form has a scale and an offset per axis and no more:",
            f"at 1 g |a| is off by up to {_size(self.modulus_g)}, the vector a by up to {_size(self.vector_g)}, "
            "in the worst direction",
        ]


def diagonal(sensor: Sensor) -> Diagonal:
    """Return offset and scale of each axis by itself, and exactly what leaving out the rest costs at 1 g.

    a' = diag(1/M_ii) M a: |a'| lies between the least and the largest singular value of that matrix, and
    |a' - a| is at most the largest one of its difference from 1.
    """
    scale = 1.0 / np.diag(sensor.M)
    left = scale[:, None] * sensor.M
    size = np.linalg.svd(left, compute_uv=False)
    vector = np.linalg.norm(left - np.eye(3), 2)
    return Diagonal(sensor.b, scale, float(np.max(np.abs(size - 1.0))), float(vector))


@dataclass(frozen=True)
class Triangular:
    """The form of Kalibr: z = M R a + b with M lower triangular, R the turn from the block's axes to M's own.

    `turn_rad` is the angle of R.
    """

    M: Floats
    R: Floats
    b: Floats
    turn_rad: float


def lower_triangular(sensor: Sensor) -> Triangular:
    """Return M lower triangular with a positive diagonal, and R orthogonal, of which M R is the sensor's matrix."""
    q, r = np.linalg.qr(sensor.M.T)
    sign = np.where(np.diag(r) < 0, -1.0, 1.0)
    M, R = (sign[:, None] * r).T, (q * sign).T
    skew = np.linalg.norm(R - R.T) / np.sqrt(8.0)
    return Triangular(np.tril(M), R, sensor.b, float(np.arctan2(skew, 0.5 * (np.trace(R) - 1.0))))


def axis_rows(values: Floats) -> list[tuple[str, float]]:
    """Return (X, value), (Y, value), (Z, value)."""
    return [(axis.upper(), float(value)) for axis, value in zip(CHANNELS, values, strict=True)]


def _size(error_g: float) -> str:
    """Return an error as one reads it: "12 mg", "35 µg"."""
    from bench.base.numbers import quantity

    return quantity(error_g, "g").replace("µ", "u")
