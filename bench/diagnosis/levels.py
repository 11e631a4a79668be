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
NEGLIGIBLE: Final = 1e-12
"""Relative size of a number that is rounding only."""
FAR: Final = 6.0
"""Distance in u from which a deviation is named for its own sake."""
