"""Whether `bench fleet drift` and a prior of a unit's type state honest uncertainties, on drawn values.

    python -m benchmarks.fleet_honesty drift --runs 2000 --seed 1
    python -m benchmarks.fleet_honesty prior --runs 400 --seed 1

`drift`: histories of n calibrations, about a year apart, of u = 1, with scatter between calibrations and a random
walk in a year of stated sizes; z of the rate and of the value that is foretold for a year later. `prior`: units
that differ by 5 u with correlations, m of them calibrated once or twice behind the prior, and a further one whose
calibration is joined with it; z of its coefficients with and without the prior, in Mahalanobis' sense as well.
Standard errors are beside; coverage is of k = 2, with Wilson's interval of 95 %.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.base.arrays import Floats
from bench.history.comparison import SECONDS_PER_YEAR
from bench.history.drift import history_drift
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations
from bench.history.prior import join, prior_of
from benchmarks.campaign import Share, arguments, rms_told

FIRST = np.datetime64("2020-01-01", "s")
BATCH = 500
COUNTS = (6, 12)
WALKS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 3.0), (0.0, 10.0))
UNITS = (6, 12, 30)


def coverage_told(z: Floats) -> str:
    """Return the share within k = 2, with its interval."""
    return Share.true(np.abs(z) <= 2.0).percent


def drift(runs: int, seed: int) -> Iterator[str]:
    """Yield a table over sizes of scatter and walk."""
    yield "| n | scatter | walk in a year | rate: rms z | within k = 2 | foretold: rms z | within k = 2 |"
    yield "|---|---|---|---|---|---|---|"
    for count in COUNTS:
        for scatter, walk in WALKS:
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
            columns = [f(np.concatenate(z)) for z in (rates, foretold) for f in (rms_told, coverage_told)]
            yield f"| {count} | {scatter:g} | {walk:g} | {' | '.join(columns)} |"


def prior(runs: int, seed: int) -> Iterator[str]:
    """Yield a table over numbers of units behind a prior."""
    yield "| units | calibrated | u with / without | rms z with | within k = 2 | rms z without | χ²/12 | used |"
    yield "|---|---|---|---|---|---|---|---|"
    signs = np.where(np.arange(12) % 2, -1.0, 1.0)
    correlation = 0.5 * np.eye(12) + 0.5 * np.outer(signs, signs)
    between = np.linalg.cholesky(25.0 * correlation)
    for units in UNITS:
        for repeats in (1, 3):
            rng = np.random.default_rng([seed, units, repeats])
            z, alone, chi2, ratio, used = [], [], [], [], 0
            unit = np.repeat(np.arange(units), repeats)
            for _ in range(runs):
                true = rng.normal(size=(units + 1, 12)) @ between.T
                values = true[unit] + rng.normal(size=(len(unit), 12))
                kept = prior_of(measured(unit, values))
                # a short calibration: of three times the u of those behind the prior
                own = 9.0 * np.eye(12)
                short = true[-1] + rng.multivariate_normal(np.zeros(12), own)
                joined = join(short, own, np.zeros((12, 12)), kept, STANDARD_GRAVITY)
                u, gap = np.sqrt(np.diag(joined.covariance)), joined.vector - true[-1]
                z.append(gap / u)
                alone.append((short - true[-1]) / np.sqrt(np.diag(own)))
                chi2.append(gap @ np.linalg.solve(joined.covariance, gap) / 12)
                ratio.append(u / np.sqrt(np.diag(own)))
                used += joined.used
            yield (
                f"| {units} | {repeats} × | {np.mean(ratio):.2f} | {rms_told(np.array(z))} | "
                f"{coverage_told(np.array(z))} | {rms_told(np.array(alone))} | {np.mean(chi2):.2f} ± "
                f"{np.std(chi2) / np.sqrt(runs):.2f} | {100 * used / runs:.1f} % |"
            )


def measured(unit: np.ndarray[tuple[int, ...], np.dtype[np.int64]], values: Floats) -> ComparedCalibrations:
    """Return calibrations of u = 1 of units of one type, on one bench."""
    n = len(unit)
    return ComparedCalibrations(
        unit=np.array([f"A {k}" for k in unit]), kind=np.full(n, "A"), bench=np.full(n, "1"),
        when=FIRST + np.arange(n).astype("timedelta64[D]"), vector=values,
        covariance=np.broadcast_to(np.eye(12), (n, 12, 12)).copy(), meters=np.zeros((n, 12)),
        signal="V", simulated=True,
    )  # fmt: skip


def main() -> None:
    """Print what was asked for."""
    given = arguments(__doc__, what={"positional": True, "choices": ("drift", "prior")}, runs=400, seed=1)
    for line in (drift if given.what == "drift" else prior)(given.runs, given.seed):
        print(line, flush=True)


if __name__ == "__main__":
    main()
