"""Crossed effects of units and benches: recovery of sizes and effects, and speed.

    python -m benchmarks.crossed_effects recovery --runs 200 --seed 1
    python -m benchmarks.crossed_effects speed --values 100000 --units 20000 --benches 50

`recovery` draws values of units on benches by code of its own and prints true and found sizes with standard errors
of the mean, the stated u over the scatter found, and the rms of z of benches' effects, for cases of several shapes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.base.arrays import Floats
from bench.stats.crossed_effects import Crossing, fit, solve
from benchmarks.campaign import arguments


@dataclass(frozen=True)
class Case:
    """Values `y` (n,) with stated variances (n,), who was measured where, and true effects of benches (B,)."""

    crossing: Crossing
    y: Floats
    variance: Floats
    bench: Floats


def drawn(
    rng: np.random.Generator,
    count: int,
    units: int,
    benches: int,
    sizes: Sequence[float],
    *,
    kinds: int = 1,
    u: float = 1.0,
) -> Case:
    """Draw values of units on benches, each pair by chance, with sizes of units, benches and excess, 1 sigma."""
    unit = np.unique(rng.integers(0, units, count), return_inverse=True)[1]
    bench = np.unique(rng.integers(0, benches, count), return_inverse=True)[1]
    kind = (np.arange(unit.max() + 1) % kinds)[unit]
    of_unit, of_bench = rng.normal(size=unit.max() + 1), sizes[1] * rng.normal(size=bench.max() + 1)
    own = u * rng.uniform(0.7, 1.3, count)
    y = 5.0 + 10.0 * kind + sizes[0] * of_unit[unit] + of_bench[bench]
    y = y + sizes[2] * rng.normal(size=count) + own * rng.normal(size=count)
    return Case(Crossing(unit, bench, kind), y, own**2, of_bench)


CASES = (
    (200, 60, 4, (3.0, 1.0, 1.0)), (600, 150, 10, (3.0, 1.0, 1.0)), (600, 150, 10, (0.3, 0.3, 0.3)),
    (2000, 1500, 10, (3.0, 1.0, 1.0)), (5000, 1000, 50, (3.0, 1.0, 1.0)),
)  # fmt: skip


def recovery(runs: int, seed: int) -> Iterator[str]:
    """Yield a table of what is found over `runs` draws of each case."""
    yield "| values, units, benches | true sizes | found, mean ± s.e. | u stated / scatter found | z of benches |"
    yield "|---|---|---|---|---|"
    for count, units, benches, sizes in CASES:
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
        scatter = np.std(found, axis=0, ddof=1)
        mean = np.mean(found, axis=0)
        sizes_told = ", ".join(
            f"{m:.3f} ± {s:.3f}" for m, s in zip(mean, scatter / np.sqrt(runs), strict=True)
        )
        ratio = ", ".join(f"{r:.2f}" for r in np.nanmean(stated, axis=0) / scatter)
        scores = np.concatenate(z)
        rms = np.sqrt(np.mean(scores**2))
        yield (
            f"| {count}, {units}, {benches} | {', '.join(f'{s:g}' for s in sizes)} | {sizes_told} | {ratio} | "
            f"{rms:.3f} ± {rms / np.sqrt(2 * len(scores)):.3f} |"
        )


def speed(values: int, units: int, benches: int, seed: int) -> Iterator[str]:
    """Yield how long a likelihood and a fit take."""
    case = drawn(np.random.default_rng(seed), values, units, benches, (3.0, 1.0, 1.0))
    sizes = np.array([3.0, 1.0, 1.0])
    solve(case.crossing, case.y, case.variance, sizes)
    began = time.perf_counter()
    solve(case.crossing, case.y, case.variance, sizes)
    one = time.perf_counter() - began
    began = time.perf_counter()
    found = fit(case.crossing, case.y, case.variance)
    whole = time.perf_counter() - began
    told = ", ".join(f"{s:.3f} ± {u:.3f}" for s, u in zip(found.sizes, found.u_sizes, strict=True))
    yield f"{values} values, {case.crossing.units} units, {benches} benches"
    yield f"a likelihood {one:.3f} s, a fit {whole:.2f} s"
    yield f"true 3, 1, 1; found {told}"


def main() -> None:
    """Print what was asked for."""
    given = arguments(
        __doc__, what={"positional": True, "choices": ("recovery", "speed")}, runs=200, seed=1,
        values=100000, units=20000, benches=50,
    )  # fmt: skip
    lines = (
        recovery(given.runs, given.seed)
        if given.what == "recovery"
        else speed(given.values, given.units, given.benches, given.seed)
    )
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
