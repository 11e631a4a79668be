"""The block of three accelerometers, U = K a + U0 (paper (1)) and its inverse a = N (U - U0) (paper (2))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats

COEFFICIENTS: Final = (
    "Kxx", "Kxy", "Kxz", "Kyx", "Kyy", "Kyz", "Kzx", "Kzy", "Kzz", "U0x", "U0y", "U0z",
)  # fmt: skip
"""The twelve coefficients in the order of every vector and covariance of this application."""

HIDDEN: Final = 1e-3
"""A direction is left open whose singular value is no more than this part of the largest."""


def linear_columns(force: Floats) -> Floats:
    """Return what a channel is linear in, shape (n, 4): the specific force (n, 3), and one for its bias."""
    return np.column_stack([force, np.ones(len(force))])


def hidden_axes(force: Floats) -> list[str]:
    """Return which of x, y, z, and 0 for the biases, take part in what readings at these forces leave open.

    `force` (n, 3) in g; none for readings that determine the twelve coefficients.
    """
    _, size, directions = np.linalg.svd(np.linalg.qr(linear_columns(force), mode="r"))
    size = np.concatenate([size, np.zeros(4 - len(size))])
    null = np.abs(directions[size <= HIDDEN * max(size[0], 1e-300)])
    largest = null.max(axis=0, initial=0.0)
    return [axis for axis, part in zip("xyz0", largest, strict=True) if part > HIDDEN]


@dataclass(frozen=True)
class Block:
    """Scale factors and cross-axis terms `K` (3x3, V/g) and biases `U0` (3, V)."""

    K: Floats
    U0: Floats

    @classmethod
    def from_vector(cls, coefficients: Floats) -> Block:
        """Build from the 12 coefficients in the order of `COEFFICIENTS`."""
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
