"""Estimation of the coefficients with their uncertainty, and the check at the verification points.

The check is in `bench.calibration.verification`.
"""

from bench.calibration.calibrate import calibrate
from bench.calibration.estimators import ESTIMATORS
from bench.calibration.mistakes import implausible
from bench.calibration.result import Calibration, CalibrationError, Estimate, LackOfFit, Noise, Outlier

__all__ = [
    "ESTIMATORS",
    "Calibration",
    "CalibrationError",
    "Estimate",
    "LackOfFit",
    "Noise",
    "Outlier",
    "calibrate",
    "implausible",
]
