"""From readings to coefficients with an uncertainty, and the check at the verification points."""

from bench.analysis.calibration.calibrate import calibrate
from bench.analysis.calibration.estimators import ESTIMATORS
from bench.analysis.calibration.mistakes import implausible
from bench.analysis.calibration.result import (
    Calibration,
    CalibrationError,
    Estimate,
    LackOfFit,
    Noise,
    Outlier,
)
from bench.analysis.calibration.verification import Verification, VerificationPoint, verify

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
