"""The truth of a simulated laboratory: units that drift, benches with effects, what their stands then read.

`benchmarks.many_folders` writes it as run folders.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.model.geometry import (
    COEFFICIENTS,
    INSTALLATION_1,
    INSTALLATION_2,
    Installation,
    specific_force_on_platform,
)

FIRST_DAY: Final = datetime(2016, 1, 4, 6, tzinfo=UTC)
YEARS: Final = 10.0
PASSES: Final = 3
POINTS: Final = 9
UNIT_SPREAD: Final = 2e-3
BENCH_EFFECT: Final = 3e-5
DRIFT_A_YEAR: Final = 3e-5
"""Standard deviations of the truth in each coefficient, V/g and V (a year)."""
STAND_SD: Final = np.array([5.0 / 3.0, 5.0 / 3.0, 30.0, 0.0, 0.0]) * ARCSEC
INSTALLATIONS: Final = (
    INSTALLATION_1,
    INSTALLATION_2,
    Installation.from_axes("V", ("x", "y", "z"), np.pi / 4),
)
WHERE: Final = np.repeat([0, 1, 2], [27, 27, 4])
TARGET_DEG: Final = np.concatenate([np.tile(np.arange(9) * 45.0, 6), np.arange(45.0, 360.0, 90.0)])


@dataclass(frozen=True)
class Truth:
    """Units (U, 12) with drift a year (U, 12), effects of benches (B, 12), the runs' unit, bench and day."""

    units: Floats
    drift: Floats
    benches: Floats
    unit: np.ndarray[Any, np.dtype[np.int64]]
    bench: np.ndarray[Any, np.dtype[np.int64]]
    day: Floats

    @classmethod
    def drawn(cls, mean: Floats, count: int, benches: int, units: int, seed: int) -> Truth:
        random = np.random.default_rng([seed, 1])
        return cls(
            mean + random.normal(0.0, UNIT_SPREAD, (units, 12)),
            random.normal(0.0, DRIFT_A_YEAR, (units, 12)),
            random.normal(0.0, BENCH_EFFECT, (benches, 12)),
            random.permutation(np.arange(count) % units),
            random.integers(0, benches, count),
            np.sort(random.uniform(0.0, YEARS * 365.25, count)),
        )

    def to_json(self) -> dict[str, Any]:
        """Return what was drawn; `runs` are the runs' units, benches and days since the first."""
        return {
            "simulated": True,
            "order": list(COEFFICIENTS),
            "units": self.units.tolist(),
            "drift_a_year": self.drift.tolist(),
            "benches": self.benches.tolist(),
            "runs": [self.unit.tolist(), self.bench.tolist(), self.day.tolist()],
        }


def forces(angles: Floats, stand: Floats) -> Floats:
    """Return the force (R, 58, 3) on the block for true angles (R, 58), rad, and stand angles (R, 3, 5)."""
    found = np.empty((*angles.shape, 3))
    for place, installation in enumerate(INSTALLATIONS):
        rows = place == WHERE
        many = angles[:, rows]
        mount = np.broadcast_to(stand[:, place, None], (*many.shape, 5))
        on_platform = specific_force_on_platform(many.ravel(), mount.reshape(-1, 5))
        found[:, rows] = (on_platform @ installation.block_from_platform.T).reshape(*many.shape, 3)
    return found


def signals(theta: Floats, force: Floats) -> Floats:
    """Return K a + U0 (R, n, 3) of coefficients (R, 12)."""
    acting = np.einsum("rij,rnj->rni", theta[:, :9].reshape(-1, 3, 3), force)
    return np.asarray(acting + theta[:, None, 9:], dtype=np.float64)


class Estimator:
    """Least squares with the stand's angles as prior, about coefficients (12,), with so much noise of a reading."""

    def __init__(self, theta: Floats, noise_v: float) -> None:
        fit = WHERE < 2
        angles = np.radians(TARGET_DEG)[None]
        still = np.zeros((1, 3, 5))
        force = forces(angles, still)[:, fit]

        def seen(stand: Floats) -> Floats:
            return signals(theta[None], forces(angles, stand)[:, fit]).ravel()

        at = seen(still)
        of_block = np.stack([signals(row[None], force).ravel() for row in np.eye(12)], axis=1)
        columns = []
        for place in range(2):
            for angle in np.flatnonzero(STAND_SD):
                stand = still.copy()
                stand[0, place, angle] = 1e-6
                columns.append((seen(stand) - at) / 1e-6 * STAND_SD[angle])
        of_stand = np.stack(columns, axis=1)
        covariance = noise_v**2 * np.eye(len(at)) + of_stand @ of_stand.T
        weighted = np.linalg.solve(covariance, of_block)
        self.gain = np.linalg.solve(of_block.T @ weighted, weighted.T)
        first = of_stand.reshape(2, PASSES, POINTS, 3, -1)[:, 0].reshape(2 * POINTS * 3, -1)
        self.of_means = np.linalg.inv(noise_v**2 / PASSES * np.eye(len(first)) + first @ first.T)

    def __call__(self, theta: Floats, angles: Floats, seen: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the estimates (R, 12), rms of residuals, chi-square (42) and scatter of repeats (R,)."""
        fit = WHERE < 2
        force = forces(angles, np.zeros((len(angles), 3, 5)))[:, fit]
        found = np.broadcast_to(theta, (len(angles), 12))
        for _ in range(3):
            left = (seen[:, fit] - signals(found, force)).reshape(len(angles), -1)
            found = found + left @ self.gain.T
        by_pass = (seen[:, fit] - signals(found, force)).reshape(-1, 2, PASSES, POINTS, 3)
        mean = by_pass.mean(axis=2, keepdims=True)
        flat = mean.reshape(len(angles), -1)
        scatter = np.sqrt(((by_pass - mean) ** 2).sum(axis=(1, 2, 3, 4)) / (2 * (PASSES - 1) * POINTS * 3))
        chi2 = np.einsum("ri,ij,rj->r", flat, self.of_means, flat)
        return found, np.sqrt((by_pass**2).mean(axis=(1, 2, 3, 4))), chi2, scatter
