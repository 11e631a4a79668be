"""Calibrations of many units on many benches, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats, Ints, Labels, Mask
from bench.calibration.result import CalibrationError
from bench.model.geometry import COEFFICIENTS

STANDARD_GRAVITY: Final = 9.80665
"""Scale factors of several places are compared per g of so many m/s^2."""


LEAST_OWN: Final = 1e-3
"""Of a stated variance at least this part is taken as a calibration's own."""


@dataclass(frozen=True)
class ComparedCalibrations:
    """n calibrations: which `unit` of which `kind` (n,) on which `bench` (n,), and `when` (n,).

    `vector` (n, 12) in `signal`/g with g = `STANDARD_GRAVITY`, biases in `signal`, `covariance` (n, 12, 12) as
    stated; `meters` (n, 12) is the part of u that the same meters bring to each of their calibrations (zero where
    nobody stated one); `simulated` tells that all were found on simulated instruments. Raises `CalibrationError`
    where nothing is left of them.
    """

    unit: Labels
    kind: Labels
    bench: Labels
    when: NDArray[np.datetime64]
    vector: Floats
    covariance: Floats
    meters: Floats
    signal: str
    simulated: bool

    def __post_init__(self) -> None:
        """Refuse an empty table."""
        if not len(self.unit):
            raise CalibrationError("no calibration with a unit, a bench and all twelve coefficients is left")

    def __len__(self) -> int:
        """Return the number of calibrations."""
        return len(self.unit)

    def of(self, kept: Mask | Ints) -> ComparedCalibrations:
        """Return some of them."""
        return ComparedCalibrations(
            self.unit[kept], self.kind[kept], self.bench[kept], self.when[kept], self.vector[kept],
            self.covariance[kept], self.meters[kept], self.signal, self.simulated,
        )  # fmt: skip

    @property
    def variance(self) -> Floats:
        """Stated variances, (n, 12)."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def own_variance(self) -> Floats:
        """Stated variances without what the same meters bring again, (n, 12)."""
        return np.maximum(self.variance - self.meters**2, LEAST_OWN * self.variance)


def to_standard_gravity(g_m_s2: Floats) -> Floats:
    """Return what coefficients found where g is `g_m_s2` (n,) are to be multiplied by, (n, 12)."""
    factor = np.ones((len(g_m_s2), len(COEFFICIENTS)))
    factor[:, :9] = (STANDARD_GRAVITY / g_m_s2)[:, None]
    return factor


def coded(labels: Sequence[str] | Labels) -> tuple[Labels, Ints]:
    """Return the different labels, sorted, and which of them each is, counted from 0."""
    names, codes = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    return names, codes.astype(np.int64)
