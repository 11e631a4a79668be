"""Is the uncertainty that one signs true? Thousands of runs with every error of a bench in them.

    python -m benchmarks.signed_uncertainty --cases all --runs 2500 --workers 2
    python -m benchmarks.signed_uncertainty --cases stand roll meters noise temperature walk setting --runs 600
    python -m benchmarks.signed_uncertainty --cases all all-wandering temperature wandering --runs 1000
    python -m benchmarks.signed_uncertainty --pairs 2000 --cases roll meters temperature all
    python -m benchmarks.signed_uncertainty --bound 600

For each case (tests/support/whole_truth.py, whose truth shares nothing with the model): root mean square of
(estimate - truth)/u of each coefficient, with the combined u and with that of the readings, coverage of k = 2,
rms z of delta g at the verification points. For cases of known size the variance that a source adds to the
estimates (the same run with and without it) over what it adds to u^2. The temperature is off by one draw throughout
a run, of which the bench file says nothing; in the cases that are called wandering it is a process with the
correlation time that the bench file states. `--pairs`: how often two calibrations of a
block that was remounted are said to differ, and how often a change of six standard uncertainties of the difference
in one coefficient is found. `--bound`: runs with noise and stand alone beside the fit that is told the sizes of the
noise, whose u is the Cramer-Rao bound. Exit status 1 where a bar is broken.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import delta_g_contributions, sign
from bench.calibration.result import Calibration, Noise
from bench.config.bench_file.stand import UncertaintySection
from bench.history.comparison import Snapshot, compare
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import VERIFICATION, Readings
from bench.services.face import load_bench
from benchmarks.campaign import arguments
from tests.support.paper_bench import SETTING_U_RAD
from tests.support.whole_truth import CASES, EVERYTHING, WANDERING, Bench, simulate_whole

CHUNK = 50
ONE_IN = 4
"""One pair in so many is compared again with a change in it."""
TODAY = datetime(2026, 1, 1, tzinfo=UTC)
KNOWN = {
    "roll": ("mounting_roll",),
    "meters": ("voltmeter_gain", "voltmeter_offset"),
    "temperature": ("temperature",),
    "wandering": ("temperature",),
}
"""The sources of the cases whose sizes the bench file or a data sheet says."""
STATED = UncertaintySection.model_validate(
    {"temperature": {"limit": "0.5 K", "distribution": "rectangular", "correlation_time": "1 h"}}
)


@dataclass
class Calibrator:
    """Calibrates as `bench calibrate` does, without its files; `wandering` is what the bench file then states."""

    wandering: bool = False

    def __post_init__(self) -> None:
        self.bench = load_bench("paper-stand")
        if self.wandering:
            self.bench = self.bench.model_copy(update={"uncertainty": STATED})
        self.model = ForwardModel(self.bench.installation_models())
        self.stand_u = {name: d.u for name, d in self.bench.stand_distributions().items()}
        self.assumed = {name: d.u for name, d in assumed_stand(self.bench).items()}

    def of(self, readings: Readings) -> Calibration:
        found = calibrate(readings, self.model, self.stand_u, 9.81, assumed_u=self.assumed)
        return sign(found, readings, self.bench, self.model)

    def delta_g(self, found: Calibration, readings: Readings) -> tuple[Floats, Floats]:
        rows = readings.installation == VERIFICATION
        error = np.linalg.norm(found.block.specific_force(readings.signal[rows]), axis=1) - 1.0
        return error, np.sqrt(
            np.diag(sum(delta_g_contributions(found, readings, self.bench, self.model).values()))
        )


@cache
def own(case: str) -> Calibrator:
    """One for each process: a bench file is read once."""
    return Calibrator(wandering=case in WANDERING)


def run(case: str, seed: int, numbers: range) -> tuple[Floats, ...]:
    """Return errors, u, u of the readings (runs, 12), delta g, its u (runs, 8), differences, added variances."""
    rows: list[list[Floats]] = []
    names = KNOWN.get(case, ())
    for k in numbers:
        at = [seed, CASES.index(case), k]
        drawn = simulate_whole(np.random.default_rng(at), case)
        found = own(case).of(drawn.readings)
        dg, u_dg = own(case).delta_g(found, drawn.readings)
        error = found.block.vector - drawn.truth
        added, difference = np.zeros(12), np.zeros(12)
        if names:
            added = sum((np.diag(s.covariance) for s in found.sources if s.name.startswith(names)), added)
            difference = _without(case, at, found)
        rows.append([error, found.u, found.u_readings, dg, u_dg, difference, added])
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def _without(case: str, at: list[int], found: Calibration) -> Floats:
    """The estimate less that of the same run without the source: its draws come first, so the rest stays alike."""
    rng = np.random.default_rng(at)
    Bench.drawn(rng, case)
    if case == "roll":
        # the roll is drawn after the stand's angles and is multiplied by nothing in another case
        return np.asarray(
            found.block.vector
            - own(case).of(simulate_whole(np.random.default_rng(at), "stand").readings).block.vector
        )
    if case == "meters":
        return np.asarray(
            found.block.vector - own(case).of(simulate_whole(rng, case, Bench()).readings).block.vector
        )
    still = Bench()
    return np.asarray(
        found.block.vector - own(case).of(simulate_whole(rng, case, still).readings).block.vector
    )


def show(case: str, parts: list[tuple[Floats, ...]], runs: int) -> list[str]:
    error, u, u_readings, dg, u_dg, difference, added = (np.concatenate(c) for c in zip(*parts, strict=True))
    z = np.sqrt(np.mean((error / u) ** 2, axis=0))
    z_readings = np.sqrt(np.mean((error / u_readings) ** 2, axis=0))
    covered = np.mean(np.abs(error) <= 2 * u, axis=0)
    z_dg = np.sqrt(np.mean((dg / u_dg) ** 2, axis=0))
    print(f"\n{case}: {runs} runs")
    for what, values in (("z, combined", z), ("z, readings", z_readings), ("coverage", covered)):
        print(f"  {what:12}" + " ".join(f"{v:6.3f}" for v in values))
    print(f"  coverage of all {np.mean(covered):.3f}, the worst {np.min(covered):.3f}")
    print(f"  {'z, delta g':12}" + " ".join(f"{v:6.3f}" for v in z_dg))
    least = float(stats.binom.ppf(0.001, runs, 0.945)) / runs
    broken = [
        f"{case}: z of {n} is {v:.3f}"
        for n, v in zip(COEFFICIENTS, z, strict=True)
        if v > 1.1 + 3 / np.sqrt(2 * runs)
    ]
    broken += [
        f"{case}: coverage of {n} is {v:.3f}, below {least:.3f}"
        for n, v in zip(COEFFICIENTS, covered, strict=True)
        if v < least
    ]
    if case in EVERYTHING:
        broken += [
            f"{case}: z of {n} is {v:.3f}"
            for n, v in zip(COEFFICIENTS, z, strict=True)
            if v < 0.9 - 3 / np.sqrt(2 * runs)
        ]
    if case == "stand":
        broken += [
            f"stand: z of the readings of {n} is {v:.3f}"
            for n, v in zip(COEFFICIENTS, z_readings, strict=True)
            if not 0.92 - 3 / np.sqrt(2 * runs) <= v <= 1.06 + 3 / np.sqrt(2 * runs)
        ]
    if case in KNOWN:
        drawn = np.mean(difference**2, axis=0)
        stated = np.mean(added, axis=0)
        matters = stated > 0.05 * np.mean(u_readings**2, axis=0)
        ratio = np.where(matters, drawn / np.where(stated > 0, stated, 1.0), np.nan)
        print(f"  {'drawn/added':12}" + " ".join(f"{v:6.3f}" for v in ratio))
        room = 0.1 + 3 * np.sqrt(2 / runs)
        broken += [
            f"{case}: {n} drawn/added {v:.3f}"
            for n, v in zip(COEFFICIENTS, ratio, strict=True)
            if abs(v - 1) > room
        ]
    return broken


def pairs(case: str, seed: int, numbers: range) -> tuple[int, int, int, int]:
    """Return how many pairs were compared, said to differ, changed by 6 u in one coefficient, and then found."""
    differ = changed = found = 0
    for k in numbers:
        rng = np.random.default_rng([seed, 100 + CASES.index(case), k])
        bench = Bench.drawn(rng, case)
        first = own(case).of(simulate_whole(rng, case, bench).readings)
        second = own(case).of(simulate_whole(rng, case, bench).readings)
        unchanged = compare([_snapshot(first, "a"), _snapshot(second, "b")])
        differ += unchanged.changed
        if k % ONE_IN:
            continue
        changed += 1
        j = int(rng.integers(12))
        change = np.zeros(12)
        change[j] = 6 * unchanged.changes[0].u[j]
        moved = own(case).of(simulate_whole(rng, case, bench, change=change).readings)
        found += compare([_snapshot(first, "a"), _snapshot(moved, "c")]).changed
    return len(numbers), differ, changed, found


def _snapshot(found: Calibration, name: str) -> Snapshot:
    return Snapshot(
        name, TODAY, "block 1", found.unit, found.g_m_s2, found.block.vector, found.covariance,
        same_meters=found.covariance_same_meters, meters=("1", "2", "3"), block_terms=found.block_terms,
        wander=found.wander,
    )  # fmt: skip


def beside_bound(seed: int, numbers: range) -> tuple[Floats, Floats, Floats, Floats]:
    """Return errors of the fit and of the one that knows the noise (runs, 12), u of the readings, the bound."""
    known = Noise(1e-4, SETTING_U_RAD, np.inf, "given")
    rows = []
    for k in numbers:
        drawn = simulate_whole(np.random.default_rng([seed, 200, k]), "stand")
        bench = own("stand")
        found = calibrate(drawn.readings, bench.model, bench.stand_u, 9.81)
        best = calibrate(drawn.readings, bench.model, bench.stand_u, 9.81, noise=known, find_shared=False)
        errors = [each.block.vector - drawn.truth for each in (found, best)]
        rows.append([*errors, found.u_readings, best.u])
    error, ideal, u, bound = (np.array(column) for column in zip(*rows, strict=True))
    return error, ideal, u, bound


def show_bound(parts: list[tuple[Floats, Floats, Floats, Floats]], runs: int) -> list[str]:
    error, ideal, u, bound = (np.concatenate(column) for column in zip(*parts, strict=True))
    # both estimate from the same readings, so the ratio of their scatters is known better than either
    scatter = np.sqrt(np.mean(error**2, axis=0) / np.mean(ideal**2, axis=0))
    stated = np.mean(u, axis=0) / np.mean(bound, axis=0)
    apart = np.sqrt(np.var(error**2 - ideal**2, axis=0) / runs) / (2.0 * np.mean(ideal**2, axis=0))
    print(f"\nbeside the Cramer-Rao bound: {runs} runs")
    for what, values in (("scatter", scatter), ("its s. error", apart), ("mean u", stated)):
        print(f"  {what:12}" + " ".join(f"{v:6.3f}" for v in values))
    return [
        f"{n}: scatter {s:.3f}, mean u {m:.3f} of the bound"
        for n, s, a, m in zip(COEFFICIENTS, scatter, apart, stated, strict=True)
        if s > 1.03 + 3.0 * a or m > 1.15
    ]


def main() -> int:
    given = arguments(
        __doc__, cases={"nargs": "+", "choices": CASES, "default": list(CASES)}, runs=2500, pairs=0,
        bound=0, workers=2, seed=1,
    )  # fmt: skip
    broken: list[str] = []
    begun = time.perf_counter()
    count = given.bound or given.pairs or given.runs
    chunks = [range(i, min(i + CHUNK, count)) for i in range(0, count, CHUNK)]
    with ProcessPoolExecutor(given.workers) as pool:
        if given.bound:
            broken += show_bound(
                list(pool.map(beside_bound, [given.seed] * len(chunks), chunks)), given.bound
            )
        for case in given.cases if not given.bound else ():
            of = [case] * len(chunks), [given.seed] * len(chunks), chunks
            if given.pairs:
                n, differ, changed, found = (
                    sum(column) for column in zip(*pool.map(pairs, *of), strict=True)
                )
                upper = float(stats.beta.ppf(0.99, differ + 1, n - differ))
                share = f"{differ / n:.3f}, upper 99 % {upper:.3f}"
                print(
                    f"{case}: {differ} of {n} pairs said to differ ({share}), {found} of {changed} changes found",
                    flush=True,
                )
                broken += [f"{case}: differ in {upper:.3f}"] * (upper > 0.07) + [
                    f"{case}: found {found} of {changed}"
                ] * (found < 0.98 * changed)
            else:
                broken += show(case, list(pool.map(run, *of)), count)
                sys.stdout.flush()
    print(
        f"\n{time.perf_counter() - begun:.0f} s; "
        + ("every bar holds" if not broken else "\n".join(["broken:", *broken]))
    )
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
