"""Three accelerometers that change by the same volts: what they share is nearer than what they are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.analysis.diagnosis.posterior import Posterior

ADDED: Final = ("warm_up", "bias_drift", "thermal_bias", "turn_on_shift")
"""Effects that add to the signals whatever the acceleration is."""
EQUAL: Final = 0.05
"""Probability above which three sizes in volts count as equal,"""
SEEN: Final = 4.0
"""where each is so many standard uncertainties large: three that are hardly there are always equal."""


def common_volts(naming: Naming, fitted: Posterior, linear: LinearSystem) -> Iterator[str]:
    """Yield a sentence for each effect of the three accelerometers that is the same in volts in all of them."""
    # one prior size of each channel's column is the same part of its K_ii
    scale = np.diag(linear.block.K)
    apart = np.diff(np.eye(3), axis=0)
    for found, mine in naming.parts():
        variant = found.variant
        if variant.family not in ADDED or len(variant.columns) != 3 or len(variant.channels) != 3:
            continue
        volts = fitted.amplitudes[mine] * scale
        covariance = fitted.amplitude_covariance[mine, mine] * np.outer(scale, scale)
        between = apart @ volts
        chi2 = float(between @ np.linalg.solve(apart @ covariance @ apart.T, between))
        seen = np.all(np.abs(volts) > SEEN * np.sqrt(np.diag(covariance)))
        if seen and special.chdtrc(2, chi2) > EQUAL:
            yield (
                f"{variant.family} is the same voltage in all three channels within its u: that points at what "
                "they share (the voltmeters' zero, the supply, the wiring), not at three accelerometers; a shorted "
                "input in each pass tells"
            )
