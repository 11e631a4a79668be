"""What does it do to u that the noise, as the readings show it, decides when to stop? Many runs at once.

    python -m benchmarks.until_stopping --runs 2500 --seed 1
    python -m benchmarks.until_stopping --runs 2500 --seed 1 --goal vector=6.83e-5 --noise 1

Beside `benchmarks.until_campaign`, whose runs are whole and choose their points, these look at one order of the
paper's points only: first the best fixed plan with the least number of repeats, then what helps most, `--step`
points a look. At each look the readings so far are calibrated (`calibrate_batch`: the estimator of `bench
calibrate` without its search for what readings share), and a run stops when its stated u reaches the goal. The
truth, the stand and the noise are drawn as in the campaign. Printed by noise and for all: rms of z over the
twelve coefficients at the stop with its standard error over runs, k = 2 coverage, the part of runs that reached
the goal, the mean number of settings; and the same where the number of settings was fixed at the mean and where
the noise was known: what stopping does, and what estimating the noise from few repeats does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import Noise
from bench.planning.choice import Chooser, Standing
from bench.planning.pool import PlannedPoint, Visits
from benchmarks.campaign import arguments
from benchmarks.many_units import Batch, calibrate_batch
from benchmarks.until_campaign import (
    MOUNT_RAD,
    NOISES,
    READING_V,
    SETTING_RAD,
    SPREAD,
    TILT_RAD,
    best_fixed,
    chooser_for,
    table_of,
)
from tests.support.paper_bench import U0, K, specific_force


@dataclass(frozen=True)
class Drawn:
    """Signals (runs, n, 3) of points and the truth (runs, 12)."""

    points: list[PlannedPoint]
    signals: np.ndarray
    truth: np.ndarray
    scale: float


def order_of(chooser: Chooser) -> tuple[list[PlannedPoint], int]:
    """The points in the order of the looks, and how many the first has."""
    task = chooser.task(Standing())
    first = best_fixed(chooser, min(NOISES), LEAST_REPEATS)
    points, rest = list(first), [p for p in chooser.pool.points if p not in first]
    counts = np.array([sum(p.site == site for p in first) for site in task.grid.sites])
    design = Visits(task.candidates, task.goals, counts, counts, task.left)
    while rest:
        before = design.counts.copy()
        design.add_best()
        site = task.grid.sites[int(np.argmax(design.counts - before))]
        points.append(next(p for p in rest if p.site == site))
        rest.remove(points[-1])
    return points, len(first)


def drawn(points: list[PlannedPoint], scale: float, runs: int, rng: np.random.Generator) -> Drawn:
    n = len(points)
    labels = [p.site.mount.installation for p in points]
    second = np.array([label == "2" for label in labels], dtype=np.int64)
    angle = np.tile([p.site.angle_rad for p in points], runs)
    stand = rng.normal(0.0, [TILT_RAD, TILT_RAD, MOUNT_RAD], (runs, 2, 3))[:, second].reshape(-1, 3)
    setting = scale * rng.normal(0.0, SETTING_RAD, runs * n)
    tilt, offset, mount = stand.T
    force = specific_force(labels * runs, angle, tilt, offset, mount, setting).reshape(runs, n, 3)
    own = K + rng.normal(0.0, SPREAD, (runs, 3, 3)), U0 + rng.normal(0.0, SPREAD, (runs, 3))
    signals = force @ np.swapaxes(own[0], 1, 2) + own[1][:, None]
    signals = signals + scale * rng.normal(0.0, READING_V, signals.shape)
    return Drawn(points, signals, np.concatenate([own[0].reshape(runs, 9), own[1]], axis=1), scale)


def calibrated(chooser: Chooser, data: Drawn, count: int, which: np.ndarray, known: bool = False) -> Batch:
    signals = data.signals[which, :count]
    conditions = table_of(data.points[:count], signals[0]).conditions()
    noise = Noise(data.scale * READING_V, data.scale * SETTING_RAD, float("inf"), "given") if known else None
    return calibrate_batch(signals, conditions, chooser.stand.model, chooser.stand.sizes, noise)


def ratio_of(chooser: Chooser, covariance: np.ndarray) -> np.ndarray:
    """The largest ratio (runs,) of u to what is asked, of `covariance` (runs, 12, 12)."""
    ratios = [
        np.einsum("ki,uij,kj->u", goal.functionals, covariance, goal.functionals) / goal.asked**2
        for goal in (wanted.goal for wanted in chooser.aim.wanted)
    ]
    return np.asarray(np.sqrt(np.max(ratios, axis=0)))


@dataclass(frozen=True)
class Stopped:
    """z (runs, 12) at the stop, with a number of settings that was fixed, and with known noise; whether it was
    reached, and settings (runs,)."""

    z: np.ndarray
    fixed: np.ndarray
    known: np.ndarray
    reached: np.ndarray
    settings: np.ndarray


def stopped(chooser: Chooser, data: Drawn, first: int, step: int) -> Stopped:
    runs, n = data.signals.shape[:2]
    z, settings = np.zeros((runs, 12)), np.full(runs, n)
    reached, going = np.zeros(runs, dtype=bool), np.arange(runs)
    for count in [*range(first, n, step), n]:
        found = calibrated(chooser, data, count, going)
        z[going] = (found.coefficients - data.truth[going]) / found.u
        enough = ratio_of(chooser, found.covariance) <= 1.0
        settings[going], reached[going[enough]] = count, True
        going = going[~enough]
        if not len(going):
            break
    every, mean = np.arange(runs), round(float(np.mean(settings)))
    others = [calibrated(chooser, data, mean, every, known) for known in (False, True)]
    fixed, known = ((other.coefficients - data.truth) / other.u for other in others)
    return Stopped(z, fixed, known, reached, settings)


def row(name: str, parts: list[Stopped]) -> str:
    def rms(z: np.ndarray) -> str:
        by_run = np.mean(z**2, axis=1)
        size = float(np.sqrt(by_run.mean()))
        return f"{size:8.3f} ±{by_run.std(ddof=1) / np.sqrt(len(z)) / (2 * size):.3f}"

    z, fixed, known, reached, settings = (
        np.concatenate([getattr(part, name) for part in parts]) for name in Stopped.__dataclass_fields__
    )
    return (
        f"{name:>6}{len(z):7}{rms(z)}{np.mean(np.abs(z) <= 2):8.4f}{rms(fixed)}"
        f"{np.mean(np.abs(fixed) <= 2):8.4f}{rms(known)}{np.mean(reached):9.3f}{np.mean(settings):9.2f}"
    )


def main() -> int:
    asked = arguments(
        __doc__,
        runs=(2500, "for each size of the noise"),
        seed=1,
        step=3,
        goal=["all=5e-5"],
        noise=list(NOISES),
    )
    chooser = chooser_for(asked.goal)
    points, first = order_of(chooser)
    print(
        f"{' '.join(asked.goal)}, {len(points)} settings, from {first} on each {asked.step}, seed {asked.seed}"
    )
    print(
        f"{'noise':>6}{'runs':>7}{'stopped':>8}{'':7}{'k = 2':>8}{'fixed':>8}{'':7}{'k = 2':>8}{'known':>8}{'':7}"
        f"{'reached':>9}{'settings':>9}"
    )
    parts = []
    for number, scale in enumerate(asked.noise):
        data = drawn(points, scale, asked.runs, np.random.default_rng([asked.seed, number]))
        parts.append(stopped(chooser, data, first, asked.step))
        print(row(f"{scale:g}", parts[-1:]), flush=True)
    print(row("all", parts))
    z = np.concatenate([part.z for part in parts])
    return 0 if 0.93 <= np.sqrt(np.mean(z**2)) <= 1.07 and np.mean(np.abs(z) <= 2) >= 0.93 else 1


if __name__ == "__main__":
    raise SystemExit(main())
