"""Are the stated uncertainties true? Thousands of simulated runs of the paper's procedure with known truth.

    python -m benchmarks.honest_uncertainty --runs 2000 --noise 1e-4 2e-5 --workers 2
    python -m benchmarks.honest_uncertainty --batch 10000 --joined 1000 --runs 0
    python -m benchmarks.honest_uncertainty --few 2000 --clean 2000 --runs 0

For each size of the voltmeter's noise (V): the root mean square of (estimate - truth)/u for each coefficient
by the default estimator (promised: 0.95 to 1.05) and by the closed form; how many times smaller the errors of
the default estimator are (promised: 4 for Kyx and Kzx); the paired comparison with the closed form (squared
errors, in standard errors; negative would be worse); and how often p of the lack of fit is below a level
although nothing is wrong. The stand is the paper's with its limits as three sigma; noise sizes are unknown
to the fit. `--batch` units are calibrated at once: spread of the estimates over the stated u (promised: 0.96 to
1.04). `--joined` runs have eight free positions and a third mounting angle in each installation (promised:
0.95 to 1.05), with three passes and with one. Bounds are widened by three standard errors of what is measured.
`--few` runs of each design that leaves hardly a degree of freedom (2+2, 3+2, 3+3, 4+2 readings) have the bench's
sizes of the noise stated. With noise drawn from the prior that the program states: coverage of U (promised: 0.93
of all coefficients, 0.91 of each) and refusals (promised: 1 % at most); at twice the stated noise the result says
that it rests on the statement (promised: always), and how often that the readings disagree. `--clean` runs, of
alike and of unlike channels, have nothing that readings share: how often a component is taken in (promised: 1 %,
within the binomial limit of 99 %).
The simulation does not use the application's geometry. Exit status 1 when a promise is broken.
"""

from __future__ import annotations

import sys
import time
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from bench.calibration.components import ASKED_P
from bench.calibration.result import COVERAGE_FACTOR
from bench.model.geometry import COEFFICIENTS
from benchmarks.campaign import arguments, finish, outside, parts_of
from benchmarks.many_units import calibrate_batch
from tests.support.honest_runs import (
    FEW,
    MODEL,
    Runs,
    components_taken,
    rms,
    run,
    run_few,
    run_joined,
    simulate_many,
)
from tests.support.paper_bench import STAND_U, TRUTH, simulate

KYX, KZX = COEFFICIENTS.index("Kyx"), COEFFICIENTS.index("Kzx")


def show(runs: Runs) -> None:
    print(f"{'':5}{'z gls':>8}{'z (8)':>8}{'u gls':>11}{'(8)/gls':>9}{'paired':>8}")
    for j, name in enumerate(COEFFICIENTS):
        print(
            f"{name:5}{runs.z[j]:8.3f}{runs.z_closed[j]:8.3f}{np.median(runs.u[:, j]):11.2e}"
            f"{runs.gain[j]:9.2f}{runs.paired_t[j]:8.1f}"
        )
    levels = (0.01, 0.05, 0.1, 0.5, 0.9)
    print("lack of fit, p below: " + ", ".join(f"{q:g}: {np.mean(runs.p < q):.3f}" for q in levels))


def off(what: str, ratios: np.ndarray, part: float, count: int) -> list[str]:
    """Say which ratios are further from 1 than promised, three standard errors of the measurement aside."""
    bound = part + 3 / np.sqrt(2 * count)
    return outside(what, ratios, 1 - bound, 1 + bound)


def batch_spread(seed: int, count: int, noise_v: float) -> list[str]:
    """Calibrate many units at once and compare the spread of the estimates with the stated u."""
    batch = calibrate_batch(
        simulate_many(seed, count, noise_v), simulate(None, 0.0).conditions(), MODEL, STAND_U
    )
    ratio = np.std(batch.coefficients - TRUTH, axis=0) / rms(batch.u)
    print(f"batch of {count}, spread/u: " + ", ".join(f"{r:.3f}" for r in ratio))
    z = rms((batch.coefficients - TRUTH) / batch.u)
    print(f"batch of {count}, z:        " + ", ".join(f"{r:.3f}" for r in z))
    return off("spread over u", ratio, 0.04, count) + off("z", z, 0.05, count)


def joined(seed: int, count: int, noise_v: float, workers: int) -> list[str]:
    """Compare errors with u where free positions join, with three passes and with one."""
    broken = []
    for passes in (3, 1):
        parts = parts_of(partial(_joined, seed, noise_v, passes), count, workers)
        z = rms(np.concatenate(parts))
        print(
            f"{count} runs joined by 8 free positions, passes {passes}, z: "
            + ", ".join(f"{r:.3f}" for r in z)
        )
        broken += off(f"z, joined, passes {passes},", z, 0.05, count)
    return broken


def _joined(seed: int, noise_v: float, passes: int, numbers: range) -> np.ndarray:
    return run_joined(seed, numbers, noise_v, passes)


def _few(seed: int, design: str, times: float | None, numbers: range) -> Any:
    return run_few(seed, numbers, design, times)


def _clean(seed: int, case: str, numbers: range) -> int:
    return components_taken(seed, numbers, case)


def _run(seed: int, noise_v: float, numbers: range) -> Runs:
    return run(seed, numbers, noise_v)


def broken_promises(runs: Runs) -> list[str]:
    broken = off("z", runs.z, 0.05, len(runs.p))
    broken += [
        f"{COEFFICIENTS[j]} is only {runs.gain[j]:.2f} times better" for j in (KYX, KZX) if runs.gain[j] < 4
    ]
    broken += [
        f"{name} is worse than with (8) (paired {t:.1f})"
        for name, t in zip(COEFFICIENTS, runs.paired_t, strict=True)
        if t < -2
    ]
    return broken


def few(seed: int, count: int, workers: int) -> list[str]:
    """Calibrate few readings: coverage at noise as the program states it, and what is said at twice as much."""
    broken = []
    for design in FEW:
        for times, what in ((None, "drawn from the prior"), (2.0, "twice the stated")):
            parts = parts_of(partial(_few, seed, design, times), count, workers)
            error, u, rests, disagrees = (
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("error", "u", "rests", "disagrees")
            )
            refused = [text for part in parts for text in part.refused]
            covered = np.mean(np.abs(error) <= COVERAGE_FACTOR * u, axis=0)
            print(
                f"{design}, noise {what}: coverage {covered.mean():.3f}, least {covered.min():.3f} "
                f"({COEFFICIENTS[int(covered.argmin())]}), {len(refused)} of {count} refused; rests on the "
                f"statement {rests.mean():.3f}, the readings disagree {disagrees.mean():.3f}",
                flush=True,
            )
            broken += (
                [f"{design}: {len(refused)} refused: {refused[0]}"] if len(refused) > 0.01 * count else []
            )
            broken += [] if rests.all() else [f"{design}: not always said to rest on the statement"]
            if times is None and (covered.mean() < 0.93 or covered.min() < 0.91):
                broken.append(f"{design}: coverage {covered.mean():.3f}, least {covered.min():.3f}")
    return broken


def clean(seed: int, count: int, workers: int) -> list[str]:
    """Calibrate runs of which the readings share nothing: how often a component is taken in for nothing."""
    broken = []
    for case, what in (("stand", "alike"), ("noise", "unlike")):
        taken = sum(parts_of(partial(_clean, seed, case), count, workers))
        most = int(stats.binom.ppf(0.99, count, ASKED_P))
        print(f"{taken} of {count} clean runs of {what} channels have a component, {most} at most at 1 %")
        broken += [f"{what} channels: components in {taken} of {count} clean runs"] if taken > most else []
    return broken


def main() -> int:
    given = arguments(
        __doc__, runs=2000, noise=([0.0001, 2e-05], "voltmeter noise, V"), workers=2,
        seed=(1, "run k has the seed [seed, k]"), batch=(0, "units to calibrate at once"),
        joined=(0, "runs in which free positions join"), few=(0, "runs of each design with few readings"),
        clean=(0, "runs of which the readings share nothing"),
    )  # fmt: skip
    broken: list[str] = []
    if given.few:
        broken += few(given.seed, given.few, given.workers)
    if given.clean:
        broken += clean(given.seed, given.clean, given.workers)
    for noise_v in given.noise:
        print(f"\nnoise {noise_v:g} V")
        found = batch_spread(given.seed, given.batch, noise_v) if given.batch else []
        found += joined(given.seed, given.joined, noise_v, given.workers) if given.joined else []
        if given.runs:
            start = time.perf_counter()
            parts = parts_of(partial(_run, given.seed, noise_v), given.runs, given.workers)
            whole = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Runs)}
            print(f"{given.runs} runs, noise {noise_v:g} V, {time.perf_counter() - start:.0f} s")
            show(runs := Runs(**whole))
            found += broken_promises(runs)
        broken += [f"at {noise_v:g} V {text}" for text in found]
    return finish(broken, "\nall promises hold")


if __name__ == "__main__":
    sys.exit(main())
