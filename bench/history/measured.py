"""A table of calibrations of many units on many benches, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats, Ints, Labels, Mask
from bench.calibration.intrinsic import intrinsic
from bench.calibration.result import CalibrationError, Derived
from bench.model.geometry import COEFFICIENTS, Block

STANDARD_GRAVITY: Final = 9.80665
"""Standard gravity, m/s² (3rd CGPM, 1901): the g in "V/g" of data sheets and of scale factors that are compared."""


LEAST_OWN: Final = 1e-3
"""The least fraction of a stated variance that counts as a calibration's own, independent part."""


@dataclass(frozen=True)
class ComparedCalibrations:
    """A table of n calibrations: the `unit` (n,) of each, its type `kind` (n,), `bench` (n,) and time `when` (n,).

    `vector` (n, 12) has scale factors in `signal`/g with g = `STANDARD_GRAVITY` and biases in `signal`;
    `covariance` (n, 12, 12) is as stated. `meters` (n, 12) is the part of u that recurs in every calibration with
    the same meters, zero if not stated. `gravity` (n, 12) is the error due to one u of g, which `covariance`
    includes; all calibrations at a `place` (n,), which is its local g, m/s², share it. `simulated` is whether
    all calibrations used simulated instruments. Raises `CalibrationError` for an empty table.
    """

    unit: Labels
    kind: Labels
    bench: Labels
    when: NDArray[np.datetime64]
    vector: Floats
    covariance: Floats
    meters: Floats
    gravity: Floats
    place: Floats
    signal: str
    simulated: bool

    def __post_init__(self) -> None:
        """Refuse an empty table."""
        if not len(self.unit):
            raise CalibrationError(
                "no calibration with unit, bench and all twelve coefficients is left; widen the question"
            )

    def __len__(self) -> int:
        """Return the number of calibrations."""
        return len(self.unit)

    def of(self, kept: Mask | Ints) -> ComparedCalibrations:
        """Return the table of selected calibrations, by mask or by index."""
        return ComparedCalibrations(
            self.unit[kept], self.kind[kept], self.bench[kept], self.when[kept], self.vector[kept],
            self.covariance[kept], self.meters[kept], self.gravity[kept], self.place[kept], self.signal,
            self.simulated,
        )  # fmt: skip

    def in_nine(self) -> ComparedCalibrations:
        """Return the table in the nine intrinsic numbers: arrays (n, 9) or (n, 9, 9).

        Raises `CalibrationError` for a K that describes no block.
        """
        try:
            own = [
                intrinsic(Block.from_vector(v), c) for v, c in zip(self.vector, self.covariance, strict=True)
            ]
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                f"a calibration of {', '.join(sorted(set(self.unit)))}: {error}"
            ) from error
        variance = [one.jacobian**2 @ m**2 for one, m in zip(own, self.meters, strict=True)]
        return replace(
            self,
            vector=np.array([one.values for one in own]),
            covariance=np.array([one.covariance for one in own]),
            meters=np.sqrt(np.minimum(variance, [np.diag(one.covariance) for one in own])),
            gravity=np.array([one.jacobian @ g for one, g in zip(own, self.gravity, strict=True)]),
        )

    @property
    def variance(self) -> Floats:
        """The stated variances, (n, 12)."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def own_variance(self) -> Floats:
        """The stated variances (n, 12) minus the parts shared by calibrations with the same meters or the same g.

        At least the fraction `LEAST_OWN` of the stated variance remains.
        """
        return np.maximum(self.variance - self.meters**2 - self.gravity**2, LEAST_OWN * self.variance)


def to_gravity(g_m_s2: Floats | float, other: float = STANDARD_GRAVITY) -> Floats:
    """Return the factors (…, 12) from coefficients per g of `g_m_s2` (…) to those per g of `other`."""
    ratio = other / np.asarray(g_m_s2)[..., None]
    return np.where(np.arange(len(COEFFICIENTS)) < 9, ratio, 1.0)


def of_gravity(vector: Floats, gravity_u: Floats | float) -> Floats:
    """Return the error (…, 12) of coefficients (…, 12) due to one relative u of g, `gravity_u` (…)."""
    return np.where(np.arange(len(COEFFICIENTS)) < 9, vector * np.asarray(gravity_u)[..., None], 0.0)


def nine_of(name: str, vector: Floats, covariance: Floats) -> Derived:
    """Return the nine intrinsic numbers of coefficients (12,) with a covariance (12, 12).

    Raises `CalibrationError` if they are undefined, as for a block with a dead channel; `name` begins the message.
    """
    try:
        return intrinsic(Block.from_vector(vector), covariance)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"{name}: the matrix K describes no block, as {error}") from error


def coded(labels: Sequence[str] | Labels) -> tuple[Labels, Ints]:
    """Return the sorted distinct labels and the index of each label: "b", "a", "b" -> ["a", "b"], [1, 0, 1]."""
    names, codes = np.unique(np.asarray(labels, dtype=str), return_inverse=True)
    return names, codes.astype(np.int64)
