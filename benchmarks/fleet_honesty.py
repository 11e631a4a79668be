"""Test the uncertainties that `bench fleet` states, on simulated calibrations with known truth.

    python -m benchmarks.fleet_honesty prior --runs 200 --seed 1
    python -m benchmarks.fleet_honesty drift --runs 1000 --seed 1
    python -m benchmarks.fleet_honesty crossed --runs 200 --seed 1
    python -m benchmarks.fleet_honesty capability --runs 20 --seed 2

`prior`: m units that differ by 5 u, with correlations, are calibrated once or three times and give the prior
of their type. The calibration of a further unit is combined with this prior. The table shows z of this unit's
coefficients with and without the prior, also as a Mahalanobis distance.

`drift`: histories of n calibrations, about a year apart, of u = 1, with scatter between calibrations and a
random walk of stated sizes. The table shows z of the rate and of the value predicted for a year later.

`crossed`: calibrations of units on several benches. The table shows the true and the estimated standard
deviations of units, benches and excess scatter, with standard errors of the mean; the ratio of the stated u
to the estimated scatter; rms z of the benches' effects.

`capability`: laboratories whose units are calibrated about once a year on random benches, with u = 1. Units
differ by 5, drift along their own lines and walk; benches differ by 0.5; calibrations scatter by more than
stated; the twelve coefficients are independent. The table shows the share of 95 % limits that contain the
truth, and the mean estimated scatter, with and without removal of drift.

Standard errors are given; shares have Wilson's 95 % interval, and coverage is for k = 2.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.history.capability import YEAR, capability
from bench.history.comparison import SECONDS_PER_YEAR
from bench.history.drift import history_drift
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations
from bench.history.prior import join, prior_of
from bench.stats.crossed_effects import EXCESS, Crossing, fit
from bench.stats.unit_histories import CalibrationSpread
from benchmarks.campaign import Row, Share, arguments, markdown, rms_told

FIRST = np.datetime64("2020-01-01", "s")


def coverage_told(z: Floats) -> str:
    """Return the share of z within k = 2, with its interval, as text."""
    return Share.true(np.abs(z) <= 2.0).percent


def calibrations(unit: Any, when: Any, vector: Floats, bench: Any = "1") -> ComparedCalibrations:
    """Return calibrations with u = 1 of units of one type."""
    n = len(vector)
    return ComparedCalibrations(
        unit=np.array([f"A {k}" for k in unit]), kind=np.full(n, "A"), bench=np.broadcast_to(bench, n), when=when,
        vector=vector, covariance=np.broadcast_to(np.eye(12), (n, 12, 12)).copy(), meters=np.zeros((n, 12)),
        gravity=np.zeros((n, 12)), place=np.full(n, STANDARD_GRAVITY), signal="V", simulated=True,
    )  # fmt: skip


# --- prior ------------------------------------------------------------------------------------------


def prior(runs: int, seed: int) -> Iterator[Row]:
    """Yield a row for each number of units behind a prior."""
    signs = np.where(np.arange(12) % 2, -1.0, 1.0)
    correlation = 0.5 * np.eye(12) + 0.5 * np.outer(signs, signs)
    between = np.linalg.cholesky(25.0 * correlation)
    own = 9.0 * np.eye(12)
    for units, repeats in [(units, repeats) for units in (6, 12, 30) for repeats in (1, 3)]:
        rng = np.random.default_rng([seed, units, repeats])
        z, alone, chi2, ratio, used = [], [], [], [], 0
        unit = np.repeat(np.arange(units), repeats)
        when = FIRST + np.arange(len(unit)).astype("timedelta64[D]")
        for _ in range(runs):
            true = rng.normal(size=(units + 1, 12)) @ between.T
            values = true[unit] + rng.normal(size=(len(unit), 12))
            kept = prior_of(calibrations(unit, when, values))
            # a short calibration, with three times the u of the calibrations behind the prior
            short = true[-1] + rng.multivariate_normal(np.zeros(12), own)
            joined = join(short, own, np.zeros((12, 12)), kept, STANDARD_GRAVITY)
            u, gap = np.sqrt(np.diag(joined.covariance)), joined.vector - true[-1]
            z.append(gap / u)
            alone.append((short - true[-1]) / np.sqrt(np.diag(own)))
            chi2.append(gap @ np.linalg.solve(joined.covariance, gap) / 12)
            ratio.append(u / np.sqrt(np.diag(own)))
            used += joined.used
        yield (
            units, f"{repeats} ×", f"{np.mean(ratio):.2f}", rms_told(np.array(z)), coverage_told(np.array(z)),
            rms_told(np.array(alone)), f"{np.mean(chi2):.2f} ± {np.std(chi2) / np.sqrt(runs):.2f}",
            f"{100 * used / runs:.1f} %",
        )  # fmt: skip


# --- drift ------------------------------------------------------------------------------------------

BATCH = 500
WALKS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 3.0), (0.0, 10.0))


def drift(runs: int, seed: int) -> Iterator[Row]:
    """Yield a row for each number of calibrations and each size of scatter and walk."""
    for count, (scatter, walk) in [(count, sizes) for count in (6, 12) for sizes in WALKS]:
        rng = np.random.default_rng([seed, count])
        rates, foretold = [], []
        for begin in range(0, runs, BATCH):
            m = min(BATCH, runs - begin)
            years = np.cumsum(rng.uniform(0.5, 1.5, count + 1))
            steps = np.sqrt(np.diff(years, prepend=0.0))[:, None] * rng.normal(size=(count + 1, m))
            true = walk * np.cumsum(steps, axis=0) + years[:, None]
            true = true + scatter * rng.normal(size=true.shape)
            values = true[:-1] + rng.normal(size=(count, m))
            when = np.asarray(FIRST + np.round(years * SECONDS_PER_YEAR).astype("timedelta64[s]"))
            found = history_drift(when[:-1], values, np.ones_like(values))
            rates.append((found.rate - 1.0) / found.u_rate)
            value, u = found.predicted(when[-1])
            foretold.append((value - true[-1]) / u)
        told = [f(np.concatenate(z)) for z in (rates, foretold) for f in (rms_told, coverage_told)]
        yield count, f"{scatter:g}", f"{walk:g}", *told


# --- crossed effects --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Values `y` (n,) with their stated variances (n,), units and benches, and the true effects of benches (B,)."""

    crossing: Crossing
    y: Floats
    variance: Floats
    bench: Floats


def drawn(
    rng: np.random.Generator, count: int, units: int, benches: int, sizes: Sequence[float],
    *, kinds: int = 1, u: float = 1.0,
) -> Case:  # fmt: skip
    """Draw values of units on benches, paired at random; `sizes` are 1 sigma of units, benches and excess."""
    unit = np.unique(rng.integers(0, units, count), return_inverse=True)[1]
    bench = np.unique(rng.integers(0, benches, count), return_inverse=True)[1]
    kind = (np.arange(unit.max() + 1) % kinds)[unit]
    of_unit, of_bench = rng.normal(size=unit.max() + 1), sizes[1] * rng.normal(size=bench.max() + 1)
    own = u * rng.uniform(0.7, 1.3, count)
    y = 5.0 + 10.0 * kind + sizes[0] * of_unit[unit] + of_bench[bench]
    y = y + sizes[2] * rng.normal(size=count) + own * rng.normal(size=count)
    return Case(Crossing(unit, bench, kind), y, own**2, of_bench)


CROSSINGS = (
    (200, 60, 4, (3.0, 1.0, 1.0)), (600, 150, 10, (3.0, 1.0, 1.0)), (600, 150, 10, (0.3, 0.3, 0.3)),
    (2000, 1500, 10, (3.0, 1.0, 1.0)), (5000, 1000, 50, (3.0, 1.0, 1.0)),
)  # fmt: skip


def crossed(runs: int, seed: int) -> Iterator[Row]:
    """Yield a row of estimated and true sizes over `runs` draws of each case."""
    for count, units, benches, sizes in CROSSINGS:
        rng = np.random.default_rng(seed)
        found, stated, z = [], [], []
        for _ in range(runs):
            case = drawn(rng, count, units, benches, sizes)
            one = fit(case.crossing, case.y, case.variance)
            effect, covariance = one.bench
            u = np.sqrt(np.diag(covariance))
            found.append(one.sizes)
            stated.append(one.u_sizes)
            z.append((effect - case.bench + case.bench.mean())[u > 0] / u[u > 0])
        scatter, scores = np.std(found, axis=0, ddof=1), np.concatenate(z)
        mean, rms = np.mean(found, axis=0), np.sqrt(np.mean(scores**2))
        means = [f"{m:.3f} ± {s:.3f}" for m, s in zip(mean, scatter / np.sqrt(runs), strict=True)]
        ratios = [f"{r:.2f}" for r in np.nanmean(stated, axis=0) / scatter]
        shape, true = f"{count}, {units}, {benches}", ", ".join(f"{s:g}" for s in sizes)
        of_benches = f"{rms:.3f} ± {rms / np.sqrt(2 * len(scores)):.3f}"
        yield shape, true, ", ".join(means), ", ".join(ratios), of_benches


# --- capability -------------------------------------------------------------------------------------

LABORATORIES = (
    (30, 5, 3, (1.0, 0.0, 0.0, 0.5)), (30, 5, 3, (0.0, 0.0, 0.0, 0.5)), (30, 5, 3, (1.0, 2.0, 0.0, 0.5)),
    (30, 5, 3, (1.0, 0.0, 2.0, 0.5)), (30, 5, 3, (0.0, 2.0, 1.0, 0.5)), (12, 4, 2, (1.0, 0.5, 0.0, 0.5)),
)  # fmt: skip
"""By laboratory: numbers of units, of runs of each, and of benches; sizes of scatter, rates, walks and benches.

Rates are per year, walks are in a year.
"""


def laboratory(
    rng: np.random.Generator, units: int, runs: int, benches: int, sizes: Sequence[float]
) -> ComparedCalibrations:
    """Draw calibrations with u = 1 of all twelve coefficients.

    `sizes` are those of scatter, rates, walks and benches.
    """
    scatter, rate, walk, between = sizes
    steps = rng.uniform(0.5, 1.5, (units, runs))
    years = np.cumsum(steps, axis=1)
    bench = rng.integers(0, benches, units * runs)
    level, slope = 5.0 * rng.normal(size=(units, 1, 12)), rate * rng.normal(size=(units, 1, 12))
    walked = walk * np.cumsum(np.sqrt(steps)[..., None] * rng.normal(size=(units, runs, 12)), axis=1)
    true = (level + slope * years[..., None] + walked).reshape(-1, 12)
    values = true + between * rng.normal(size=(benches, 12))[bench]
    values = values + scatter * rng.normal(size=values.shape) + rng.normal(size=values.shape)
    when = np.datetime64("2015-01-01", "s") + (years.ravel() * (YEAR / np.timedelta64(1, "s"))).astype(int)
    names = np.array([f"bench {k}" for k in bench])
    return calibrations(np.repeat(np.arange(units), runs), when, values, names)


def capabilities(runs: int, seed: int) -> Iterator[Row]:
    """Yield a row for each kind of laboratory."""
    for units, each, benches, sizes in LABORATORIES:
        rng = np.random.default_rng([seed, units, *(int(10 * size) for size in sizes)])
        spreads: list[CalibrationSpread] = []
        before = []
        for _ in range(runs):
            made = laboratory(rng, units, each, benches, sizes)
            spreads += capability(made).spreads
            unit, bench = (np.unique(labels, return_inverse=True)[1] for labels in (made.unit, made.bench))
            crossing = Crossing(unit, bench, np.zeros_like(unit))
            values = np.ascontiguousarray(made.vector[:, 0])
            before.append(fit(crossing, values, made.variance[:, 0]).sizes[EXCESS])
        lower = np.array([one.scatter_least <= sizes[0] for one in spreads])
        upper = np.array([one.scatter_most >= sizes[0] for one in spreads])
        scatter, shown = np.mean([one.scatter for one in spreads]), np.mean([one.shown for one in spreads])
        told = [f"{units} × {each}", *(f"{size:g}" for size in sizes[:3])]
        told += [Share.true(lower).percent, Share.true(upper).percent, f"{scatter:.2f}"]
        yield *told, f"{np.mean(before):.2f}", f"{100 * shown:.0f} %"


# --- the tables -------------------------------------------------------------------------------------

TABLES: Final[dict[str, tuple[Callable[[int, int], Iterator[Row]], str]]] = {
    "prior": (
        prior, "units | calibrated | u with / without | rms z with | within k = 2 | rms z without | χ²/12 | used"
    ),
    "drift": (
        drift, "n | scatter | walk in a year | rate: rms z | within k = 2 | foretold: rms z | within k = 2"
    ),
    "crossed": (
        crossed,
        "values, units, benches | true sizes | found, mean ± s.e. | u stated / scatter found | z of benches",
    ),
    "capability": (
        capabilities,
        "units × runs | scatter | rate | walk | lower limit holds | upper limit holds | scatter found | "
        "drift left in | drift taken out",
    ),
}  # fmt: skip


def main() -> None:
    given = arguments(__doc__, what={"positional": True, "choices": TABLES}, runs=400, seed=1)
    table, heads = TABLES[given.what]
    for line in markdown(heads.split(" | "), table(given.runs, given.seed)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
