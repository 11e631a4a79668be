"""Runs of the paper's procedure with every error of a bench, one at a time or all together.

Nothing of `bench.model` is used: geometry from bench.validation, every other error defined here. Sizes are
those of the shipped paper-stand file, of the 34401A's data sheet (90 days, 10 V: 20 ppm of reading, 5 ppm of
range) and of a quartz-flexure block (30 ug/K, 180 ppm/K), rectangular; a run of 54 readings and 8
verification points takes five hours.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import ARCSEC, SETTING_U_RAD, STAND_U, U0, K, design, specific_force

PSI = np.radians(45.0)
HOURS = 5.0
VERIFICATION_DEG = np.arange(0.0, 360.0, 45.0)
GAIN, OFFSET_V = 20e-6, 50e-6
LINEARITY_V = 2e-6 * 2.18 + 1e-6 * 10.0
BIAS_PER_K, SCALE_PER_K, BAND_K = 30e-6, 180e-6, 0.5
K2_G, K3_G = 30e-6, 20e-6

CASES = (
    "stand",
    "roll",
    "meters",
    "noise",
    "temperature",
    "walk",
    "setting",
    "all",
    "wandering",
    "all-wandering",
)
"""The temperature of "temperature" and "all" is off by one draw throughout a run, that of the other two wanders."""
WANDERING = ("wandering", "all-wandering")
EVERYTHING = ("all", "all-wandering")


@dataclass
class Bench:
    """Errors that persist from run to run: gain and offset of the meters, K2, K3 and temperature terms."""

    gain: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    bias_per_k: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    scale_per_k: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    curved: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3)))

    @classmethod
    def drawn(cls, rng: np.random.Generator, case: str) -> "Bench":
        """Draw the persistent errors that a case has, within their limits; the others are zero."""
        bench = cls()
        if case in {"meters", *EVERYTHING}:
            bench.gain, bench.offset = rng.uniform(-GAIN, GAIN, 3), rng.uniform(-OFFSET_V, OFFSET_V, 3)
        if case in {"temperature", *WANDERING, *EVERYTHING}:
            bench.bias_per_k = rng.uniform(-BIAS_PER_K, BIAS_PER_K, 3)
            bench.scale_per_k = rng.uniform(-SCALE_PER_K, SCALE_PER_K, 3)
        if case in EVERYTHING:
            bench.curved = rng.normal(0.0, [[K2_G], [K3_G]], (2, 3))
        return bench


@dataclass(frozen=True)
class Drawn:
    """The readings of a run, and its true coefficients (12,), of which U0 is the mean over the run."""

    readings: Readings
    truth: NDArray[np.float64]


def simulate_whole(
    rng: np.random.Generator, case: str, bench: Bench | None = None, noise_v: float = 1e-4,
    change: NDArray[np.float64] | None = None,
) -> Drawn:  # fmt: skip
    """Return a run of a case with its truth; `change` (12,) is added to the block's coefficients."""
    bench = Bench.drawn(rng, case) if bench is None else bench
    installation, pass_number, point, phi = design()
    n, v = len(phi), len(VERIFICATION_DEG)
    sizes = [STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
    drawn = rng.normal(0.0, sizes, (2, 3))
    roll = rng.normal(0.0, 30 * ARCSEC, 2) * (case in {"roll", *EVERYTHING})
    which = np.array([int(i) - 1 for i in installation])
    setting = rng.normal(0.0, SETTING_U_RAD, n)
    oriented = specific_force(
        installation, phi, drawn[which, 0], drawn[which, 1], drawn[which, 2], setting, roll[which]
    )
    checked = specific_force(
        ["1"] * v, np.radians(VERIFICATION_DEG), *_three(rng.normal(0.0, sizes)), psi=PSI
    )
    force = np.concatenate([oriented, checked])
    change = np.zeros(12) if change is None else change
    own_K, own_U0 = K + change[:9].reshape(3, 3), U0 + change[9:]
    diagonal = np.diag(own_K)
    signal = force @ own_K.T + own_U0
    truth = np.concatenate([own_K.ravel(), own_U0])
    signal = signal + diagonal * (bench.curved[0] * force**2 + bench.curved[1] * force**3)
    time_h = np.linspace(0.0, HOURS, n + v)
    if case in {"temperature", *WANDERING, *EVERYTHING}:
        kelvin = np.full(n + v, rng.uniform(-BAND_K, BAND_K))
        if case in WANDERING:
            kelvin = wandering(rng, time_h, BAND_K / np.sqrt(3))
        signal = signal + kelvin[:, None] * (
            diagonal * bench.bias_per_k + (force @ own_K.T) * bench.scale_per_k
        )
    if case in {"walk", *EVERYTHING}:
        size = 200e-6 if case == "walk" else 50e-6
        walk = np.cumsum(rng.normal(0.0, size / np.sqrt(n + v), (n + v, 3)), axis=0)
        signal = signal + walk
        truth[9:] += walk[:n].mean(axis=0)
    fresh = {"noise": np.array([0.3, 1.0, 3.0]), "setting": np.full(3, np.sqrt(0.5))}.get(
        case, np.ones(3)
    ) * noise_v
    signal = signal + rng.normal(0.0, 1.0, signal.shape) * fresh
    if case == "setting":
        signal[:n] += _shared(rng, installation, point, noise_v * np.sqrt(0.5))
    if case in EVERYTHING:
        signal[:n] += _by_voltage(rng, installation, phi)
    signal = signal * (1.0 + bench.gain) + bench.offset
    readings = make_readings(
        [*installation, *["V"] * v], [*pass_number, *[1] * v], [*point, *range(1, v + 1)],
        np.concatenate([phi, np.radians(VERIFICATION_DEG)]), signal, time_s=time_h * 3600.0,
    )  # fmt: skip
    return Drawn(readings, truth)


def turned(rng: np.random.Generator, limit_rad: float) -> NDArray[np.float64]:
    """Return a random rotation matrix: by up to `limit_rad`, about an axis in any direction (Rodrigues)."""
    axis = rng.normal(size=3)
    cross = np.cross(np.eye(3), axis / np.linalg.norm(axis))
    angle = rng.uniform(0.0, limit_rad)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def wandering(rng: np.random.Generator, time_h: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Return a stationary first-order autoregression of this size, with a correlation time of one hour."""
    course = np.empty(len(time_h))
    course[0] = rng.normal(0.0, size)
    for i in range(1, len(time_h)):
        kept = np.exp(-(time_h[i] - time_h[i - 1]))
        course[i] = kept * course[i - 1] + rng.normal(0.0, size * np.sqrt(1.0 - kept**2))
    return course


def _three(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _shared(
    rng: np.random.Generator, installation: list[str], point: list[int], size: float
) -> NDArray[np.float64]:
    """Draw errors (n, 3) that are the same for an installation and point in every pass."""
    own: dict[tuple[str, int], NDArray[np.float64]] = {}
    rows = []
    for key in zip(installation, point, strict=True):
        if key not in own:
            own[key] = rng.normal(0.0, size, 3)
        rows.append(own[key])
    return np.array(rows)


def _by_voltage(
    rng: np.random.Generator, installation: list[str], phi: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Draw linearity errors of the meters (n, 3), rectangular, equal wherever a channel has equal voltage."""
    own: dict[tuple[str, int], NDArray[np.float64]] = {}
    rows = []
    for label, angle in zip(installation, np.degrees(phi), strict=True):
        key = (label, round(float(angle)) % 360)
        if key not in own:
            own[key] = rng.uniform(-LINEARITY_V, LINEARITY_V, 3)
        rows.append(own[key])
    return np.array(rows)
