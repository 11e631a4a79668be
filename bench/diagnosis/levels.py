"""Levels of the tests, and tolerances of numbers, that several modules share."""

from __future__ import annotations

from typing import Final

OFTEN: Final = 0.05
"""Level of tests whose errors cost little.

It serves tests in folds, upper limits of scatter, ties of a mistake, and single names. The tail of a
simulated threshold begins at this probability, too.
"""
BY_CHANCE: Final = 0.01
"""Level of a single conclusion: a p-value of at least this is attributed to chance."""
HARDLY_EVER: Final = 1e-4
"""Level of a conclusion that would change the record or replace the noise stated in the bench file."""
FOLDS: Final = 5
"""Number of parts into which readings are split that have no passes or visits; the fit uses four of five."""
LEAST_FREEDOM: Final = 3
"""Least degrees of freedom, of readings or repeated settings, from which their scatter is estimated."""
FEW: Final = 1 / 8
"""Largest fraction of readings, or of runs, that may be exceptions."""
MOSTLY: Final = 0.5
"""Least fraction that counts as most of a gap, of a square, or of a prior's u."""
NEGLIGIBLE: Final = 1e-12
"""Relative size below which a number is only rounding: some thousand times the precision of a float."""
CLEARLY_LARGER: Final = 2.0
"""Least ratio of two sizes, or of two time constants, lags or widths, that counts as a clear difference.

For coefficients of two sensors, it is that of their difference to the largest change of one block (`OTHER_BLOCK`).
In nine records of each of four real sensors, this ratio is at most 1.0 for one sensor, and at least 2.2 for two.
"""
FAR: Final = 6.0
"""Least deviation of a reading, in units of its u, that is reported: noise gives it in 2 of 1e9 readings."""
ONE_DIRECTION: Final = 0.01
"""Angle, rad, below which directions of one mounting, or stops of the head, are the same.

Angles set by hand scatter by tenths of a degree. A smaller turn of the block changes no signature.
"""
MARK_DEG: Final = 5.0
"""Distance, deg, of the marks of a dividing head: angles that round to the same mark are repeats.

Angles set by hand scatter by less than half of it.
"""
UNSEEN: Final = 0.3
"""Change of the readings, in units of noise, that may be neglected: it changes ln of odds by 0.05."""
ALIKE: Final = 1e-3
"""Two signatures count as the same if one leaves at most this fraction of the other's square unexplained.

Of a signature of 30 units of noise, one unit is then left.
"""
INSEPARABLE: Final = 1e-6
"""Fraction of a square, or of the largest singular value, that readings cannot distinguish from 0.

Of a signature of 1,000 units of noise, one unit is then left.
"""
FARTHEST: Final = 3.0
"""Largest credible value, in standard deviations of its prior: a normal number exceeds it in 0.3 % of cases."""
STEPS: Final = 8
"""Largest number of rounds of a repeated linearisation, fit, correction or zoom; six or twelve agree to 2e-6."""
CHUNK: Final = 32
"""Number of data sets, settings or suppositions computed at once: more would leave the processor's cache."""
