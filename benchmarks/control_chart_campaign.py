"""Test the promises of control charts: false rejections per run.

    python -m benchmarks.control_chart_campaign --runs 1000000 --seed 1

The charts are of the nine intrinsic numbers, which do not depend on the mounting. `--runs` is the number of chart
points in each row of the tables (a tenth of it in the second). Both tables are printed, or one of them. The first
lists false rejections of charts with short baselines, for each basis of limits and for a correct or wrong stated u.
In the second, the stated u of only one number is wrong.
"""

from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.intrinsic import INTRINSIC
from bench.stats.control_charts import (
    ALIKE_P,
    Basis,
    ChartDesign,
    centre_of,
    components_of,
    judge,
    short_term,
)
from benchmarks.campaign import Row, arguments, markdown

P: Final = len(INTRINSIC)
LATER: Final = 25
"""Number of runs after each baseline; few, because an error of the baseline is common to all its runs."""
CHARTS: Final = 200
READING_DOF: Final = 36.0
"""Degrees of freedom of the short-term standard deviation of one run of the procedure 'paper'."""


def stated_covariance(seed: int = 7) -> Floats:
    """Return a covariance (9, 9) with correlations and tenfold differences in size, typical of a block."""
    rng = np.random.default_rng(seed)
    mixed = np.eye(P) + 0.4 * rng.normal(size=(P, P))
    covariance = mixed @ mixed.T
    size = np.geomspace(1.0, 10.0, P) / np.sqrt(np.diag(covariance))
    return np.asarray(covariance * np.outer(size, size))


def charts(rng: np.random.Generator, runs: int, points: int, root: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield baselines (b, runs, 9) and later runs (b, LATER, 9), normal with covariance `root` root^T."""
    left = points
    while left > 0:
        count = min(CHARTS, -(-left // LATER))
        values = rng.normal(size=(count, runs + LATER, P)) @ root.T
        yield values[:, :runs], values[:, runs:]
        left -= count * LATER


def false_rejections(
    basis: Basis, runs: int, factor: float, points: int, seed: int, one: float = 1.0
) -> dict[str, Floats]:
    """Return the share of false rejections in each chart (charts,), by each statistic and by any.

    The true u is `factor` times the stated u; for one number, it is `factor` × `one` times the stated u.
    """
    rng = np.random.default_rng(seed)
    stated = stated_covariance()
    scale = np.full(P, factor)
    scale[4] *= one
    root = scale[:, None] * np.linalg.cholesky(stated)
    design = ChartDesign(basis=basis)
    shares: dict[str, list[Floats]] = defaultdict(list)
    every, later = np.tile(stated, (runs, 1, 1)), np.tile(stated, (LATER, 1, 1))
    for baseline, after in charts(rng, runs, points, root):
        centre = centre_of(baseline, every, basis)
        own, smooth = judge(centre, after, later), judge(centre, after, later, design.smoothing)
        short = short_terms(rng, len(after), runs)
        by = {
            "T²": own.p_joint < design.alpha,
            "EWMA": smooth.p_joint < design.alpha_ewma(P),
            "s": short < design.alpha,
        }
        by["all"] = by["T²"] | by["EWMA"] | by["s"]
        if one != 1.0:
            seen = [components_of(k, stated, np.zeros(P)).alike_p < ALIKE_P for k in baseline]
            by["noticed"] = np.array(seen)[:, None]
        for name, rejected in by.items():
            shares[name].append(rejected.mean(axis=1))
    return {name: np.concatenate(each) for name, each in shares.items()}


def relative(shares: Floats, rate: float) -> str:
    """Return the mean share divided by a rate, with its standard error from the scatter between charts."""
    u = shares.std(ddof=1) / np.sqrt(len(shares))
    return f"{shares.mean() / rate:.3f} ± {u / rate:.3f}"


def short_terms(rng: np.random.Generator, count: int, runs: int) -> Floats:
    """Return p-values (count, LATER) of short-term standard deviations, judged by baselines of `runs` runs."""
    s = np.sqrt(rng.chisquare(READING_DOF, size=(count, runs + LATER)) / READING_DOF)
    dof = np.full(runs + LATER, READING_DOF)
    return np.array([short_term(k[runs:], dof[runs:], k[:runs], dof[:runs]).p for k in s])


def nominal() -> dict[str, float]:
    """Return the stated rate of false rejections of each chart in the default design."""
    design = ChartDesign()
    rates = {"T²": design.alpha, "EWMA": design.alpha_ewma(P), "s": design.alpha}
    # rate at which any of the three exceeds its limit, if they were independent
    return rates | {"all": 1.0 - float(np.prod([1.0 - rate for rate in rates.values()]))}


def rejections(points: int, seed: int) -> Iterator[Row]:
    """Yield the rows of the first table."""
    rates = nominal()
    stated = ", ".join(f"{name} {rate:.3e}" for name, rate in rates.items())
    print(f"False rejections, {points} runs a row; nominal: {stated}. Ratio to nominal ± standard error:")
    yield "limits", "baseline", "true u / stated", *rates
    rows: list[tuple[Basis, int, float]] = [("stated", runs, 1.0) for runs in (1, 10)]
    rows += [("scaled", 3, 1.0), ("scaled", 5, 1.5), ("scaled", 10, 0.7), ("scaled", 30, 1.0)]
    rows += [("scatter", 15, 1.0), ("scatter", 30, 1.0)]
    for row, (basis, runs, factor) in enumerate(rows):
        found = false_rejections(basis, runs, factor, points, seed + row)
        yield basis, runs, f"{factor:g}", *(relative(found[name], rate) for name, rate in rates.items())


def wrong(points: int, seed: int) -> Iterator[Row]:
    """Yield the rows of the second table: one of the nine numbers scatters more, or less, than stated."""
    points = max(points // 10, 1000)
    print(f"\nOne of the nine with another u than stated, {points} runs a row; ratio of T² to nominal:")
    yield "limits", "baseline", "its u / stated", "T²", "baselines in which it is noticed"
    rows: list[tuple[Basis, int]] = [("scaled", 5), ("scaled", 10), ("scaled", 30), ("scatter", 30)]
    for (basis, runs), one in product(rows, (0.5, 2.0, 4.0)):
        found = false_rejections(basis, runs, 1.0, points, seed, one)
        noticed = f"{found['noticed'].mean():.3f}"
        yield basis, runs, f"{one:g}", relative(found["T²"], nominal()["T²"]), noticed


TABLES: Final = {"rejections": rejections, "wrong": wrong}


def main() -> None:
    asked = arguments(
        __doc__, runs=(1000000, "chart points of each row"), seed=1,
        table={"choices": TABLES, "help": "one of the two alone"},
    )  # fmt: skip
    for name, table in TABLES.items():
        if asked.table in (None, name):
            rows = table(asked.runs, asked.seed)
            for line in markdown(next(rows), rows):
                print(line, flush=True)


if __name__ == "__main__":
    main()
