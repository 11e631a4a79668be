"""Are the stated uncertainties true? Thousands of simulated runs of the paper's procedure with known truth.

    python benchmarks/honest_uncertainty.py --runs 2000 --noise 1e-4 2e-5 --workers 2

For each size of the voltmeter's noise (V): the root mean square of (estimate - truth)/u for each coefficient
by the default estimator (promised: 0.93 to 1.07) and by the closed form; how many times smaller the errors of
the default estimator are (promised: 4 for Kyx and Kzx); the paired comparison with the closed form (squared
errors, in standard errors; negative would be worse); and how often p of the lack of fit is below a level
although nothing is wrong. The stand is the paper's with its limits as three sigma; noise sizes are unknown
to the fit. The simulation does not use the application's geometry. Exit status 1 when a promise is broken.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the matrices are small: threads only get in each other's way
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402
from honest_runs import Runs, run  # noqa: E402

from bench.model.block import COEFFICIENTS  # noqa: E402

KYX, KZX = COEFFICIENTS.index("Kyx"), COEFFICIENTS.index("Kzx")
CHUNK = 100


def simulate_all(pool: ProcessPoolExecutor, seed: int, count: int, noise_v: float) -> Runs:
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    parts = list(pool.map(run, [seed] * len(chunks), chunks, [noise_v] * len(chunks)))
    return Runs(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Runs)})


def show(runs: Runs) -> None:
    print(f"{'':5}{'z gls':>8}{'z (8)':>8}{'u gls':>11}{'(8)/gls':>9}{'paired':>8}")
    for j, name in enumerate(COEFFICIENTS):
        print(
            f"{name:5}{runs.z[j]:8.3f}{runs.z_closed[j]:8.3f}{np.median(runs.u[:, j]):11.2e}"
            f"{runs.gain[j]:9.2f}{runs.paired_t[j]:8.1f}"
        )
    levels = (0.01, 0.05, 0.1, 0.5, 0.9)
    print("lack of fit, p below: " + ", ".join(f"{q:g}: {np.mean(runs.p < q):.3f}" for q in levels))


def broken_promises(runs: Runs) -> list[str]:
    broken = [
        f"z of {name} is {z:.3f}"
        for name, z in zip(COEFFICIENTS, runs.z, strict=True)
        if not 0.93 <= z <= 1.07
    ]
    broken += [
        f"{COEFFICIENTS[j]} is only {runs.gain[j]:.2f} times better" for j in (KYX, KZX) if runs.gain[j] < 4
    ]
    broken += [
        f"{name} is worse than with (8) (paired {t:.1f})"
        for name, t in zip(COEFFICIENTS, runs.paired_t, strict=True)
        if t < -2
    ]
    return broken


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--noise", type=float, nargs="+", default=[1e-4, 2e-5], help="voltmeter noise, V")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1, help="run k has the seed [seed, k]")
    given = parser.parse_args()
    broken: list[str] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for noise_v in given.noise:
            start = time.perf_counter()
            runs = simulate_all(pool, given.seed, given.runs, noise_v)
            print(f"\n{given.runs} runs, noise {noise_v:g} V, {time.perf_counter() - start:.0f} s")
            show(runs)
            broken += [f"at {noise_v:g} V {text}" for text in broken_promises(runs)]
    print("\n" + ("all promises hold" if not broken else "\n".join(["broken:", *broken])))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
