"""Test the combined uncertainty, which one signs, on thousands of simulated runs with every error of a bench.

    python -m benchmarks.signed_uncertainty --cases all --runs 2500 --workers 2
    python -m benchmarks.signed_uncertainty --cases stand roll meters noise temperature walk setting --runs 600
    python -m benchmarks.signed_uncertainty --cases all all-wandering temperature wandering --runs 1000
    python -m benchmarks.signed_uncertainty --bound 600
    python -m benchmarks.signed_uncertainty --few 2000
    python -m benchmarks.signed_uncertainty --clean 1500

The cases are those of tests/support/whole_truth.py, whose truth shares nothing with the model. For each case,
the campaign prints: root mean square of (estimate - truth)/u of each coefficient, with the combined u and
with the u of the readings; coverage of k = 2; rms z of delta g at the verification points. For a source of
known size, a ratio of variances is printed, too: what it adds to the estimates (the same run with and without
it), divided by what it adds to u^2. The temperature has one error throughout a run, which the bench file does
not state; in cases called wandering it is a process with the correlation time that the bench file states.

`--bound`: runs with noise and stand errors only, compared with a fit that knows the sizes of the
noise and whose u is the Cramer-Rao bound.

`--few`: that many runs of each design with hardly any degrees of freedom (2+2, 3+2, 3+3, 4+2 readings), for
which the bench file states the noise. With noise drawn from the prior that the program states, the table
shows the coverage of U (promised: 0.93 of all coefficients, 0.91 of each) and refusals (promised: at most 1
%). At twice the stated noise, every result must say that it depends on the stated noise; the table shows how
often it says that the readings disagree. `--clean`: that many runs without any error that readings share,
with equal and with unequal channels. The table shows how often such an error is falsely found (promised: 1 %,
within the binomial limit of 99 %). The exit status is 1 if a limit is broken.
"""

import sys
import time
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import delta_g_contributions, sign
from bench.calibration.components import ASKED_P
from bench.calibration.result import COVERAGE_FACTOR, Calibration, Noise
from bench.config.bench_file.stand import UncertaintySection
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import VERIFICATION, Readings
from bench.services.face import load_bench
from bench.validation.paper_bench import SETTING_U_RAD
from benchmarks.campaign import arguments, finish, outside, parts_of, rms, show_by_coefficient
from tests.support.honest_runs import FEW, components_taken, run_few
from tests.support.whole_truth import CASES, EVERYTHING, WANDERING, Bench, simulate_whole

CHUNK = 50
KNOWN = {
    "roll": ("mounting_roll",),
    "meters": ("voltmeter_gain", "voltmeter_offset"),
    "temperature": ("temperature",),
    "wandering": ("temperature",),
}
"""The sources of error, by case, whose sizes the bench file or a data sheet states."""
STATED = UncertaintySection.model_validate(
    {"temperature": {"limit": "0.5 K", "distribution": "rectangular", "correlation_time": "1 h"}}
)


@dataclass
class Calibrator:
    """A calibration like that of `bench calibrate`, without files; if `wandering`, the bench file has
    `STATED`.
    """

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
    """Return the `Calibrator` of a case, one for each process, so that a bench file is read once."""
    return Calibrator(wandering=case in WANDERING)


def run(case: str, seed: int, numbers: range) -> tuple[Floats, ...]:
    """Return arrays over runs of a case.

    They are: errors, u, and u of the readings (runs, 12); delta g and its u (runs, 8); for the source of the
    case, the changes of the estimates, and the variances that the source adds to u^2 (runs, 12).
    """
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
    """Return the estimate minus that of the same run without the source of the case.

    The source's random numbers are drawn first, so that all others stay the same.
    """
    rng = np.random.default_rng(at)
    Bench.drawn(rng, case)
    if case == "roll":
        # the roll is drawn after the stand's angles; cases without roll multiply it by zero
        other = simulate_whole(np.random.default_rng(at), "stand")
    else:
        other = simulate_whole(rng, case, Bench())
    return np.asarray(found.block.vector - own(case).of(other.readings).block.vector)


def show(case: str, parts: list[Any], runs: int) -> list[str]:
    error, u, u_readings, dg, u_dg, difference, added = (np.concatenate(c) for c in zip(*parts, strict=True))
    z, z_readings = rms(error / u), rms(error / u_readings)
    covered = np.mean(np.abs(error) <= 2 * u, axis=0)
    z_dg = rms(dg / u_dg)
    print(f"\n{case}: {runs} runs")
    show_by_coefficient({"z, combined": z, "z, readings": z_readings, "coverage": covered})
    print(f"  coverage of all {np.mean(covered):.3f}, the worst {np.min(covered):.3f}")
    show_by_coefficient({"z, delta g": z_dg})
    least = float(stats.binom.ppf(0.001, runs, 0.945)) / runs
    room = 3 / np.sqrt(2 * runs)
    broken = outside(f"{case}: z", z, 0.9 - room if case in EVERYTHING else 0.0, 1.1 + room)
    broken += outside(f"{case}: coverage (at least {least:.3f})", covered, least)
    if case == "stand":
        broken += outside("stand: z of the readings", z_readings, 0.92 - room, 1.06 + room)
    if case in KNOWN:
        drawn = np.mean(difference**2, axis=0)
        stated = np.mean(added, axis=0)
        matters = stated > 0.05 * np.mean(u_readings**2, axis=0)
        ratio = np.where(matters, drawn / np.where(stated > 0, stated, 1.0), np.nan)
        show_by_coefficient({"drawn/added": ratio})
        room = 0.1 + 3 * np.sqrt(2 / runs)
        broken += outside(f"{case}: drawn/added", ratio, 1 - room, 1 + room)
    return broken


def beside_bound(seed: int, numbers: range) -> tuple[Floats, Floats, Floats, Floats]:
    """Return errors of a fit and of a fit that knows the noise (runs, 12), u of the readings, and the bound."""
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


def show_bound(parts: list[Any], runs: int) -> list[str]:
    error, ideal, u, bound = (np.concatenate(column) for column in zip(*parts, strict=True))
    # both estimate from the same readings, so that the ratio of their scatters is more accurate than either scatter
    scatter = np.sqrt(np.mean(error**2, axis=0) / np.mean(ideal**2, axis=0))
    stated = np.mean(u, axis=0) / np.mean(bound, axis=0)
    apart = np.sqrt(np.var(error**2 - ideal**2, axis=0) / runs) / (2.0 * np.mean(ideal**2, axis=0))
    print(f"\nbeside the Cramer-Rao bound: {runs} runs")
    show_by_coefficient({"scatter": scatter, "its s. error": apart, "mean u": stated})
    return [
        f"{n}: scatter {s:.3f}, mean u {m:.3f} of the bound"
        for n, s, a, m in zip(COEFFICIENTS, scatter, apart, stated, strict=True)
        if s > 1.03 + 3.0 * a or m > 1.15
    ]


# --- few readings, and clean ones ---------------------------------------------------------------------


def few(seed: int, count: int, workers: int) -> list[str]:
    """Calibrate few readings: coverage at noise from the stated prior, and the notes at twice the stated noise."""
    broken = []
    for design in FEW:
        for times, what in ((None, "drawn from the prior"), (2.0, "twice the stated")):
            parts = parts_of(partial(run_few, seed, design=design, times=times), count, workers)
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
    """Calibrate runs whose readings share no error: how often a component is found in error."""
    broken = []
    for case, what in (("stand", "alike"), ("noise", "unlike")):
        taken = sum(parts_of(partial(components_taken, seed, case=case), count, workers))
        most = int(stats.binom.ppf(0.99, count, ASKED_P))
        print(f"{taken} of {count} clean runs of {what} channels have a component, {most} at most at 1 %")
        broken += [f"{what} channels: components in {taken} of {count} clean runs"] if taken > most else []
    return broken


def main() -> int:
    given = arguments(
        __doc__, cases={"nargs": "+", "choices": CASES, "default": list(CASES)}, runs=2500, bound=0,
        few=(0, "runs of each design with few readings"), workers=2, seed=1,
        clean=(0, "runs of which the readings share nothing"),
    )  # fmt: skip
    broken: list[str] = []
    begun = time.perf_counter()
    count = given.bound or given.runs
    if given.few or given.clean:
        broken += few(given.seed, given.few, given.workers) if given.few else []
        broken += clean(given.seed, given.clean, given.workers) if given.clean else []
        return finish(broken, "every bar holds")
    if given.bound:
        broken += show_bound(parts_of(partial(beside_bound, given.seed), count, given.workers, CHUNK), count)
    for case in given.cases if not given.bound else ():
        broken += show(case, parts_of(partial(run, case, given.seed), count, given.workers, CHUNK), count)
        sys.stdout.flush()
    print(f"\n{time.perf_counter() - begun:.0f} s")
    return finish(broken, "every bar holds")


if __name__ == "__main__":
    sys.exit(main())
