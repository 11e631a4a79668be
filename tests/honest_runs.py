"""Many simulated calibrations with known truth, for the test and the benchmark of honest uncertainties."""

from dataclasses import dataclass

import numpy as np
from paper_bench import STAND_U, TRUTH, simulate

from bench.calibration import calibrate
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2


@dataclass(frozen=True)
class Runs:
    """Errors and stated u of the coefficients (runs, 12) by both estimators; the fit's p and noise sizes."""

    error: np.ndarray
    u: np.ndarray
    error_closed: np.ndarray
    u_closed: np.ndarray
    p: np.ndarray
    reading: np.ndarray
    setting_rad: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Root mean square of error over u, least squares."""
        return rms(self.error / self.u)

    @property
    def z_closed(self) -> np.ndarray:
        """Root mean square of error over u, closed form."""
        return rms(self.error_closed / self.u_closed)

    @property
    def gain(self) -> np.ndarray:
        """How many times smaller the errors of least squares are than those of the closed form."""
        return rms(self.error_closed) / rms(self.error)

    @property
    def paired_t(self) -> np.ndarray:
        """Mean of (closed form's squared error - least squares') over its standard error; negative is worse."""
        difference = self.error_closed**2 - self.error**2
        return difference.mean(axis=0) / (difference.std(axis=0, ddof=1) / np.sqrt(len(difference)))


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square over the runs."""
    return np.sqrt(np.mean(np.square(values), axis=0))


def run(seed: int, numbers: range, noise_v: float, passes: int = 3) -> Runs:
    """Simulate and calibrate the runs of these numbers, noise sizes unknown; run k has the seed [seed, k]."""
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
    rows = []
    for k in numbers:
        readings = simulate(np.random.default_rng([seed, k]), noise_v, passes=passes)
        best = calibrate(readings, model, STAND_U, 9.81)
        closed = calibrate(readings, model, STAND_U, 9.81, "closed-form")
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
