"""Many simulated calibrations with known truth, for the test and the benchmark of honest uncertainties."""

from dataclasses import dataclass

import numpy as np

from bench.analysis.calibration import Calibration, calibrate
from bench.base.arrays import Floats
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import Readings, make_readings
from tests.support.paper_bench import (
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

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
ROLL_U = 30 * ARCSEC
STAND_WITH_ROLL = STAND_U | {"mounting_roll": ROLL_U}


@dataclass(frozen=True)
class Runs:
    """Errors and stated u of the coefficients (runs, 12) by both estimators; the fit's p and noise sizes."""

    error: Floats
    u: Floats
    error_closed: Floats
    u_closed: Floats
    p: Floats
    reading: Floats
    setting_rad: Floats

    @property
    def z(self) -> Floats:
        """Root mean square of error over u, least squares."""
        return rms(self.error / self.u)

    @property
    def z_closed(self) -> Floats:
        """Root mean square of error over u, closed form."""
        return rms(self.error_closed / self.u_closed)

    @property
    def gain(self) -> Floats:
        """How many times smaller the errors of least squares are than those of the closed form."""
        return rms(self.error_closed) / rms(self.error)

    @property
    def paired_t(self) -> Floats:
        """Mean of (closed form's squared error - least squares') over its standard error; negative is worse."""
        difference = self.error_closed**2 - self.error**2
        spread = difference.std(axis=0, ddof=1) / np.sqrt(len(difference))
        return np.asarray(difference.mean(axis=0) / spread)


def rms(values: Floats) -> Floats:
    """Root mean square over the runs."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def run(seed: int, numbers: range, noise_v: float, passes: int = 3) -> Runs:
    """Simulate and calibrate the runs of these numbers, noise sizes unknown; run k has the seed [seed, k]."""
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


def free_forces(count: int, rng: np.random.Generator) -> Floats:
    """Directions all round, uniform on the sphere, shape (count, 3): the specific force in free positions."""
    directions = rng.normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def with_free(readings: Readings, forces: Floats, noise: Floats | float) -> Readings:
    """The readings with further rows F, in which the block of (11) feels `forces` (m, 3), g."""
    count = len(forces)
    return make_readings(
        [*readings.installation.tolist(), *["F"] * count],
        [*readings.pass_number.tolist(), *[1] * count],
        [*readings.point.tolist(), *range(1, count + 1)],
        np.concatenate([readings.angle_rad, np.full(count, np.nan)]),
        np.concatenate([readings.signal, forces @ K.T + U0 + noise]),
    )


def simulate_with_roll(rng: np.random.Generator, noise_v: float, passes: int, count: int) -> Readings:
    """The paper's procedure with a third mounting angle in each installation, then free positions."""
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
    """(estimate - truth)/u (runs, 12) where free positions join; run k has the seed [seed, k]."""
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


def simulate_many(seed: int, runs: int, noise_v: float) -> Floats:
    """Signals (runs, 54, 3) of as many runs of the paper's procedure, each with stand errors of its own."""
    rng = np.random.default_rng(seed)
    installation, _, _, phi = design()
    at = np.array([int(i) - 1 for i in installation])
    stand = rng.normal(0.0, list(STAND_U.values()), (runs, 2, 3))[:, at].reshape(-1, 3)
    setting = rng.normal(0.0, SETTING_U_RAD, len(stand))
    alpha1, alpha2, alpha3 = stand.T
    force = specific_force(installation * runs, np.tile(phi, runs), alpha1, alpha2, alpha3, setting)
    signal = force @ K.T + U0 + rng.normal(0.0, noise_v, force.shape)
    return np.asarray(signal.reshape(runs, len(phi), 3))
