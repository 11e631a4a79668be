"""Simulated runs of the paper's procedure with mistakes and effects, by the paper bench's own geometry."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats
from bench.diagnosis.mistakes.search import MistakeSearch, find_mistakes
from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import ARCSEC, SETTING_U_RAD, STAND_U, U0, K, design, specific_force
from tests.support.diagnosis_bench import MODEL, NOISE_V, PSI

Labels = NDArray[np.str_]
Numbers = NDArray[np.int64]
Added = Callable[[Labels, Numbers, Floats, Floats, Floats], Floats]

NOMINAL = np.array([-2.18, -2.14, -2.14])
ORDERS = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))


def run(
    seed: int,
    *,
    noise_v: float = NOISE_V,
    passes: int = 3,
    off: tuple[int, float] | None = None,
    stand: float = 1.0,
    added: Added | None = None,
    falling: Collection[int] = (),
    known: bool = True,
) -> Readings:
    """Simulate the paper's procedure, with its four verification points at the end.

    `off` (row, rad) is an error of one setting; `stand` multiplies the stand's errors; `added(labels, passes,
    phi, force, slope)` returns an addition to the signals. Passes in `falling` go down, as stated if `known`.
    """
    rng = np.random.default_rng(seed)
    labels, numbers, points, phi = design(passes)
    down = np.isin(numbers, list(falling))
    phi = np.where(down, 2 * np.pi - phi, phi)
    labels, numbers, points = labels + ["V"] * 4, numbers + [1] * 4, [*points, 1, 2, 3, 4]
    phi = np.append(phi, np.radians([45, 135, 225, 315]))
    mount = np.array([{"1": 0, "2": 1, "V": 2}[label] for label in labels])
    sizes = [stand * STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
    alpha = rng.normal(0, sizes, (3, 3))[mount].T
    setting = rng.normal(0, SETTING_U_RAD, len(phi))
    if off is not None:
        setting[off[0]] += off[1]
    psi = [0.0, 0.0, PSI]
    force = np.zeros((len(phi), 3))
    for number in range(3):
        rows = mount == number
        own = [label for label in labels if mount[labels.index(label)] == number]
        a1, a2, a3 = (a[rows] for a in alpha)
        force[rows] = specific_force(own, phi[rows], a1, a2, a3, setting[rows], psi=psi[number])
    signal = force @ K.T + U0 + rng.normal(0, noise_v, (len(phi), 3))
    readings = make_readings(
        labels,
        numbers,
        points,
        phi,
        signal,
        direction=np.append(np.where(down, -1, 1), [1] * 4).tolist() if known else None,
    )
    if added is not None:
        h = 1e-4
        slope = (specific_force(labels, phi + h) - specific_force(labels, phi - h)) @ K.T / (2 * h)
        extra = added(np.array(labels), np.array(numbers), phi, force, slope)
        readings = replace(readings, signal=signal + extra)
    return readings


def find(readings: Readings, **options: Any) -> MistakeSearch:
    return find_mistakes(readings, MODEL, STAND_U, NOMINAL, **options)


def place(
    rng: np.random.Generator, readings: Readings, scope: str
) -> tuple[NDArray[np.bool_], tuple[str, ...], int | None]:
    """Draw a place of this `scope`; return its mask of rows, its installations, and its pass or None."""
    label, number = str(rng.integers(1, 3)), int(rng.integers(1, 4))
    if scope == "run":
        return np.ones(len(readings), dtype=bool), (), None
    own = readings.installation == label
    if scope == "installation":
        return own, (label,), None
    return own & (readings.pass_number == number), (label,), number


def turned_back(readings: Readings, mask: NDArray[np.bool_]) -> Readings:
    return replace(readings, angle_rad=np.where(mask, -readings.angle_rad, readings.angle_rad))


def with_signal(readings: Readings, mask: NDArray[np.bool_], change: Callable[[Floats], Floats]) -> Readings:
    signal = readings.signal.copy()
    signal[mask] = change(signal[mask])
    return replace(readings, signal=signal)


def keys(readings: Readings) -> list[tuple[str, int, int]]:
    return list(
        zip(
            readings.installation.tolist(),
            readings.pass_number.tolist(),
            readings.point.tolist(),
            strict=True,
        )
    )


def outlier_v(readings: Readings, row: int, channel: int, sigma: float, noise_v: float) -> float:
    """Return the shift of one signal, V, by `sigma` standard deviations, at known noise and setting error."""
    h = 1e-5
    label, phi = [str(readings.installation[row])], readings.angle_rad[row : row + 1]
    slope = ((specific_force(label, phi + h) - specific_force(label, phi - h)) @ K.T / (2 * h))[0]
    covariance = noise_v**2 * np.eye(3) + SETTING_U_RAD**2 * np.outer(slope, slope)
    return sigma / float(np.sqrt(np.linalg.inv(covariance)[channel, channel]))


def with_outlier(readings: Readings, row: int, channel: int, shift_v: float) -> Readings:
    signal = readings.signal.copy()
    signal[row, channel] += shift_v
    return replace(readings, signal=signal)


def warm_up(tau_min: float) -> Added:
    def added(_labels: Labels, _numbers: Numbers, phi: Floats, _force: Floats, _slope: Floats) -> Floats:
        minutes = 2.0 * np.arange(len(phi))
        return np.asarray(500e-6 * np.exp(-minutes / tau_min)[:, None] * np.diag(K))

    return added


def square(_labels: Labels, _numbers: Numbers, _phi: Floats, force: Floats, _slope: Floats) -> Floats:
    return 200e-6 * force**2 * np.diag(K) * [1, 0, 1]


def eccentricity(_labels: Labels, _numbers: Numbers, phi: Floats, _force: Floats, slope: Floats) -> Floats:
    return 30 * ARCSEC * np.cos(phi - 1.0)[:, None] * slope


def backlash(_labels: Labels, numbers: Numbers, _phi: Floats, _force: Floats, slope: Floats) -> Floats:
    return 100 * ARCSEC * np.where(numbers == 2, -1, 1)[:, None] * slope


def graduation(_labels: Labels, _numbers: Numbers, phi: Floats, _force: Floats, slope: Floats) -> Floats:
    return np.asarray(30 * ARCSEC * (np.abs(phi - np.radians(135)) < 0.1)[:, None] * slope)


def remounted(labels: Labels, _numbers: Numbers, _phi: Floats, _force: Floats, _slope: Floats) -> Floats:
    return np.asarray(500e-6 * np.diag(K) * (labels == "2")[:, None])


EFFECTS: dict[str, dict[str, Any]] = {
    "quadratic nonlinearity, 200 ug/g2": {"added": square},
    "eccentricity, 30 arcsec": {"added": eccentricity},
    "warm-up of 10 min, 500 ug": {"added": warm_up(10.0)},
    "warm-up of 40 min, 500 ug": {"added": warm_up(40.0)},
    "mounting error, 300 arcsec": {"stand": 10.0},
    "backlash, 200 arcsec": {"added": backlash, "falling": (2,)},
    "backlash, direction not known": {"added": backlash, "falling": (2,), "known": False},
    "one scale mark, 30 arcsec": {"added": graduation},
    "turn-on shift, 500 ug": {"added": remounted},
}
