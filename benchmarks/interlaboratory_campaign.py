"""Test the promises of the interlaboratory kit: five laboratories, one of them wrong.

    python -m benchmarks.interlaboratory_campaign --runs 200

In each round, five laboratories calibrate one block by the paper's procedure, each on a stand with angles
drawn from the bench file, and with the noise of its voltmeters; geometry and truth are those of
tests/support. In one of the laboratories, one of the nine intrinsic numbers is wrong by 6 times the u of its
difference from the others' consensus. Each laboratory is judged against the others (Mandel-Paule, Holm). The
first is the pilot, which measures again after every two others.

Promised: the wrong laboratory is found in 95 % of the rounds, and a right one accused in at most 5 %. In a
second case, all laboratories are right, and any is accused in at most 5 %. In a third case, all are right,
but one number of the block steps between the second and the third laboratory, by 6 times the u of the
difference of two pilot calibrations. The pilot's returns show the step in 95 % of the rounds; with the
block's scatter in u, any laboratory is accused in at most 5 %. The share without the scatter is printed, too.
Each limit has a binomial margin of 99.9 %. The exit status is 1 if a limit is broken.
"""

import sys
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration.intrinsic import INTRINSIC
from bench.history.equivalence import Drift, LaboratoryJudged, against_others, transport_dark
from bench.results.interlaboratory import CHANGED_P
from bench.stats import holm
from benchmarks.campaign import arguments, finish, parts_of
from benchmarks.intrinsic_campaign import nine_of

LABORATORIES: Final = 5
OFF: Final = 6.0
"""Error of the wrong laboratory, in u of its difference from the consensus of the others."""
FOUND, ACCUSED = 0.95, 0.05


RETURNS: Final = 2


def round_of(seed: int, number: int) -> tuple[Floats, Floats]:
    """Return a block's nine numbers (stops, 9), covariances (stops, 9, 9); the pilot's returns are last."""
    stops = (np.random.default_rng([seed, number, k]) for k in range(LABORATORIES + RETURNS))
    nines = [nine_of(rng)[1] for rng in stops]
    return np.array([nine.values for nine in nines]), np.array([nine.covariance for nine in nines])


def judged(values: Floats, covariances: Floats) -> tuple[list[LaboratoryJudged], list[Drift]]:
    """Return the verdict on each laboratory, and the changes of the block that the pilot's returns show."""
    pilot = [0, *range(LABORATORIES, len(values))]
    drifts = [
        Drift(INTRINSIC, values[later] - values[first], covariances[first] + covariances[later])
        for first, later in pairwise(pilot)
    ]
    of = slice(LABORATORIES)
    return list(against_others(values[of], covariances[of], transport_dark(drifts, INTRINSIC))), drifts


def rounds(seed: int, numbers: range) -> tuple[list[bool], ...]:
    """Return, for each round, the six facts of which `main` prints the shares."""
    told: list[tuple[bool, ...]] = []
    for number in numbers:
        values, covariances = round_of(seed, number)
        before, _ = judged(values, covariances)
        rng = np.random.default_rng([seed, number])
        wrong, which = int(rng.integers(LABORATORIES)), int(rng.integers(len(INTRINSIC)))
        sign, off, moved = rng.choice([-1.0, 1.0]), values.copy(), values.copy()
        # a wrong pilot is wrong at its returns, too
        its = [wrong] if wrong else [0, *range(LABORATORIES, len(values))]
        off[its, which] += OFF * sign * before[wrong].u[which]
        one = [one.off for one in judged(off, covariances)[0]]
        # the route is 0 1 2 (0) 3 4 (0): the block changes before the pilot's first return
        step = OFF * sign * np.sqrt((covariances[0] + covariances[LABORATORIES])[which, which])
        moved[[2, 3, 4, *range(LABORATORIES, len(values))], which] += step
        after, drifts = judged(moved, covariances)
        changed = holm(np.array([drift.p for drift in drifts])) < CHANGED_P
        plain = against_others(moved[:LABORATORIES], covariances[:LABORATORIES])
        told.append((
            one.pop(wrong), any(one), any(one.off for one in before), bool(changed[0]),
            any(one.off for one in after), any(one.off for one in plain),
        ))  # fmt: skip
    return tuple(list(column) for column in zip(*told, strict=True))


def main(given: list[str] | None = None) -> int:
    asked = arguments(__doc__, given, runs=200, workers=2, seed=1)
    parts = parts_of(partial(rounds, asked.seed), asked.runs, asked.workers)
    found, accused, alone, seen, moved, plain = (np.concatenate(c) for c in zip(*parts, strict=True))
    print(f"{asked.runs} rounds of {LABORATORIES} laboratories, one off by {OFF:g} u of its difference")
    print(f"  the wrong one found: {found.mean():.3f}")
    print(f"  any right one accused: {accused.mean():.3f}")
    print(f"  any accused where none is wrong: {alone.mean():.3f}")
    print(f"the block stepped on its way by {OFF:g} u of two calibrations of the pilot, nobody is wrong")
    print(f"  the step found: {seen.mean():.3f}")
    print(f"  any accused: {moved.mean():.3f}, without the block's scatter in u: {plain.mean():.3f}")
    least = stats.binom.ppf(0.001, asked.runs, FOUND) / asked.runs
    most = stats.binom.ppf(0.999, asked.runs, ACCUSED) / asked.runs
    shares = {"the wrong one": found, "a step of the block": seen}
    broken = [f"{what} is found too seldom" for what, of in shares.items() if of.mean() < least]
    wrongly = {"beside a wrong one": accused, "where none is wrong": alone, "for the block's step": moved}
    broken += [f"right ones are accused too often {why}" for why, of in wrongly.items() if of.mean() > most]
    return finish(broken, "every promise holds")


if __name__ == "__main__":
    sys.exit(main())
