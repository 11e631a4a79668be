"""The covariance of a specific force that a calibrated block measures."""

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.result import INVERSE, Derived


def specific_force_covariance(derived: Derived, signal: Floats, noise: float = 0.0) -> Floats:
    """Return the covariance (n, 3, 3), g^2, of a = N (U - U0) for signals (n, 3).

    It combines the covariance of `derived`, from `inverse`, and independent `noise` in each signal (1 sigma).
    """
    N, U0 = derived.values[:9].reshape(3, 3), derived.values[9:]
    left = signal - U0
    jacobian = np.zeros((len(signal), 3, len(INVERSE)))
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3] = left
    jacobian[:, :, 9:] = -N
    return np.asarray(jacobian @ derived.covariance @ np.moveaxis(jacobian, 1, 2) + noise**2 * N @ N.T)
