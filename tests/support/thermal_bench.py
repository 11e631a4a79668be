"""Readings over temperature, simulated from known coefficients by the tests' own geometry."""

from typing import Any

import numpy as np

from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, TRUTH, design, specific_force

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
CYCLE_C = (23.0, 40.0, 55.0, 40.0, 23.0, 0.0, -20.0, 0.0, 23.0)
REFERENCE_C = 23.0


def truth(rng: np.random.Generator, sizes: tuple[float, ...] = (1e-4, 5e-7, 3e-9)) -> np.ndarray:
    """Return polynomials (12, 1 + len(sizes)) about `REFERENCE_C`: random terms of these sizes per K, K^2…"""
    higher = rng.normal(0.0, 1.0, (12, len(sizes))) * np.array(sizes)
    return np.column_stack([TRUTH, higher])


def coefficients(polynomials: np.ndarray, temperature_c: np.ndarray | float) -> np.ndarray:
    """Return the coefficients (…, 12) at these temperatures."""
    offset = np.asarray(temperature_c, dtype=float) - REFERENCE_C
    return np.stack([np.polynomial.polynomial.polyval(offset, row) for row in polynomials], axis=-1)


def branches(cycle: tuple[float, ...]) -> np.ndarray:
    """Return +1 for temperatures of the cycle reached from below, -1 from above, and 0 for the first."""
    return np.sign(np.diff(cycle, prepend=cycle[0]))


def simulate(
    rng: np.random.Generator,
    polynomials: np.ndarray,
    noise_v: float = 1e-4,
    *,
    cycle: tuple[float, ...] = CYCLE_C,
    cycle_2: tuple[float, ...] | None = None,
    passes: int = 3,
    hysteresis: np.ndarray | float = 0.0,
    drift_k: float = 0.2,
    roll_rad: float = 0.0,
    growing: float = 0.0,
) -> Readings:
    """Simulate the procedure 'temperature': each installation is mounted once and taken through the cycle.

    `hysteresis` (12,) is the rising minus the falling branch; temperatures scatter by `drift_k` (1 sigma).
    Installation 2 has the cycle `cycle_2`, if given. The third mounting angle scatters by `roll_rad`.
    `growing` is the noise in each reading as a part of the signal.
    """
    one, pass_number, point, phi = design(passes)
    columns: dict[str, list[Any]] = {
        n: [] for n in ("label", "pass", "point", "series", "phi", "t", "branch")
    }
    for label, temperatures in (("1", cycle), ("2", cycle_2 or cycle)):
        rows = [k for k, name in enumerate(one) if name == label]
        for series, (target, branch) in enumerate(zip(temperatures, branches(temperatures), strict=True), 1):
            columns["label"] += [label] * len(rows)
            columns["series"] += [series] * len(rows)
            columns["pass"] += [pass_number[k] for k in rows]
            columns["point"] += [point[k] for k in rows]
            columns["phi"] += [phi[k] for k in rows]
            columns["t"] += list(target + drift_k * rng.normal(size=len(rows)))
            columns["branch"] += [branch] * len(rows)
    n = len(columns["label"])
    angle, temperature = np.array(columns["phi"]), np.array(columns["t"])
    sizes = [STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
    at_label = [int(label) - 1 for label in columns["label"]]
    alpha1, alpha2, alpha3 = rng.normal(0.0, sizes, (2, 3))[at_label].T
    setting = rng.normal(0.0, SETTING_U_RAD, n)
    force = specific_force(columns["label"], angle, alpha1, alpha2, alpha3, setting)
    if roll_rad:
        # about x of the platform: the block's other two axes turn in opposite senses in the two installations
        roll = np.array([1.0, -1.0])[at_label] * rng.normal(0.0, roll_rad, 2)[at_label]
        force[:, 1:] = force[:, 1:] + roll[:, None] * force[:, :0:-1] * np.array([1.0, -1.0])
    at = coefficients(polynomials, temperature) + np.outer(columns["branch"], np.ones(12)) * hysteresis / 2
    signal = np.einsum("nij,nj->ni", at[:, :9].reshape(n, 3, 3), force) + at[:, 9:]
    if growing:
        signal = signal * (1.0 + rng.normal(0.0, growing, signal.shape))
    return make_readings(
        columns["label"],
        columns["pass"],
        columns["point"],
        angle,
        signal + rng.normal(0.0, noise_v, (n, 3)),
        series=columns["series"],
        temperature_c=temperature,
    )
