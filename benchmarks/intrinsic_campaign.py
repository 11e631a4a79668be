"""Test the stated uncertainties of the nine intrinsic numbers on simulated runs with known truth.

    python -m benchmarks.intrinsic_campaign --runs 1000
    python -m benchmarks.intrinsic_campaign --runs 0 --pairs 300
    python -m benchmarks.intrinsic_campaign --runs 0 --pairs 2000 --turned

Each run is the paper's procedure on a stand with angles drawn from its bench file (the limits of the paper as
three sigma, the third mounting angle with the limit of the second), with the noise of a voltmeter; geometry
and truth are those of tests/support. In half of the runs the block is turned by 0 to 2 degrees about a random
axis, equally in both installations: its twelve coefficients change, its nine intrinsic numbers do not. u is
that of the readings and the stand, which covers all drawn errors. For each of the nine, in the turned and in
the other runs, the campaign prints the root mean square of (estimate - truth)/u, and coverage of k = 2
(promised: 0.93 to 0.97, within binomial limits of 99.9 %). It also prints how often the joint 95 % ellipsoid
contains all nine, and all twelve (promised: at least 0.93), and the change of the twelve coefficients by the
turns.

The second command tests power. Each pair is two calibrations of one block by the same meters, with every
error of a bench drawn, including the rolls of both mountings; with `--case roll`, stand, noise and roll only.
Each of the nine in turn changes by 6 u of the difference of the pair. With `--turned`, each calibration is of
the block turned as above. Promised: the joint test of the nine finds 98 % of the changes, and says of at most
6.5 % of the unchanged pairs that they differ (upper limit of 99 %). The command also prints the shares that
the twelve coefficients find, jointly and by any of them alone (Holm); their u includes the roll of both
mountings. The exit status is 1 if a promise is broken.
"""

import sys
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Final

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.calibration.intrinsic import INTRINSIC, intrinsic, joint_factor, least_dof
from bench.calibration.result import Calibration, Derived
from bench.history.comparison import CHANGED_P, Snapshot, compare
from bench.model import Block
from bench.validation.paper_bench import U0, K
from benchmarks.campaign import arguments, finish, parts_of, rms
from benchmarks.signed_uncertainty import own
from tests.support.whole_truth import Bench, simulate_whole
from tests.support.whole_truth import turned as turned_by

TRUE: Final = intrinsic(Block(K, U0), np.eye(12)).values
LEAST, MOST = 0.93, 0.97
CHANGE, FOUND = 6.0, 0.98
"""Size of a change, in u of the difference of a pair, and the promised share of such changes found."""
MOST_FALSE: Final = 0.065
TODAY: Final = datetime(2026, 1, 1, tzinfo=UTC)


def nine_of(rng: np.random.Generator, change: Floats | None = None) -> tuple[Calibration, Derived, Floats]:
    """Calibrate a drawn run of the paper's procedure; return its result, the nine, and the true twelve."""
    bench, drawn = own("roll"), simulate_whole(rng, "roll", change=change)
    found = calibrate(drawn.readings, bench.model, bench.stand_u, 9.81, assumed_u=bench.assumed)
    return found, intrinsic(found.block, found.covariance), drawn.truth


def run(seed: int, turned: bool, numbers: range) -> tuple[Floats, Floats, Floats, Floats]:
    """Return errors and u of the nine (runs, 9), joint distances / k (runs, 2), changes (runs, 12)."""
    rows = []
    for k in numbers:
        rng = np.random.default_rng([seed, int(turned), k])
        change = turn(rng) if turned else np.zeros(12)
        found, nine, truth = nine_of(rng, change)
        error = nine.values - TRUE
        off = (error, nine.covariance), (found.block.vector - truth, found.covariance)
        dof = found.noise.reading_dof
        apart = [np.sqrt(e @ np.linalg.solve(c, e)) / joint_factor(len(e), dof).k for e, c in off]
        rows.append((error, nine.u, np.array(apart), change))
    errors, u, joint, moved = (np.array(column) for column in zip(*rows, strict=True))
    return errors, u, joint, moved


def show(what: str, parts: list[tuple[Floats, ...]], runs: int) -> list[str]:
    """Print the statistics of the runs; return the broken promises."""
    error, u, joint, moved = (np.concatenate(column) for column in zip(*parts, strict=True))
    covered = np.mean(np.abs(error) <= 2 * u, axis=0)
    inside = np.mean(joint <= 1.0, axis=0)
    print(f"\n{what}: {runs} runs; the twelve are moved by up to {np.max(np.abs(moved)):.3g} V/g")
    for name, z, part in zip(INTRINSIC, rms(error / u), covered, strict=True):
        print(f"  {name:10} z {z:.3f}  coverage {part:.3f}")
    print(f"  jointly: all nine {inside[0]:.3f}, all twelve {inside[1]:.3f}")
    low, high = (stats.binom.ppf(p, runs, edge) / runs for p, edge in ((0.001, LEAST), (0.999, MOST)))
    broken = [
        f"{what}: coverage of {name} is {part:.3f}"
        for name, part in zip(INTRINSIC, covered, strict=True)
        if not low <= part <= high
    ]
    return broken + [f"{what}: jointly {part:.3f}" for part in inside if part < low]


def turn(rng: np.random.Generator) -> Floats:
    """Return the change of the coefficients if the block is turned by 0 to 2 degrees in both installations."""
    return np.concatenate([(K @ turned_by(rng, np.radians(2.0)) - K).ravel(), np.zeros(3)])


def snapshot_of_run(found: Calibration, name: str) -> Snapshot:
    """Return a calibration as a snapshot for `compare`, made by the meters of block 1."""
    return Snapshot(
        name, TODAY, "block 1", found.unit, found.g_m_s2, found.block.vector, found.covariance,
        same_meters=found.covariance_same_meters, meters=("1", "2", "3"), block_terms=found.block_terms,
        wander=found.wander, dof=least_dof(found),
    )  # fmt: skip


def pairs(seed: int, case: str, numbers: range, *, turned: bool = False) -> Floats:
    """Return which changes were found (pairs, 10, 3): of each of the nine numbers, and of none.

    The last axis is: found by the nine jointly, by the twelve jointly, by any of the twelve.
    """
    calibrator = own(case)
    rows: list[list[tuple[bool, ...]]] = []
    along = np.linalg.pinv(intrinsic(Block(K, U0), np.eye(12)).jacobian)
    for number in numbers:
        bench = Bench.drawn(np.random.default_rng([seed, number]), case)
        draws = (np.random.default_rng([seed, number, k]) for k in (1, 2))
        runs = [
            calibrator.of(
                simulate_whole(rng, case, bench, change=turn(rng) if turned else np.zeros(12)).readings
            )
            for rng in draws
        ]
        first, second = map(snapshot_of_run, runs, "ab")
        u = compare([first, second]).nine.changes[0].u
        changes = [along[:, j] * CHANGE * u[j] for j in range(len(INTRINSIC))]
        rows.append([])
        for change in (*changes, np.zeros(12)):
            seen = compare([first, replace(second, vector=second.vector + change)])
            by_twelve = [(t.p_constant < CHANGED_P, bool(t.shown)) for t in (seen.twelve,) if t]
            rows[-1].append((seen.changed, *by_twelve[0]))
    return np.array(rows, dtype=np.float64)


def show_pairs(parts: list[Floats]) -> list[str]:
    """Print the share of changes found, for each changed number; return the broken promises."""
    found = np.concatenate(parts)
    shares = found.mean(axis=0)
    print(
        f"\n{len(found)} pairs, a change of {CHANGE:g} u of the difference in each: found by the nine jointly,"
    )
    print("by the twelve jointly, by any of the twelve (Holm)")
    for name, (nine, twelve, single) in zip((*INTRINSIC, "none"), shares, strict=True):
        print(f"  {name:10} {nine:.3f}  {twelve:.3f}  {single:.3f}")
    least = stats.binom.ppf(0.001, len(found), FOUND) / len(found)
    differ = float(found[:, -1, 0].sum())
    upper = stats.beta.ppf(0.99, differ + 1, len(found) - differ)
    return (
        [f"unchanged pairs differ in {upper:.3f}"] if upper > MOST_FALSE and len(found) >= 1000 else []
    ) + [
        f"changes of {name} are found in {share:.3f}"
        for name, share in zip(INTRINSIC, shares[:-1, 0], strict=True)
        if share < least
    ]


def main() -> int:
    given = arguments(__doc__, runs=1000, pairs=0, case="all", turned=False, workers=2, seed=1)
    broken: list[str] = []
    if given.pairs:
        work = partial(pairs, given.seed, given.case, turned=given.turned)
        broken += show_pairs(parts_of(work, given.pairs, given.workers))
    for turned, what in (
        (
            (True, "common turns of 0 to 2 degrees"),
            (False, "independent angles of the stand"),
        )
        if given.runs
        else ()
    ):
        broken += show(
            what, parts_of(partial(run, given.seed, turned), given.runs, given.workers), given.runs
        )
    return finish(broken, "every promise holds")


if __name__ == "__main__":
    sys.exit(main())
