"""A run for tests of effects, in which every condition that an effect may depend on varies.

Both installations are turned by PSI, so that all axes of the block feel gravity. Each has a rising pass and a
falling pass, which is scanned in reverse. Forces come from bench.validation, not from `bench.model`.
"""

from typing import Any

import numpy as np

from bench.base.arrays import Floats
from bench.model import CATALOGUE, AppliedEffect, Block, Conditions, ForwardModel, Installation
from bench.validation.paper_bench import ARCSEC, U0, K, specific_force

PSI = 0.6
BLOCK = Block(K, U0)
KII = np.diag(K)
INSTALLATIONS = {
    "1": Installation.from_axes("1", ("x", "y", "z"), PSI),
    "2": Installation.from_axes("2", ("-x", "z", "y"), PSI),
}

POINTS = np.array([0, 40, 95, 130, 180, 222, 275, 310, 360])
LABELS = [label for label in "12" for _ in range(18)]
SECOND = np.array(LABELS) == "2"
PHI = np.radians(np.tile(np.concatenate([POINTS, POINTS[::-1]]), 2).astype(float))
DIRECTION = np.tile(np.repeat([1, -1], 9), 2)
TIME_S = 130.0 * np.arange(36) + 2400.0 * SECOND + 7.0 * np.sin(np.arange(36))
WARMTH_K = 0.6 + 0.4 * np.sin(TIME_S / 1500.0)
ABOVE_V = np.stack([0.2 * np.cos(TIME_S / 900.0), -0.1 + 0.05 * np.sin(TIME_S / 700.0)], axis=1)
ORDER = np.where(DIRECTION[:, None] > 0, [0, 1, 2], [2, 1, 0])
CONDITIONS = Conditions.of(
    LABELS,
    PHI,
    direction=DIRECTION.tolist(),
    time_s=TIME_S,
    temperature_c=20.0 + WARMTH_K,
    scan_order=ORDER,
    supply_v=ABOVE_V,
)
# stand angles of the two mountings: alpha1, alpha2, alpha3, mounting offset, alpha5
STAND = np.array([[3, -4, 70, 0, 20], [-2, 5, -60, 0, -30]]) * ARCSEC
ALPHA4 = 4 * ARCSEC * np.cos(2.3 * np.arange(36))


def force(
    phi: float = 0.0, alpha1: float = 0.0, alpha2: float = 0.0, alpha3: float = 0.0, alpha5: float = 0.0
) -> Floats:
    """Return the specific force with head angle and stand angles increased by the arguments, rad."""
    a1, a2, a3, _, a5 = STAND[SECOND.astype(int)].T
    return specific_force(
        LABELS, PHI + phi, a1 + alpha1, a2 + alpha2, a3 + alpha3, ALPHA4, alpha5=a5 + alpha5, psi=PSI
    )


def readings(*effects: AppliedEffect, conditions: Conditions = CONDITIONS) -> Floats:
    """Return the readings of the application's model with these effects, V."""
    return ForwardModel(INSTALLATIONS, effects).readings(BLOCK, conditions, STAND, ALPHA4)


def effect(name: str, installations: tuple[str, ...] = (), **values: Any) -> AppliedEffect:
    arrays = {key: np.asarray(value, dtype=float) for key, value in values.items()}
    return AppliedEffect(CATALOGUE[name], arrays, installations=installations)


def added(
    name: str, installations: tuple[str, ...] = (), conditions: Conditions = CONDITIONS, **values: Any
) -> Floats:
    """Return the change of the model's readings by one effect, V."""
    one = effect(name, installations, **values)
    return readings(one, conditions=conditions) - readings(conditions=conditions)
