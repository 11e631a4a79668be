"""Array types, channel names, units of angle and time, and functions of arrays for all packages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import CHANNELS

__all__ = [
    "ARCSEC", "CHANNELS", "HOUR", "MINUTE", "Floats", "HasCovariance", "Ints", "Labels", "Mask", "Singles",
    "least_squares", "rms", "u_of", "unit_vectors",
]  # fmt: skip

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Labels = NDArray[np.str_]

ARCSEC = np.pi / 648000
"""One second of arc, rad."""

MINUTE = 60.0
HOUR = 3600.0
"""A minute and an hour, s."""


def unit_vectors(vectors: Floats) -> tuple[Floats, Floats]:
    """Return `vectors` (…, 3) divided by their lengths, and the lengths (…); a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1)
    return vectors / np.where(length > 0, length, 1.0)[..., None], length


def least_squares(columns: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares solution, (p,) or (p, k), and the residuals, in the target's shape.

    `columns` is the design matrix (n, p), `target` has the shape (n,) or (n, k).
    """
    solution, *_ = np.linalg.lstsq(columns, target, rcond=None)
    return np.asarray(solution), target - columns @ solution


def quadratic_forms(rows: Floats, matrix: Floats) -> Floats:
    """Return r^T M r for each row r of `rows` (n, p) and a matrix M (p, p), shape (n,).

    `numpy.einsum` takes several times as long, because each call searches for the best order of products.
    """
    moved = (matrix.T @ rows.T).T
    return np.asarray(np.matmul(moved[:, None, :], rows[:, :, None]).ravel())


def rms(values: Floats) -> float:
    """Return the root mean square of values of any shape, NaN for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def u_of(covariance: Floats) -> Floats:
    """Return the standard uncertainties (m,) from a covariance matrix (m, m)."""
    return np.sqrt(np.diag(covariance))


class HasCovariance:
    """A mixin that adds standard uncertainties to a class with a covariance matrix `covariance` (m, m)."""

    covariance: Floats

    @property
    def u(self) -> Floats:
        """Standard uncertainties, shape (m,)."""
        return u_of(self.covariance)
