"""Levels of the tests, and tolerances of numbers, that several modules share."""

from __future__ import annotations

from typing import Final

OFTEN: Final = 0.05
"""Level where an error costs little: in folds, for the upper limit of scatter, ties of a mistake, and a lone name.

The simulated tail of a threshold begins here, too.
"""
BY_CHANCE: Final = 0.01
"""Level of a single conclusion: chance explains what has a p-value of at least this."""
HARDLY_EVER: Final = 1e-4
"""Level where a conclusion would change the record or overrule the noise of the bench file."""
FOLDS: Final = 5
"""Parts into which readings are split if neither passes nor visits divide them: four fifths remain for the fit."""
LEAST_FREEDOM: Final = 3
"""Least number of readings, or of repeated settings, beyond what is fitted to them that shows their scatter."""
FEW: Final = 1 / 8
"""Largest fraction of readings, or of runs, that may be exceptions: more of them are the rule."""
MOSTLY: Final = 0.5
"""Least fraction of a gap, a square, or a prior's u that counts as most of it."""
NEGLIGIBLE: Final = 1e-12
"""Relative size of a number that is rounding only: some thousand times the precision of a number."""
FAR: Final = 6.0
"""Least deviation, in units of its u, that is reported by itself: noise alone gives it in 2 of 1e9 readings."""
ONE_DIRECTION: Final = 0.01
"""Angle, rad, below which directions of one mounting, or stops of the head, are the same.

Angles set by hand scatter by tenths of a degree. A smaller turn of the block changes no signature.
"""
UNSEEN: Final = 0.3
"""Change of the readings, in units of noise, below which it may be neglected: it changes ln of odds by 0.05."""
ALIKE: Final = 1e-3
"""Two signatures count as the same if one leaves at most this fraction of the other's square unexplained.

Of 30 units of noise, one unit is then left.
"""
INSEPARABLE: Final = 1e-6
"""Fraction of a square, or of the largest singular value, that readings cannot distinguish from 0.

Of 1,000 units of noise, one unit is then left.
"""
BEYOND_BELIEF: Final = 60.0
"""No effect has this many plausible sizes: what would need them is no alias, and what only then shows is hidden.

They are three sigma of the widest prior (`evidence.SIZES`).
"""
STEPS: Final = 8
"""Most rounds of a repeated linearisation, fit or correction; six or twelve give the same to 2e-6."""
LISTED: Final = 8
"""Entries of a list in a result, at most: what a reader surveys."""
LISTED_IN_SENTENCE: Final = 4
"""Entries that one sentence lists, at most: it is to stay one sentence."""
