"""The interlaboratory kit held to its promises: five laboratories, of which one is wrong.

    python -m benchmarks.interlaboratory_campaign --runs 200

In each round five laboratories calibrate one block by the paper's procedure, each on a stand whose angles are
drawn from the bench file, with the noise of its voltmeters; geometry and truth are those of tests/support. In one
of them one of the nine numbers is off by 6 u of its difference from the others' consensus. Each is judged against
the others (Mandel-Paule, Holm). Promised: the wrong one is found in 95 % of the rounds, any right one is accused in
5 % at most; without a wrong one, any is accused in 5 %. Limits are binomial of 99.9 %. Exit status 1 where one is
broken.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Final

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.calibration.intrinsic import INTRINSIC, intrinsic
from bench.history.equivalence import against_others
from benchmarks.campaign import arguments, finish, parts_of
from benchmarks.signed_uncertainty import own
from tests.support.whole_truth import simulate_whole

LABORATORIES: Final = 5
OFF: Final = 6.0
"""Error of the wrong laboratory, in u of its difference."""
FOUND, ACCUSED = 0.95, 0.05


def round_of(seed: int, number: int) -> tuple[Floats, Floats]:
    """Return the nine (laboratories, 9) of one block and their covariances (laboratories, 9, 9)."""
    values, covariances, bench = [], [], own("roll")
    for k in range(LABORATORIES):
        drawn = simulate_whole(np.random.default_rng([seed, number, k]), "roll")
        found = calibrate(drawn.readings, bench.model, bench.stand_u, 9.81, assumed_u=bench.assumed)
        nine = intrinsic(found.block, found.covariance)
        values.append(nine.values)
        covariances.append(nine.covariance)
    return np.array(values), np.array(covariances)


def rounds(seed: int, numbers: range) -> tuple[list[bool], list[bool], list[bool]]:
    """Return of each round whether the wrong laboratory was found, a right one accused, any accused without one."""
    found, accused, alone = [], [], []
    for number in numbers:
        values, covariances = round_of(seed, number)
        before = against_others(values, covariances)
        alone.append(any(one.off for one in before))
        rng = np.random.default_rng([seed, number])
        wrong, which = int(rng.integers(LABORATORIES)), int(rng.integers(len(INTRINSIC)))
        values[wrong, which] += OFF * rng.choice([-1.0, 1.0]) * before[wrong].u[which]
        judged = [one.off for one in against_others(values, covariances)]
        found.append(judged.pop(wrong))
        accused.append(any(judged))
    return found, accused, alone


def main(given: list[str] | None = None) -> int:
    """Run the campaign; return the exit status."""
    asked = arguments(__doc__, given, runs=200, workers=2, seed=1)
    parts = parts_of(partial(rounds, asked.seed), asked.runs, asked.workers)
    found, accused, alone = (np.concatenate(column) for column in zip(*parts, strict=True))
    print(f"{asked.runs} rounds of {LABORATORIES} laboratories, one off by {OFF:g} u of its difference")
    print(f"  the wrong one found: {found.mean():.3f}")
    print(f"  any right one accused: {accused.mean():.3f}")
    print(f"  any accused where none is wrong: {alone.mean():.3f}")
    least = stats.binom.ppf(0.001, asked.runs, FOUND) / asked.runs
    most = stats.binom.ppf(0.999, asked.runs, ACCUSED) / asked.runs
    broken = ["the wrong one is found too seldom"] if found.mean() < least else []
    broken += [
        f"{what} accused too often"
        for what, of in (("right ones", accused), ("nobody", alone))
        if of.mean() > most
    ]
    return finish(broken, "every promise holds")


if __name__ == "__main__":
    sys.exit(main())
