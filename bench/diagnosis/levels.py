"""Levels of the tests, and tolerances of numbers, that several modules share."""

from __future__ import annotations

from typing import Final

OFTEN: Final = 0.05
"""Level where a false alarm costs little: in folds, for scatter as an upper limit, for ties of a mistake."""
BY_CHANCE: Final = 0.01
"""Level of a single conclusion: a p-value from this on is chance."""
HARDLY_EVER: Final = 1e-4
"""Level where a conclusion would change the record or set the noise of the bench file aside."""
FOLDS: Final = 5
"""Parts into which readings are split where neither passes nor visits divide them."""
MOSTLY: Final = 0.5
"""Least part of a gap, of a square, or of a prior's u that counts as most of it."""
NEGLIGIBLE: Final = 1e-12
"""Relative size of a number that is rounding only."""
FAR: Final = 6.0
"""Distance in u from which a deviation is named for its own sake."""
UNSEEN: Final = 0.3
"""Change of the readings, in units of noise, below which it may be neglected."""
ALIKE: Final = 1e-3
"""Part of a signature's square that another may leave and still count as the same."""
INSEPARABLE: Final = 1e-6
"""Part of a square, or of the largest singular value, that the readings cannot separate from nothing."""
LEAST_GAIN: Final = 0.5
"""Increase of ln of the odds from which another hypothesis or a further measurement is worth its trouble."""
STEPS: Final = 6
"""Most linearisations of a fit; what is nonlinear beyond them stays in the residuals."""
LISTED: Final = 8
"""Entries of a list in a result, at most."""
LISTED_IN_SENTENCE: Final = 4
"""Entries that one sentence lists, at most."""
