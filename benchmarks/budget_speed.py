"""How fast is a budget? Beside GTC and uncertainties doing the same, and Monte Carlo in trials per second.

    python -m benchmarks.budget_speed

The full budget: every source of the shipped bench, generalised least squares, covariance and degrees of freedom
of the twelve coefficients, from conditions to numbers. For the peers, who have no estimator of their own, the
gain is given, and the case is the one that they can do: 54 uncertain signals (the means of three passes), the
paper's (8), twelve values with their covariance. Monte Carlo: every source through the exact geometry.
Promised: the full budget in less than 50 ms.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import combinations
from statistics import median

import GTC
import numpy as np
import uncertainties

from bench.base.arrays import Floats
from bench.calibration.budget.assessment import exact_monte_carlo
from bench.calibration.budget.coefficients import Setup, make_budget, make_setup
from bench.calibration.budget.sources import bench_sources
from bench.calibration.closed_form import closed_form
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure

REPEATS = 7
BUDGET_S = 0.050
SIGMA_V = 1e-4


def seconds(action: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median wall time of an action, s."""
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        action()
        spent.append(time.perf_counter() - begun)
    return median(spent)


def with_gtc(gain: Floats, signals: Floats) -> Floats:
    inputs = [GTC.ureal(float(s), SIGMA_V) for s in signals]
    outputs = [sum(float(c) * x for c, x in zip(row, inputs, strict=True) if c) for row in gain]
    matrix = np.diag([GTC.variance(one) for one in outputs])
    for i, j in combinations(range(len(outputs)), 2):
        matrix[i, j] = matrix[j, i] = GTC.get_covariance(outputs[i], outputs[j])
    _ = [GTC.dof(one) for one in outputs]
    return matrix


def with_uncertainties(gain: Floats, signals: Floats) -> Floats:
    inputs = [uncertainties.ufloat(float(s), SIGMA_V) for s in signals]
    outputs = [sum(float(c) * x for c, x in zip(row, inputs, strict=True) if c) for row in gain]
    return np.array(uncertainties.covariance_matrix(outputs))


def with_numpy(gain: Floats, signals: Floats) -> Floats:
    return (gain * SIGMA_V**2) @ gain.T


def main() -> int:
    bench = load_bench(find_bench("paper-stand"))
    setup = make_setup(load_procedure(find_procedure("paper")).expand(), bench)
    sources = bench_sources(bench, setup)

    def full() -> None:
        fresh = Setup(setup.model, setup.conditions, setup.block, setup.meters)  # nothing kept from before
        total = make_budget(fresh, sources).combined
        _ = (total.u, total.dof, total.correlation)

    budget_s = seconds(full)
    print(
        f"full budget, {len(sources)} sources, gls: {1e3 * budget_s:.1f} ms (promised: {1e3 * BUDGET_S:g} ms)\n"
    )

    unit = np.eye(54).reshape(54, 2, 3, 9)
    gain = np.stack([closed_form(one) for one in unit], axis=1)
    signals = np.ones(54)
    ours = with_numpy(gain, signals)
    own_s = seconds(lambda: with_numpy(gain, signals))
    print(f"{'54 signals to 12 values, covariance':38} {'ms':>9} {'ratio':>7}   (median of {REPEATS})")
    print(f"{'this program, given the gain':38} {1e3 * own_s:9.4f} {1:7.0f}")
    for name, peer in (("GTC", with_gtc), ("uncertainties", with_uncertainties)):
        theirs = peer(gain, signals)
        worst = float(np.max(np.abs(theirs - ours)) / np.max(ours))
        peer_s = seconds(partial(peer, gain, signals))
        print(f"{name:38} {1e3 * peer_s:9.4f} {peer_s / own_s:7.0f}   agrees to {worst:.0e}")

    exact = make_budget(setup, sources)
    print(f"\n{'Monte Carlo':38} {'trials/s':>9}")
    exact_rate = 20_000 / seconds(lambda: exact_monte_carlo(exact, 20_000), 3)
    print(f"{'exact geometry, all sources, Δg':38} {exact_rate:9.3g}")
    return 0 if budget_s < BUDGET_S else 1


if __name__ == "__main__":
    sys.exit(main())
