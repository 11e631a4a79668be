"""Whether `bench fleet cmc` finds the scatter of a laboratory whose units drift, on drawn values.

    python -m benchmarks.capability_honesty --runs 20 --seed 1

Laboratories of units that are calibrated about once a year on benches by chance, with u = 1: units differ by 5, go
along lines of their own and walk, benches differ by 0.5, calibrations scatter by more than stated. The twelve
coefficients of each laboratory are independent. The table has the share of limits of 95 % that hold the truth with
Wilson's interval of 95 %, the mean of the scatter found, and what it is where drifts are left in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.history.capability import YEAR, capability
from bench.history.measured import ComparedCalibrations
from bench.stats.crossed_effects import EXCESS, Crossing, fit
from bench.stats.unit_histories import CalibrationSpread
from benchmarks.campaign import Share, arguments

CASES = (
    (30, 5, 3, (1.0, 0.0, 0.0, 0.5)), (30, 5, 3, (0.0, 0.0, 0.0, 0.5)), (30, 5, 3, (1.0, 2.0, 0.0, 0.5)),
    (30, 5, 3, (1.0, 0.0, 2.0, 0.5)), (30, 5, 3, (0.0, 2.0, 1.0, 0.5)), (12, 4, 2, (1.0, 0.5, 0.0, 0.5)),
)  # fmt: skip
"""Units, runs of each, benches, and sizes of scatter, rates in a year, walks in a year, benches."""


def laboratory(
    rng: np.random.Generator, units: int, runs: int, benches: int, sizes: Sequence[float]
) -> ComparedCalibrations:
    """Draw calibrations of u = 1 of all twelve coefficients, with sizes of scatter, rates, walks and benches."""
    scatter, rate, walk, between = sizes
    steps = rng.uniform(0.5, 1.5, (units, runs))
    years = np.cumsum(steps, axis=1)
    bench = rng.integers(0, benches, units * runs)
    level, slope = 5.0 * rng.normal(size=(units, 1, 12)), rate * rng.normal(size=(units, 1, 12))
    walked = walk * np.cumsum(np.sqrt(steps)[..., None] * rng.normal(size=(units, runs, 12)), axis=1)
    true = (level + slope * years[..., None] + walked).reshape(-1, 12)
    n = units * runs
    values = true + between * rng.normal(size=(benches, 12))[bench]
    values = values + scatter * rng.normal(size=(n, 12)) + rng.normal(size=(n, 12))
    return ComparedCalibrations(
        unit=np.repeat([f"A {k}" for k in range(units)], runs), kind=np.full(n, "A"),
        bench=np.array([f"bench {k}" for k in bench]),
        when=np.datetime64("2015-01-01", "s") + (years.ravel() * (YEAR / np.timedelta64(1, "s"))).astype(int),
        vector=values, covariance=np.broadcast_to(np.eye(12), (n, 12, 12)), meters=np.zeros((n, 12)), signal="V",
        simulated=True,
    )  # fmt: skip


def table(runs: int, seed: int) -> Iterator[str]:
    """Yield a table over cases."""
    yield (
        "| units × runs | scatter | rate | walk | lower limit holds | upper limit holds | scatter found | "
        "drift left in | drift taken out |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for units, each, benches, sizes in CASES:
        rng = np.random.default_rng([seed, units, *(int(10 * size) for size in sizes)])
        spreads: list[CalibrationSpread] = []
        before = []
        for _ in range(runs):
            made = laboratory(rng, units, each, benches, sizes)
            spreads += capability(made).spreads
            unit, bench = (np.unique(labels, return_inverse=True)[1] for labels in (made.unit, made.bench))
            crossing = Crossing(unit, bench, np.zeros_like(unit))
            before.append(
                fit(crossing, np.ascontiguousarray(made.vector[:, 0]), made.variance[:, 0]).sizes[EXCESS]
            )
        lower = np.array([one.scatter_least <= sizes[0] for one in spreads])
        upper = np.array([one.scatter_most >= sizes[0] for one in spreads])
        shares = f"{Share.true(lower).percent} | {Share.true(upper).percent}"
        scatter, shown = np.mean([one.scatter for one in spreads]), np.mean([one.shown for one in spreads])
        yield (
            f"| {units} × {each} | {sizes[0]:g} | {sizes[1]:g} | {sizes[2]:g} | {shares} | {scatter:.2f} | "
            f"{np.mean(before):.2f} | {100 * shown:.0f} % |"
        )


def main() -> None:
    """Print the table."""
    given = arguments(__doc__, runs=20, seed=1)
    for line in table(given.runs, given.seed):
        print(line, flush=True)


if __name__ == "__main__":
    main()
