"""Test the stated risks of wrong verdicts on simulated calibrations and verifications with known truth.

    python -m benchmarks.verdict_risk --runs 4000 --joint 1500 --seed 1
    python -m benchmarks.verdict_risk --blocks 700 --seed 1

Each run is the paper's procedure on a stand whose errors have the sizes that the fit assumes (the limits of
the paper as three sigma; voltmeter noise `--noise`, V, which the fit does not know), followed by readings at
the verification points. At each point the modulus has a true error of its own, uniform within the limit plus
four u, so that its posterior distribution is that of JCGM 106 without prior knowledge. The program calibrates
and verifies as usual; geometry and truth are this benchmark's own. The points are sorted into steps of the
stated risk: of a false acceptance for accepted points, of a false rejection for rejected points. The mean
stated risk and the fraction of wrong decisions are printed for each step. Promised for risks of 0.5 to 50 %:
agreement within 10 % or 0.002, whichever is more, with a margin of three standard errors of the counts (runs
are independent, points of a run are not). `--joint`: the same for the four points of a pass, accepted
together.

`--blocks`: blocks with true errors from a population (`POPULATION`) that is stated to the verification, each
calibrated and verified once, by the default rule. With `--apart`, each of the four points has its own error
instead of a common one. In five declared bins of the stated risk (`BINS`), the number of wrong decisions must
be within the limits of its distribution (Poisson-binomial), at 1 % over all bins (Holm). The exit status is 1
if a promise is broken.
"""

import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.calibration import calibrate
from bench.calibration.conformity import SIMPLE, Population
from bench.calibration.verification import verify
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import Readings, make_readings
from bench.results.verification import VerdictPart, verdict_members
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, U0, K
from benchmarks.blind_trial.stand import specific_force
from benchmarks.campaign import amiss, arguments

SIZES: Final = {**STAND_U, "setting_error": SETTING_U_RAD, "voltmeter_error": 1e-4}
LIMIT_G: Final = 3e-4
MODEL: Final = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
TURN: Final = np.radians(np.arange(9) * 45.0)
CHECKED: Final = np.radians([45.0, 135.0, 225.0, 315.0])
CHECKS: Final = 60
"""Number of passes over the verification points."""
BEYOND_G: Final = 2.5e-4
"""Largest distance of true errors beyond the limit, g: four u of a reading there."""
POPULATION: Final = Population(5e-5, 1.5e-4)
BINS: Final = (0.0, 0.01, 0.04, 0.12, 0.25, 1.0)
LEVEL: Final = 0.01
STEPS: Final = (0.005, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5)


@dataclass(frozen=True)
class Decided:
    """The decisions of one run: the stated probability that each is wrong, and whether it was."""

    stated: Floats
    wrong: Mask


def simulate(rng: np.random.Generator, noise: float, errors: Floats) -> Readings:
    """Return the readings of a run with true errors (passes, 4) of the modulus at its verification points, g."""
    rows, force = [], []
    tilt, offset = (rng.normal(0, SIZES[name]) for name in ("axis_tilt", "zero_offset"))
    for label in ("1", "2"):
        mounting = rng.normal(0, SIZES["mounting_error"])
        for number in (1, 2, 3):
            settings = TURN + offset + rng.normal(0, SIZES["setting_error"], 9)
            force.append(specific_force(np.array([label] * 9), settings, tilt, mounting))
            rows += [(label, number, point + 1, TURN[point]) for point in range(9)]
    for number in range(len(errors)):
        exact = specific_force(np.array(["V"] * 4), CHECKED + offset, tilt)
        force.append(exact * (1.0 + errors[number, :, None]))
        rows += [("V", number + 1, point + 1, CHECKED[point]) for point in range(4)]
    signal = np.concatenate(force) @ K.T + U0
    signal += rng.normal(0, noise, signal.shape)
    labels, numbers, points, angles = zip(*rows, strict=True)
    return make_readings(list(labels), list(numbers), list(points), np.array(angles), signal)


def run(seed: int, number: int, noise: float, joint: int) -> tuple[Decided, Decided, Decided]:
    """Return the decisions of a run: accepted points, rejected points, and up to `joint` wholly accepted passes."""
    rng = np.random.default_rng([seed, number])
    errors = rng.uniform(-LIMIT_G - BEYOND_G, LIMIT_G + BEYOND_G, (CHECKS, 4))
    readings, errors = simulate(rng, noise, errors), errors.ravel()
    found = calibrate(readings, MODEL, SIZES, 9.81)
    told = found.block, found.covariance, found.noise.widened().reading, LIMIT_G, 1.0, SIMPLE
    points = verify(readings, *told).points
    bad = np.abs(errors) > LIMIT_G
    accepted = np.array([p.p_false_accept for p in points], dtype=np.float64)
    rejected = np.array([p.p_false_reject for p in points], dtype=np.float64)
    taken, refused = np.isfinite(accepted), np.isfinite(rejected)
    whole: list[tuple[float, bool]] = []
    for number_of_pass, first in enumerate(range(0, 4 * CHECKS, 4), start=1):
        if len(whole) < joint and taken[first : first + 4].all():
            own = readings.select((readings.installation == "V") & (readings.pass_number == number_of_pass))
            whole.append((verify(own, *told).p_outside, bool(bad[first : first + 4].any())))
    together = Decided(np.array([p for p, _ in whole]), np.array([b for _, b in whole], dtype=np.bool_))
    return (Decided(accepted[taken], bad[taken]), Decided(rejected[refused], ~bad[refused]), together)


def compared(what: str, runs: list[Decided]) -> list[str]:
    """Print stated and counted risks for each step; return those that deviate by more than promised."""
    broken = []
    print(f"{what}\n{'stated risk':>14}{'decisions':>11}{'stated':>9}{'wrong':>9}{'±':>9}{'promised':>10}")
    for low, high in pairwise(STEPS):
        chosen = [(one, (one.stated >= low) & (one.stated < high)) for one in runs]
        sums = np.array([(c.sum(), one.stated[c].sum(), one.wrong[c].sum()) for one, c in chosen])
        count, stated, wrong = sums.sum(axis=0)
        if not count:
            continue
        stated, wrong, error = stated / count, wrong / count, np.linalg.norm(sums[:, 2] - sums[:, 1]) / count
        allowed = max(0.1 * wrong, 0.002)
        print(f"{low:7.3f}–{high:<6.3f}{count:11.0f}{stated:9.4f}{wrong:9.4f}{error:9.4f}{allowed:10.4f}")
        if abs(stated - wrong) > allowed + 3 * error:
            broken.append(f"{what}: stated {stated:.4f}, wrong {wrong:.4f} in {low:g}–{high:g}")
    return broken


def of_population(seed: int, number: int, noise: float, *, alike: bool) -> tuple[float, bool]:
    """Return the stated risk of the decision on a block of the population, and whether the decision was wrong."""
    rng = np.random.default_rng([seed, number])
    errors = rng.normal(POPULATION.mean, POPULATION.standard_deviation, (1, 1 if alike else 4))
    errors = np.broadcast_to(errors, (1, 4))
    readings = simulate(rng, noise, errors)
    found = calibrate(readings, MODEL, SIZES, 9.81)
    noise_u = found.noise.widened().reading
    decided = verify(readings, found.block, found.covariance, noise_u, LIMIT_G, population=POPULATION)
    verdict = VerdictPart.from_object(decided, **verdict_members(decided)).to_dict()
    accepted = verdict["p_false_accept"] is not None
    bad = bool(np.any(np.abs(errors) > LIMIT_G))
    return verdict["p_false_accept" if accepted else "p_false_reject"], bad is accepted


def within_chance(stated: Floats, wrong: Mask) -> list[str]:
    """Print stated and counted risks in the declared bins; return those that chance does not explain (Holm)."""
    rows = []
    print(f"{'stated risk':>14}{'decisions':>11}{'stated':>9}{'wrong':>9}{'p':>9}")
    for low, high in pairwise(BINS):
        chosen = (stated >= low) & ((stated < high) | (high == BINS[-1]))
        if not chosen.any():
            continue
        p = two_sided(stated[chosen], int(wrong[chosen].sum()))
        means = f"{stated[chosen].mean():9.4f}{wrong[chosen].mean():9.4f}"
        row = f"{low:7.3f}–{high:<6.3f}{int(chosen.sum()):11d}{means}"
        print(f"{row}{p:9.4f}")
        rows.append((p, row))
    rows.sort()
    kept = next((i for i, (p, _) in enumerate(rows) if p >= LEVEL / (len(BINS) - 1 - i)), len(rows))
    return [f"{row} p = {p:.1e}" for p, row in rows[:kept]]


def two_sided(probabilities: Floats, count: int) -> float:
    """Return the two-sided p-value of a count of events with these probabilities (Poisson-binomial)."""
    mass = np.ones(1)
    for p in probabilities:
        mass = np.convolve(mass, [1.0 - p, p])
    return float(min(1.0, 2.0 * min(mass[: count + 1].sum(), mass[count:].sum())))


def judge_blocks(blocks: int, seed: int, noise: float, *, alike: bool) -> list[str]:
    """Print the fractions of wrong decisions on blocks of the population; return the broken promises."""
    drawn = [of_population(seed, number, noise, alike=alike) for number in range(blocks)]
    how = "one error for all points" if alike else "an error for each point"
    print(f"{blocks} blocks of the population, {how}")
    stated, wrong = (np.array(one) for one in zip(*drawn, strict=True))
    return within_chance(stated, wrong)


def main(argv: list[str] | None = None) -> int:
    given = arguments(__doc__, argv, runs=4000, joint=(1500, "verdicts on four points together"),
        blocks=(int, "blocks of a stated population, in place of all else"),
        apart=(False, "an error for each point of a block"), noise=0.0001, seed=1,
    )  # fmt: skip
    begun = time.perf_counter()
    if given.blocks:
        broken = judge_blocks(given.blocks, given.seed, given.noise, alike=not given.apart)
        print(f"seed {given.seed}, noise {given.noise:g} V: {time.perf_counter() - begun:.0f} s")
        return amiss(broken, "BROKEN:")
    found: tuple[list[Decided], list[Decided], list[Decided]] = ([], [], [])
    left = given.joint
    for number in range(given.runs):
        decided = run(given.seed, number, given.noise, min(left, 2))
        left -= len(decided[2].stated)
        for of_all, one in zip(found, decided, strict=True):
            of_all.append(one)
    names = ("false acceptance, points", "false rejection, points", "false acceptance, four points together")
    broken = [line for name, runs in zip(names, found, strict=True) for line in compared(name, runs)]
    print(
        f"{given.runs} runs, seed {given.seed}, noise {given.noise:g} V: {time.perf_counter() - begun:.0f} s"
    )
    return amiss(broken, "BROKEN:")


if __name__ == "__main__":
    sys.exit(main())
