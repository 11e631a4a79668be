"""Estimation of the coefficients with their uncertainty, and the check at the verification points."""

from bench.calibration.calibrate import calibrate
from bench.calibration.estimators import ESTIMATORS
from bench.calibration.mistakes import implausible
from bench.calibration.result import (
    Calibration,
    CalibrationError,
    Estimate,
    LackOfFit,
    Noise,
    Outlier,
)
from bench.calibration.verification import Verification, VerificationPoint, verify

__all__ = [
    "ESTIMATORS",
    "Calibration",
    "CalibrationError",
    "Estimate",
    "LackOfFit",
    "Noise",
    "Outlier",
    "Verification",
    "VerificationPoint",
    "calibrate",
    "implausible",
    "verify",
]
