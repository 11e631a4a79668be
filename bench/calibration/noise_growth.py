"""Noise that grows with the signal in a fit with many readings: a test for it, its size, and a note."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats
from bench.calibration.components import READING_GAIN, notes_on_components
from bench.calibration.result import Component

GROWS_P: Final = 0.001
"""P-value below which the noise counts as noise that grows with the signal."""
ROUNDS: Final = 300
"""After so many rounds the growth of a run with some hundred readings changes by less than 1 %."""


def grows(squared: Floats, power: Floats) -> bool:
    """Return whether whitened squared residuals (n, 3) grow with the squared signals `power` (n, 3) without bias.

    The test is that of R. Koenker, J. Econometrics 17 (1981) 107, one-sided; it holds for heavy tails, too.
    """
    about = [one - one.mean(axis=0) for one in (squared, power)]
    size = np.prod([np.linalg.norm(one, axis=0) for one in about], axis=0)
    if not np.all(size > 0):
        return False
    z = np.sqrt(len(squared)) * np.sum(about[0] * about[1], axis=0) / size
    return bool(special.ndtr(-np.sum(z) / np.sqrt(len(z))) < GROWS_P)


def growth_of(squared: Floats, power: Floats, turned: Floats, floor: float) -> float:
    """Return the noise of a channel per signal, divided by its noise at zero signal, which is at least `floor`.

    The squared residuals (n,) have the mean a + b `power` + `turned` (n,), the part from the head's setting error.
    a and b have the largest likelihood for normal residuals. Each round multiplies them by positive factors, so
    that neither turns negative; rounds of weighted regression may alternate between a = 0 and b = 0.
    """
    columns = np.column_stack([np.ones(len(power)), power])
    sizes = np.mean(squared) / np.array([1.0, np.mean(power)])
    for _ in range(ROUNDS):
        sizes[0] = max(sizes[0], floor**2)
        weight = 1.0 / (columns @ sizes + turned)
        sizes = sizes * np.sqrt((squared * weight**2) @ columns / (weight @ columns))
    return float(np.sqrt(sizes[1] / max(sizes[0], floor**2)))


def note_on_growth(sizes: Floats, dof: float) -> tuple[str, ...]:
    """Return the note on noise that grows by `sizes` (3,) of the signal of x, y and z, with `dof`."""
    each = zip(CHANNELS, sizes.tolist(), strict=True)
    return notes_on_components([Component(READING_GAIN, c, size, "1", dof, 0.0) for c, size in each], "")
