"""Test the results of runs that stop at a goal, and their duration, on simulated runs with known truth.

    python -m benchmarks.until_campaign --runs 2500 --seed 1 --workers 2
    python -m benchmarks.until_campaign --runs 500 --seed 2 --goal vector=6.83e-5

Each run draws a size of the noise (one of the fractions `--noise` of the bench file's, equally often), a
block near the paper's, and a stand. It takes the readings that `bench.planning.choice` chooses from the
paper's procedure, step by step, as `bench run --until` does; geometry and noise are not the application's. It
stops when the u from a calibration of the readings so far reaches the goal. For all runs and by noise, the
campaign prints: rms of z = (estimate - truth)/u over the twelve coefficients at the stop (wanted: 0.93 to
1.07) with its standard error over runs; coverage of k = 2 (wanted: at least 0.93); the runs that reached the
goal; settings; and mean bench time divided by that of the best fixed plan for the same goal and known noise
(wanted: at most 1.10).
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bench.calibration import CalibrationError
from bench.calibration.calibrate import calibrate
from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import Calibration
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.planning.choice import REACHED, Chooser, NextPoints, Standing, scale_of
from bench.planning.pool import DesignTask, PlannedPoint, Visits, reached_by
from bench.readings.table import Readings, make_readings
from bench.services.until import chooser_of
from bench.validation.paper_bench import U0, K, specific_force
from benchmarks.campaign import arguments, parts_of, rms_told

NOISES = (0.5, 0.7, 1.0, 1.2)
ARCSEC = np.pi / 180 / 3600
READING_V, SETTING_RAD = 1e-4, 10 * ARCSEC / 3
TILT_RAD, MOUNT_RAD = 5 * ARCSEC / 3, 90 * ARCSEC / 3
SPREAD = 0.02
"""Standard deviation of a block's coefficients about those of the paper's block, g and V."""
LARGEST_LOOKS = 60


@dataclass(frozen=True)
class World:
    """The truth of a run: the block, the errors of the stand in each installation, its noise."""

    K: np.ndarray
    U0: np.ndarray
    stand: dict[str, np.ndarray]
    scale: float
    rng: np.random.Generator

    @classmethod
    def drawn(cls, rng: np.random.Generator, scale: float) -> World:
        sizes = [TILT_RAD, TILT_RAD, MOUNT_RAD]
        stand = {label: rng.normal(0.0, sizes) for label in ("1", "2")}
        block = K + rng.normal(0.0, SPREAD, (3, 3)), U0 + rng.normal(0.0, SPREAD, 3)
        return cls(*block, stand, scale, rng)

    def measured(self, points: list[PlannedPoint]) -> Readings:
        """Return readings at the points, in order; the head is at the angle it shows plus its error."""
        labels = [p.site.mount.installation for p in points]
        angle = np.array([p.site.angle_rad for p in points])
        errors = np.array([self.stand[label] for label in labels]).T
        setting = self.scale * self.rng.normal(0.0, SETTING_RAD, len(points))
        force = specific_force(labels, angle, errors[0], errors[1], errors[2], setting)
        noise = self.scale * self.rng.normal(0.0, READING_V, (len(points), 3))
        return table_of(points, force @ self.K.T + self.U0 + noise)

    @property
    def truth(self) -> np.ndarray:
        return np.concatenate([self.K.ravel(), self.U0])


def table_of(points: list[PlannedPoint], signal: np.ndarray) -> Readings:
    return make_readings(
        [p.site.mount.installation for p in points], [p.pass_number for p in points],
        [p.site.point for p in points], np.array([p.site.angle_rad for p in points]), signal,
        source="simulated", direction=[p.site.direction for p in points],
    )  # fmt: skip


@dataclass(frozen=True)
class Ended:
    """The end of a run: z of the twelve coefficients, whether it reached the goal, settings, and times, s.

    The times are the total time, and the time of settings and mountings.
    """

    scale: float
    z: np.ndarray
    reached: bool
    settings: int
    time_s: float


def chooser_for(goals: list[str]) -> Chooser:
    plan = load_procedure(find_procedure("paper")).expand()
    return chooser_of(plan, load_bench(find_bench("paper-stand")), goals)


def calibrated(readings: Readings, chooser: Chooser) -> Calibration:
    return calibrate(readings, chooser.stand.model, chooser.stand.sizes, 9.81)


def run_until(chooser: Chooser, world: World, first: NextPoints | None = None) -> Ended:
    """Take readings until the choice is to stop; `first` is the choice before there are readings."""
    standing, points, signals = Standing(), [], []
    spent_s = chooser.pool.always_s
    for look in range(LARGEST_LOOKS):
        choice = first if first is not None and look == 0 else chooser.choose(standing)
        if choice.stop:
            break
        new = list(choice.points)
        points += new
        signals.append(world.measured(new).signal)
        spent_s += choice.next_s
        readings = table_of(points, np.concatenate(signals))
        standing = Standing(
            choice.visit, frozenset(p.steps[0] for p in points), Counter(p.site for p in points), spent_s,
            scale_of(chooser.stand, readings),
        )  # fmt: skip
        try:
            found = calibrated(readings, chooser)
        except CalibrationError:
            continue
        stated = found.covariance_readings
        standing = replace(standing, reached=reached_by(chooser.aim, stated, found.covariance))
    else:
        raise RuntimeError("it does not stop")
    z = (found.block.vector - world.truth) / np.sqrt(np.diag(found.covariance_readings))
    return Ended(world.scale, z, choice.stop == REACHED, len(points), spent_s)


class KnownNoise(Visits):
    """Series of readings whose noise is known, so that u is not widened."""

    @property
    def wider(self) -> float:
        return 1.0


def best_fixed(chooser: Chooser, scale: float) -> list[PlannedPoint]:
    """Return the fewest points that reach the goals at known noise, found by exchanges."""
    task: DesignTask = replace(chooser.task(Standing()), scale=scale)
    most, least = task.left, LEAST_REPEATS

    def design(counts: np.ndarray) -> KnownNoise:
        return KnownNoise(task.candidates, task.goals, counts, counts * 0, most)

    def shrunk(wide: bool) -> np.ndarray:
        found = design(most * 0)
        while not found.is_enough(least) and not found.is_full:
            first = found.largest > 1 if wide else not found.determined
            if first or found.repeats >= least or not found.add_repeat():
                found.add_best()
        found.drop_needless(least)
        reached = found.counts.copy()
        while found.is_enough(least):
            reached = found.counts.copy()
            found.drop_least()
            if not found.is_enough(least):
                found.exchange()
        return reached

    reached = min((shrunk(True), shrunk(False)), key=lambda counts: counts.sum())
    left = dict(zip(task.grid.sites, reached.tolist(), strict=True))
    points = []
    for point in chooser.pool.points:
        if left[point.site] > 0:
            left[point.site] -= 1
            points.append(point)
    return points


def time_of(chooser: Chooser, points: list[PlannedPoint]) -> float:
    mounts = {p.site.mount for p in points}
    own = sum(v.time_s for v in chooser.pool.visits if v.mount in mounts)
    return chooser.pool.always_s + own + sum(p.time_s for p in points)


def part(goals: list[str], noises: list[float], seed: int, numbers: range) -> list[Ended]:
    """Carry out the runs with these numbers."""
    chooser = chooser_for(goals)
    first = chooser.choose(Standing())
    found = []
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        scale = noises[number % len(noises)]
        found.append(run_until(chooser, World.drawn(rng, scale), first))
    return found


def row(name: str, ended: list[Ended], fixed_s: float, settings: float) -> str:
    z, time_s = np.array([e.z for e in ended]), np.array([e.time_s for e in ended])
    u_time = time_s.std(ddof=1) / np.sqrt(len(z)) / fixed_s
    return (
        f"{name:>6}{len(z):6}{rms_told(z, by_run=True):>15}{np.mean(np.abs(z) <= 2):9.4f}"
        f"{np.mean([e.reached for e in ended]):9.3f}{np.mean([e.settings for e in ended]):9.2f}{settings:8.1f}"
        f"{time_s.mean() / fixed_s:8.3f} ±{u_time:.3f}"
    )


def whole_runs(asked: argparse.Namespace) -> bool:
    """Print the table of runs that choose their points; return whether all wanted limits hold."""
    run = partial(part, asked.goal, asked.noise, asked.seed)
    ended = [one for chunk in parts_of(run, asked.runs, asked.workers) for one in chunk]
    chooser = chooser_for(asked.goal)
    fixed = {scale: best_fixed(chooser, scale) for scale in asked.noise}
    times = {scale: time_of(chooser, points) for scale, points in fixed.items()}
    print(f"{' '.join(asked.goal)}, the paper's procedure ({chooser.pool.count} settings), seed {asked.seed}")
    print(
        f"{'noise':>6}{'runs':>6}{'rms z':>8}{'':7}{'k = 2':>9}{'reached':>9}{'settings':>9}{'known':>8}{'time':>8}"
    )
    for scale in asked.noise:
        own = [one for one in ended if one.scale == scale]
        print(row(f"{scale:g}", own, times[scale], len(fixed[scale])))
    known_s = float(np.mean([times[e.scale] for e in ended]))
    settings = float(np.mean([len(fixed[e.scale]) for e in ended]))
    print(row("all", ended, known_s, settings))
    slower = float(np.mean([e.time_s for e in ended])) / known_s
    z = np.array([e.z for e in ended])
    return bool(0.93 <= np.sqrt(np.mean(z**2)) <= 1.07 and np.mean(np.abs(z) <= 2) >= 0.93 and slower <= 1.10)


def main() -> int:
    asked = arguments(__doc__, runs=2500, seed=1, workers=1, goal=["all=5e-5"], noise=list(NOISES))
    return 0 if whole_runs(asked) else 1


if __name__ == "__main__":
    raise SystemExit(main())
