"""What a navigation computer takes from the coefficients: N = K^-1 and the misalignment angles, with covariance.

First order in the uncertainties, with exact derivatives: dN = -N dK N.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bench.base.arrays import Floats, HasCovariance
from bench.model.geometry import COEFFICIENTS, Block

INVERSE: Final = (
    "Nxx", "Nxy", "Nxz", "Nyx", "Nyy", "Nyz", "Nzx", "Nzy", "Nzz", "U0x", "U0y", "U0z",
)  # fmt: skip
"""The twelve numbers of a = N (U - U0), in the order of every vector and table of them."""

MISALIGNMENTS: Final = {
    "alpha_yx": ("Kxy", "Kxx", 1.0),
    "alpha_zx": ("Kxz", "Kxx", -1.0),
    "alpha_xy": ("Kyx", "Kyy", -1.0),
    "alpha_zy": ("Kyz", "Kyy", 1.0),
    "alpha_xz": ("Kzx", "Kzz", 1.0),
    "alpha_yz": ("Kzy", "Kzz", -1.0),
}
"""Each angle by name: its K_ij, its K_ii and (-1)^n.

Source: the paper, K_ij = (-1)^n K_ii alpha_ji, n = 2 where j follows i in x -> y -> z -> x, else 1. So alpha_ji is
the right-hand turn of the input axis of channel i about the third axis, in the plane of i and j.
"""


@dataclass(frozen=True)
class Derived(HasCovariance):
    """Numbers computed from the coefficients: `values` (m,) and their `covariance` (m, m), by `names`.

    `jacobian` (m, 12) are their derivatives by `COEFFICIENTS`: 1 of these themselves.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    jacobian: Floats = field(default_factory=lambda: np.eye(len(COEFFICIENTS)))


def inverse(block: Block, covariance: Floats) -> Derived:
    """Return the twelve numbers of a = N (U - U0), `INVERSE`, from a block and its covariance (12, 12).

    N in g per unit of the signal, U0 in that unit. Raises `numpy.linalg.LinAlgError` when K is singular.
    """
    N = np.asarray(np.linalg.inv(block.K), dtype=np.float64)
    slopes = inverse_jacobian(N)
    return Derived(INVERSE, np.concatenate([N.ravel(), block.U0]), _through(slopes, covariance), slopes)


def inverse_jacobian(N: Floats) -> Floats:
    """Return the derivatives (12, 12) of `INVERSE` by `COEFFICIENTS`: dN_ij/dK_kl = -N_ik N_lj, U0 itself."""
    jacobian = np.eye(len(COEFFICIENTS))
    jacobian[:9, :9] = -np.kron(N, N.T)
    return jacobian


def misalignments(block: Block, covariance: Floats) -> Derived:
    """Return the six angles `MISALIGNMENTS`, rad, from a block and its covariance (12, 12)."""
    vector = block.vector
    values, rows = np.zeros(len(MISALIGNMENTS)), np.zeros((len(MISALIGNMENTS), len(COEFFICIENTS)))
    for row, (cross, own, sign) in enumerate(MISALIGNMENTS.values()):
        ij, ii = COEFFICIENTS.index(cross), COEFFICIENTS.index(own)
        values[row] = sign * vector[ij] / vector[ii]
        rows[row, ij] = sign / vector[ii]
        rows[row, ii] = -values[row] / vector[ii]
    return Derived(tuple(MISALIGNMENTS), values, _through(rows, covariance), rows)


def specific_force_covariance(derived: Derived, signal: Floats, noise: float = 0.0) -> Floats:
    """Return the covariance (n, 3, 3), g^2, of a = N (U - U0) for signals (n, 3).

    Of the numbers `derived` by `inverse`, and of fresh noise in each signal, 1 sigma in its unit.
    """
    N, U0 = derived.values[:9].reshape(3, 3), derived.values[9:]
    left = signal - U0
    jacobian = np.zeros((len(signal), 3, len(INVERSE)))
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3] = left
    jacobian[:, :, 9:] = -N
    return np.asarray(jacobian @ derived.covariance @ np.moveaxis(jacobian, 1, 2) + noise**2 * N @ N.T)


def _through(jacobian: Floats, covariance: Floats) -> Floats:
    through = jacobian @ covariance @ jacobian.T
    return np.asarray(0.5 * (through + through.T))
