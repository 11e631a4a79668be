"""Levels of the tests, and tolerances of numbers, that several modules share."""

from __future__ import annotations

from typing import Final

OFTEN: Final = 0.05
"""Level where a false alarm costs little: in folds, for the upper limit of scatter, and for ties of a mistake."""
BY_CHANCE: Final = 0.01
"""Level of a single conclusion: chance explains what has a p-value of at least this."""
HARDLY_EVER: Final = 1e-4
"""Level where a conclusion would change the record or overrule the noise of the bench file."""
FOLDS: Final = 5
"""Number of parts into which readings are split if neither passes nor visits divide them."""
LEAST_FREEDOM: Final = 3
"""Least number of readings, or of repeated settings, beyond what is fitted to them that shows their scatter."""
FEW: Final = 1 / 8
"""Largest fraction of readings, or of runs, that may be exceptions: more of them are the rule."""
MOSTLY: Final = 0.5
"""Least fraction of a gap, a square, or a prior's u that counts as most of it."""
NEGLIGIBLE: Final = 1e-12
"""Relative size of a number that is rounding only."""
FAR: Final = 6.0
"""Least deviation, in units of its u, that is reported by itself."""
ONE_DIRECTION: Final = 0.01
"""Angle, rad, below which directions of one mounting, or stops of the head, are the same.

Angles set by hand scatter by tenths of a degree. A smaller turn of the block changes no signature.
"""
UNSEEN: Final = 0.3
"""Change of the readings, in units of noise, below which it may be neglected."""
ALIKE: Final = 1e-3
"""Two signatures count as the same if one leaves at most this fraction of the other's square unexplained."""
INSEPARABLE: Final = 1e-6
"""Fraction of a square, or of the largest singular value, that readings cannot distinguish from 0."""
BEYOND_BELIEF: Final = 60.0
"""No effect has this many plausible sizes: what would need them is no alias, and what only then shows is hidden."""
STEPS: Final = 8
"""Most rounds of a repeated linearisation, fit or correction; nearly all have settled by then."""
LISTED: Final = 8
"""Entries of a list in a result, at most."""
LISTED_IN_SENTENCE: Final = 4
"""Entries that one sentence lists, at most."""
