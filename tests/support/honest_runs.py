"""Many simulated calibrations with known truth, for the test and the benchmark of honest uncertainties."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from bench.base.arrays import Floats
from bench.calibration import Calibration, CalibrationError, calibrate
from bench.calibration.result import COVERAGE_FACTOR, NoisePrior
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import (
    ARCSEC,
    SETTING_U_RAD,
    STAND_U,
    TRUTH,
    U0,
    K,
    design,
    simulate,
    specific_force,
)
from tests.support.whole_truth import simulate_whole

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
ROLL_U = 30 * ARCSEC
STATED = STAND_U | {"setting_error": SETTING_U_RAD, "voltmeter_error": 1e-4}
FEW = {
    "2+2": ((0, 90), (0, 90)),
    "3+2": ((0, 90, 180), (0, 90)),
    "3+3": ((0, 90, 180), (0, 90, 180)),
    "4+2": ((0, 90, 180, 270), (0, 90)),
}
"""Head angles in installations 1 and 2, degrees, of designs that leave the noise hardly a degree of freedom."""
STAND_WITH_ROLL = STAND_U | {"mounting_roll": ROLL_U}


@dataclass(frozen=True)
class Runs:
    """Errors and u of the coefficients (runs, 12) by least squares and by the closed form (`…_closed`).

    `p` is the fit's p-value; `reading` and `setting_rad` are its noise sizes.
    """

    error: Floats
    u: Floats
    error_closed: Floats
    u_closed: Floats
    p: Floats
    reading: Floats
    setting_rad: Floats

    @property
    def z(self) -> Floats:
        """The rms of error/u of least squares, (12,)."""
        return rms(self.error / self.u)

    @property
    def z_closed(self) -> Floats:
        """The rms of error/u of the closed form, (12,)."""
        return rms(self.error_closed / self.u_closed)

    @property
    def gain(self) -> Floats:
        """The rms error of the closed form divided by that of least squares, (12,)."""
        return rms(self.error_closed) / rms(self.error)

    @property
    def paired_t(self) -> Floats:
        """Paired t of squared errors, closed form minus least squares; below 0 if least squares is worse."""
        difference = self.error_closed**2 - self.error**2
        spread = difference.std(axis=0, ddof=1) / np.sqrt(len(difference))
        return np.asarray(difference.mean(axis=0) / spread)


def rms(values: Floats) -> Floats:
    """Return the root mean square over the runs, the first axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def run(seed: int, numbers: range, noise_v: float, passes: int = 3) -> Runs:
    """Simulate and calibrate runs with unknown noise sizes; run k of `numbers` has the seed [seed, k]."""
    rows = []
    for k in numbers:
        readings = simulate(np.random.default_rng([seed, k]), noise_v, passes=passes)
        best = calibrate(readings, MODEL, STAND_U, 9.81)
        closed = calibrate(readings, MODEL, STAND_U, 9.81, "closed-form")
        rows.append(
            (
                best.block.vector - TRUTH,
                best.u,
                closed.block.vector - TRUTH,
                closed.u,
                best.lack_of_fit.p,
                best.noise.reading,
                best.noise.setting_rad,
            )
        )
    return Runs(*(np.array(column) for column in zip(*rows, strict=True)))


@dataclass(frozen=True)
class FewRuns:
    """Errors and u of the readings (runs, 12) of runs with few readings, and what the program said of them.

    `refused` are messages of refused runs. `rests` (runs,) says whether a note states that u depends on the
    bench file; `disagrees` (runs,), whether the note states that the readings disagree with this file.
    """

    error: Floats
    u: Floats
    refused: tuple[str, ...]
    rests: Floats
    disagrees: Floats

    @property
    def covered(self) -> Floats:
        """The fraction of intervals ± k u that contain the truth, for each coefficient."""
        return np.asarray(np.mean(np.abs(self.error) <= COVERAGE_FACTOR * self.u, axis=0))


def run_few(seed: int, numbers: range, design: str, times: float | None = None) -> FewRuns:
    """Simulate and calibrate runs of a design of `FEW` with stated noise sizes; run k has the seed [seed, k].

    The true sizes of the noise are `times` the stated ones. With None, their variances are drawn from the
    prior that the program states: scaled inverse chi-square.
    """
    rows, refused = [], []
    for k in numbers:
        rng = np.random.default_rng([seed, k])
        noise_v, setting_rad = STATED["voltmeter_error"], SETTING_U_RAD
        if times is None:
            prior = _prior_of(design)
            noise_v, setting_rad = np.array([prior.reading, prior.setting_rad]) * np.sqrt(
                prior.dof / rng.chisquare(prior.dof, 2)
            )
        else:
            noise_v, setting_rad = times * noise_v, times * setting_rad
        try:
            found = calibrate(simulate_few(rng, design, noise_v, setting_rad), MODEL, STATED, 9.81)
        except CalibrationError as refusal:
            refused.append(str(refusal))
            continue
        said = [
            note for note in found.notes if "u rests on the sizes of the noise that the bench file" in note
        ]
        doubted = any("disagree" in note for note in said)
        rows.append((found.block.vector - TRUTH, found.u_readings, bool(said), doubted))
    error, u, rests, disagrees = (np.array(column) for column in zip(*rows, strict=True))
    return FewRuns(error, u, tuple(refused), rests, disagrees)


def components_taken(seed: int, numbers: range, case: str) -> int:
    """Count the runs of a `simulate_whole` case whose calibration includes a shared error component."""
    runs = (simulate_whole(np.random.default_rng([seed, k]), case).readings for k in numbers)
    return sum(len(calibrate(run, MODEL, STAND_U, 9.81).shared) > 0 for run in runs)


@cache
def _prior_of(design: str) -> NoisePrior:
    """Return the noise prior that the program states for each run of the design."""
    prior = calibrate(simulate_few(None, design), MODEL, STATED, 9.81).noise.prior
    assert prior is not None
    return prior


def simulate_few(
    rng: np.random.Generator | None, design: str, noise_v: float = 0.0, setting_rad: float = 0.0
) -> Readings:
    """Simulate a run of a design of `FEW`, with stand errors per installation; without `rng` no errors."""
    angles = dict(zip("12", FEW[design], strict=True))
    installation = [i for i, own in angles.items() for _ in own]
    point = [p for own in angles.values() for p in range(1, len(own) + 1)]
    phi = np.radians(np.concatenate(list(angles.values())))
    n = len(phi)
    stand, setting, noise = np.zeros((2, 3)), np.zeros(n), np.zeros((n, 3))
    if rng is not None:
        stand = rng.normal(0.0, list(STAND_U.values()), (2, 3))
        setting, noise = rng.normal(0.0, setting_rad, n), rng.normal(0.0, noise_v, (n, 3))
    alpha1, alpha2, alpha3 = stand[[int(i) - 1 for i in installation]].T
    force = specific_force(installation, phi, alpha1, alpha2, alpha3, setting)
    return make_readings(installation, [1] * n, point, phi, force @ K.T + U0 + noise)


def free_forces(count: int, rng: np.random.Generator) -> Floats:
    """Return random directions (count, 3), uniform on the sphere: the specific force in free positions, g."""
    directions = rng.normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def with_free(readings: Readings, forces: Floats, noise: Floats | float) -> Readings:
    """Return the readings with further rows F, in which the paper's block (11) feels `forces` (m, 3), g."""
    count = len(forces)
    return make_readings(
        [*readings.installation.tolist(), *["F"] * count],
        [*readings.pass_number.tolist(), *[1] * count],
        [*readings.point.tolist(), *range(1, count + 1)],
        np.concatenate([readings.angle_rad, np.full(count, np.nan)]),
        np.concatenate([readings.signal, forces @ K.T + U0 + noise]),
    )


def simulate_with_roll(rng: np.random.Generator, noise_v: float, passes: int, count: int) -> Readings:
    """Simulate the paper's procedure with a roll (third mounting angle) per installation, and positions F."""
    installation, pass_number, point, phi = design(passes)
    at = np.array([int(i) - 1 for i in installation])
    sizes = [*STAND_U.values(), ROLL_U]
    alpha1, alpha2, alpha3, alpha5 = rng.normal(0.0, sizes, (2, 4))[at].T
    setting = rng.normal(0.0, SETTING_U_RAD, len(phi))
    force = specific_force(installation, phi, alpha1, alpha2, alpha3, setting, alpha5)
    signal = force @ K.T + U0 + rng.normal(0.0, noise_v, (len(phi), 3))
    readings = make_readings(installation, pass_number, point, phi, signal)
    return with_free(readings, free_forces(count, rng), rng.normal(0.0, noise_v, (count, 3)))


def run_joined(seed: int, numbers: range, noise_v: float, passes: int = 3, count: int = 8) -> Floats:
    """Return (estimate - truth)/u (runs, 12) of runs with free positions; run k has the seed [seed, k]."""
    results: list[Calibration] = [
        calibrate(
            simulate_with_roll(np.random.default_rng([seed, k]), noise_v, passes, count),
            MODEL,
            STAND_WITH_ROLL,
            9.81,
        )
        for k in numbers
    ]
    return np.array([(r.block.vector - TRUTH) / r.u for r in results])
