"""Published cases of the GUM and of its Supplement 1; statistics of the program's results.

The cases cover degrees of freedom, coverage factors, intervals, and the validation of linear propagation. The
sensitivities are written here, independent of the program.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.calibration import calibrate
from bench.calibration.budget.propagation import (
    Distributed,
    Propagated,
    coverage_factor,
    drawn,
    effective_dof,
    numerical_tolerance,
    summary,
    validate,
)
from bench.calibration.gls import ESTIMATOR
from bench.model import Distribution
from bench.model.geometry import COEFFICIENTS
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from bench.validation.reference import MODEL, agreement
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family=message("reference data"), place="bench/calibration/budget/propagation.py")

TRIALS: Final = 400_000
SEED_OFFSET = 0
"""Added to the seeds, to repeat the checks with other random numbers."""
FALSE_ALARM: Final = 1e-6
"""Bound of the probability that a case of Supplement 1 fails by chance; `_ends` explains it."""


def independent(value: ArrayLike, rows: ArrayLike, u: Floats, dof: ArrayLike = np.inf) -> Propagated:
    """Return the m outputs of n independent inputs, propagated linearly from `value`.

    `rows` (m, n) are the sensitivities, `u` (n,) the uncertainties of the inputs.
    """
    rows = np.atleast_2d(np.asarray(rows, float))
    parts = (rows * u) ** 2
    of_each = effective_dof(parts, np.broadcast_to(np.asarray(dof, float), parts.shape[1:]))
    return Propagated(np.atleast_1d(np.asarray(value, float)), (rows * np.square(u)) @ rows.T, of_each)


def together(value: Floats, rows: Floats, covariance: Floats, dof: float) -> Propagated:
    """Return the m outputs of n inputs that were estimated jointly and therefore are one source of error.

    `rows` (m, n) are the sensitivities, `covariance` (n, n) is that of the inputs.
    """
    whole = rows @ covariance @ rows.T
    return Propagated(value, whole, effective_dof(np.diag(whole)[:, None], [dof]))


def sampled(function: Callable[[Floats], Floats], draws: Floats, probability: float = 0.95) -> Distributed:
    """Return the Monte Carlo statistics of a `function` of n inputs from `draws` (trials, n)."""
    return summary(np.asarray(function(draws)).reshape(len(draws), -1), probability)


def draws_of(seed: int, *inputs: tuple[float, Distribution]) -> Floats:
    """Return draws (TRIALS, n) of n inputs, each with its mean and distribution."""
    rng = np.random.default_rng(seed + SEED_OFFSET)
    return np.stack([mean + drawn(d, (TRIALS,), rng) for mean, d in inputs], axis=-1)


# --- the GUM ----------------------------------------------------------------------------------------


@check("GUM H.1, end gauge", "7.6", "", source="JCGM 100:2008, H.1")
def end_gauge(context: Context) -> Iterator[Finding]:
    """Compute u, degrees of freedom and U99 of an end gauge from its six inputs."""
    # ls, mean difference, its random and systematic comparator effects, delta alpha, delta theta; nm
    u = np.array([25.0, 5.8, 3.9, 6.7, 1e-6 / np.sqrt(3.0), 0.05 / np.sqrt(3.0)])
    sensitivity = [1.0, 1.0, 1.0, 1.0, -50_000_623.0 * -0.1, -50_000_623.0 * 11.5e-6]
    result = independent(50_000_838.0, sensitivity, u, [18, 24, 5, 8, 50, 2])
    yield agreement("u (nm), printed 32", result.u, 32.0, 0.5)
    yield agreement("degrees of freedom, printed 16", np.floor(result.dof), 16.0, 1e-9)
    yield agreement("t for 99 %, printed 2.92", coverage_factor(16, 0.99), 2.92, 0.005)
    yield agreement(
        "U99 (nm), printed 93 from u rounded to 32", coverage_factor(16, 0.99) * result.u, 93.0, 1.0
    )


VOLTS: Final = np.array([5.007, 4.994, 5.005, 4.990, 4.999])
AMPERES: Final = np.array([19.663, 19.639, 19.640, 19.685, 19.678]) * 1e-3
PHASE: Final = np.array([1.0456, 1.0438, 1.0468, 1.0428, 1.0433])


def impedance(x: Floats) -> Floats:
    """Return R, X and Z from V, I and phi; the last axis of `x` has these three."""
    ratio = x[..., 0] / x[..., 1]
    return np.stack([ratio * np.cos(x[..., 2]), ratio * np.sin(x[..., 2]), ratio], axis=-1)


def linear_impedance() -> tuple[Propagated, Floats, Floats]:
    """Return GUM example H.2 by linear propagation, and mean (3,) and covariance (3, 3) of the inputs."""
    samples = np.stack([VOLTS, AMPERES, PHASE])
    mean, covariance = samples.mean(axis=1), np.cov(samples) / 5
    v, i, phi = mean
    c, s = np.cos(phi), np.sin(phi)
    jacobian = np.array(
        [[c / i, -v * c / i**2, -v / i * s], [s / i, -v * s / i**2, v / i * c], [1 / i, -v / i**2, 0]]
    )
    return together(impedance(mean), jacobian, covariance, 4), mean, covariance


@check("GUM H.2, impedance", "7.6", "", source="JCGM 100:2008, H.2, table H.4")
def impedance_case(context: Context) -> Iterator[Finding]:
    """Compute resistance, reactance and impedance, their u and correlations, from five observations."""
    linear, _, _ = linear_impedance()
    r = linear.correlation
    yield agreement("R, X, Z (ohm)", linear.value, [127.732, 219.847, 254.260], 5e-4)
    # the printed u come from correlation coefficients rounded to two and three digits
    yield agreement("u (ohm), printed from rounded correlations", linear.u, [0.071, 0.295, 0.236], 7e-4)
    yield agreement("correlations", [r[0, 1], r[0, 2], r[1, 2]], [-0.588, -0.485, 0.993], 5e-4)


T_C: Final = np.array(
    [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
)
B_C: Final = np.array(
    [-0.171, -0.169, -0.166, -0.159, -0.164, -0.165, -0.156, -0.157, -0.159, -0.161, -0.160]
)


@check("GUM H.3, thermometer", "7.6", "", source="JCGM 100:2008, H.3")
def thermometer(context: Context) -> Iterator[Finding]:
    """Fit the line of a thermometer's corrections, and its correction at 30 °C, to eleven observations."""
    columns = np.column_stack([np.ones(11), T_C - 20.0])
    gain = np.linalg.pinv(columns)
    s = np.sqrt(np.sum((B_C - columns @ gain @ B_C) ** 2) / 9)
    rows = np.vstack([gain, gain[0] + 10.0 * gain[1]])
    result = together(rows @ B_C, rows, s**2 * np.eye(11), 9)
    half_digit = np.array([5e-5, 5e-6, 5e-5])
    yield agreement("s (°C)", s, 0.0035, 5e-5)
    yield agreement("y1, y2, b(30 °C)", result.value, [-0.1712, 0.00218, -0.1494], half_digit)
    yield agreement("their u", result.u, [0.0029, 0.00067, 0.0041], half_digit)
    yield agreement("correlation", result.correlation[0, 1], -0.930, 5e-4)
    yield agreement("degrees of freedom", result.dof, [9.0] * 3, 1e-9)


# --- Supplement 1 -------------------------------------------------------------------------------------

UNIT_RECTANGLE: Final = Distribution(np.sqrt(3.0), "rectangular")
Sum = tuple[Sequence[Distribution], float, float, float, bool | None]
FOUR: Final[dict[str, Sum]] = {
    # inputs of mean zero, u of the sum, ends by Monte Carlo and linear, whether two digits validate the linear
    # (None: the ends differ by 0.04, the tolerance is 0.05, and 400,000 trials scatter by 0.009: chance decides)
    "normal, 9.2.2": ([Distribution(1.0)] * 4, 2.0, 3.92, 3.92, True),
    "rectangular, 9.2.3": ([UNIT_RECTANGLE] * 4, 2.0, 3.88, 3.92, None),
    "one dominates, 9.2.4": (
        [UNIT_RECTANGLE] * 3 + [Distribution(10 * np.sqrt(3.0), "rectangular")], 10.1, 17.0, 19.9, False,
    ),
}  # fmt: skip


def sum_of_four(name: str) -> tuple[Propagated, Distributed]:
    """Return the sum of four inputs, by linear propagation and by Monte Carlo."""
    inputs = FOUR[name][0]
    found = sampled(lambda x: np.asarray(x.sum(axis=-1)), draws_of(2, *((0.0, d) for d in inputs)))
    return independent(0.0, np.ones(4), np.array([d.u for d in inputs])), found


@check("Supplement 1, sums of four", "7.6", "", source="JCGM 101:2008, 9.2; tolerance by its 7.9",
       p_false=3 * FALSE_ALARM)  # fmt: skip
def sums(context: Context) -> Iterator[Finding]:
    """Propagate sums of four inputs by 400,000 trials; the ends of the 95 % interval must lie within the tolerance.

    The standard error of an end is 0.009 in all three cases. The tolerance is 0.05 (in the third 0.5), at
    least 5.5 standard errors: p < 4e-8 for each of two ends.
    """
    for name, (_, u, end, linear_end, valid) in FOUR.items():
        linear, found = sum_of_four(name)
        delta = numerical_tolerance(u)
        yield agreement(f"{name}, interval", found.symmetric[0], [-end, end], delta)
        yield agreement(f"{name}, linear", linear.expanded(0.95)[0], linear_end, delta)
        if valid is None:
            continue
        judged = bool(validate(linear, found, 2).validated[0])
        words = {True: "linear validated", False: "linear not validated"}
        yield Finding(judged == valid, words[judged], of=f"{name}, clause 8", expected=words[valid])


def mass_deviation(x: Floats) -> Floats:
    """Return the deviation (mg) of a weight from its nominal mass.

    The density terms vanish in linear propagation, but not in second order.
    """
    mass, difference, air, weight, reference = np.moveaxis(x, -1, 0)
    return np.asarray((mass + difference) * (1 + (air - 1.2) * (1 / weight - 1 / reference)) - 100_000.0)


def mass_calibration() -> tuple[Propagated, Distributed]:
    """Return the mass calibration of JCGM 101:2008, 9.3, by linear propagation and by Monte Carlo."""
    draws = draws_of(
        6,
        (100_000.0, Distribution(0.050)),
        (1.234, Distribution(0.020)),
        (1.2, Distribution(0.1, "rectangular")),
        (8000.0, Distribution(1000.0, "rectangular")),
        (8000.0, Distribution(50.0, "rectangular")),
    )
    u = np.array([0.050, 0.020, 0.0577, 577.0, 28.9])
    return independent(1.234, [1.0, 1.0, 0.0, 0.0, 0.0], u), sampled(mass_deviation, draws)


@check("Supplement 1, mass calibration", "7.6", "", source="JCGM 101:2008, 9.3; tolerance by its 7.9",
       p_false=FALSE_ALARM)  # fmt: skip
def mass(context: Context) -> Iterator[Finding]:
    """Propagate a mass calibration by 400,000 trials; check that linear propagation is found invalid.

    The standard error is 0.00012 mg for the estimate, 0.00008 mg for u, and 0.0005 mg for an end of the
    interval. The tolerance of one digit, 0.005 mg, is at least ten times as large.
    """
    linear, found = mass_calibration()
    delta = numerical_tolerance(0.0754, 1)
    yield agreement("estimate (mg)", found.mean, 1.2341, delta)
    yield agreement("u (mg)", found.u, 0.0754, delta)
    yield agreement("shortest 95 % interval (mg)", found.shortest[0], [1.0834, 1.3825], delta)
    yield agreement("first order, u (mg)", linear.u, 0.0539, 5e-5)
    judged = bool(validate(linear, found, 1).validated[0])
    yield Finding(
        not judged, "validated" if judged else "not validated", of="clause 8", expected="not validated"
    )


LOSS: Final[dict[tuple[float, float], tuple[float, float, float, float, float]]] = {
    # correlation and x1: y, u and ends of the shortest 95 % interval by Monte Carlo, first-order u, in 1e-6.
    # The ends are left out for x1 = 0.05: the length of the interval there hardly depends on its place.
    (0.0, 0.00): (50.0, 50.0, 0.0, 150.0, 0.0),
    (0.0, 0.01): (150.0, 112.0, 0.0, 367.0, 100.0),
    (0.0, 0.05): (2551.0, 502.0, math.nan, math.nan, 500.0),
    (0.9, 0.00): (50.0, 67.0, 0.0, 185.0, 0.0),
    (0.9, 0.01): (150.0, 121.0, 13.0, 398.0, 100.0),
    (0.9, 0.05): (2551.0, 505.0, math.nan, math.nan, 500.0),
}


@check("Supplement 1, comparison loss", "7.6", "", p_false=1e-4,
       source="JCGM 101:2008, 9.4, tables 8 and 9; tolerance by its 7.9")  # fmt: skip
def comparison_loss(context: Context) -> Iterator[Finding]:
    """Propagate the loss x1² + x2² of a power meter, for three values of x1, with and without correlation.

    The tolerance is 5e-6: one digit for x1 = 0, two for the others. The largest standard error is 1.1e-6, of the
    upper end for x1 = 0.01 and r = 0.9. The mean of this end is 0.7e-6 below the printed value, so the tolerance
    leaves 4 standard errors: p < 1e-4.
    """
    u = 5000.0
    for (r, x1), (y, u_y, low, high, first) in LOSS.items():
        a, b = draws_of(9, (0.0, Distribution(u)), (0.0, Distribution(u))).T
        x = 1e-6 * np.stack([1e6 * x1 + a, r * a + math.sqrt(1.0 - r**2) * b], axis=-1)
        found = sampled(lambda x: 1e6 * np.sum(x**2, axis=-1), x)
        linear = independent(1e6 * x1**2, [2.0 * x1, 0.0], np.array([u, u]))
        of = f"r = {r:g}, x1 = {x1:g}"
        yield agreement(f"{of}, y (1e-6)", found.mean, y, 5.0)
        yield agreement(f"{of}, u (1e-6)", found.u, u_y, 5.0)
        yield agreement(f"{of}, first order, u (1e-6)", linear.u, first, 1e-6)
        if math.isfinite(low):
            yield agreement(f"{of}, shortest 95 % interval (1e-6)", found.shortest[0], [low, high], 5.0)


def trapezoid(rng: np.random.Generator, limit: float, inexact: float) -> Floats:
    """Return draws (TRIALS,) of a rectangular distribution with inexact ends (JCGM 101:2008, 6.4.3).

    The ends are ±(`limit` ± `inexact`): the half-width varies uniformly within `inexact` of `limit`.
    """
    end = -limit + inexact * rng.uniform(-1.0, 1.0, TRIALS)
    return np.asarray(end - 2.0 * end * rng.random(TRIALS))


@check("Supplement 1, gauge block", "7.6", "", p_false=1e-5,
       source="JCGM 101:2008, 9.5, tables 10 and 11; tolerance by its 7.9")  # fmt: skip
def gauge_block(context: Context) -> Iterator[Finding]:
    """Propagate the calibration of a gauge block: t, rectangular, trapezoidal and U-shaped distributions.

    The standard errors of deviation and u are 0.06 nm and 0.04 nm; their tolerance is that of two digits, 0.5 nm.
    The standard error of an end of the interval is 0.9 nm, and its mean is 0.6 nm from the printed value. The
    tolerance of one digit, 5 nm, then leaves 4.7 standard errors: p < 1e-5.
    """
    rng = np.random.default_rng(10 + SEED_OFFSET)
    standard, mean, random, systematic = (
        drawn(Distribution(u), (TRIALS,), rng, dof)
        for u, dof in ((25.0, 18.0), (6.0, 24.0), (4.0, 5.0), (7.0, 8.0))
    )
    expansion = 11.5e-6 + rng.uniform(-2e-6, 2e-6, TRIALS)
    theta = -0.1 + drawn(Distribution(0.2), (TRIALS,), rng) + 0.5 * np.sin(2.0 * np.pi * rng.random(TRIALS))
    length = 50_000_623.0 + standard
    thermal = trapezoid(rng, 1e-6, 0.1e-6) * theta + expansion * trapezoid(rng, 0.05, 0.025)
    found = summary((length * (1.0 - thermal) + 215.0 + mean + random + systematic - 50e6)[:, None], 0.99)
    yield agreement("deviation (nm)", found.mean, 838.0, 0.5)
    yield agreement("u (nm)", found.u, 36.0, 0.5)
    yield agreement("shortest 99 % interval (nm)", found.shortest[0], [745.0, 932.0], 5.0)


@check("scaled t", "7.6", "", source="JCGM 101:2008, 6.4.9.4", p_false=FALSE_ALARM)
def scaled_t(context: Context) -> Finding:
    """Draw from a t distribution with ten degrees of freedom, and compare its spread.

    The relative standard error of the spread of 200,000 draws is sqrt((kurtosis - 1)/4N) = 0.0019. The
    tolerance of 1 % is 5.2 standard errors.
    """
    draws = drawn(Distribution(0.5), (200_000,), np.random.default_rng(2), 10.0)
    return agreement("", draws.std(), 0.5 * math.sqrt(10 / 8), 0.0056)


# --- statistics: are the errors of results in simulated files as large as the stated u? ------------------


statistic = partial(enter, family=message("statistics of own results"), place="bench/calibration")

FILES, QUICK_FILES = 200, 60
NOISE_V: Final = 1e-4
SEED = 34
CHANCE: Final = 1e-5
"""Probability that one of these tests fails by chance, divided equally between its two sides."""


def errors(count: int) -> tuple[Floats, Floats, Floats]:
    """Simulate `count` readings files; return errors and u of the coefficients, and p-values of lack of fit.

    The shapes are (count, 12), (count, 12) and (count,). Each file has its own stand angles and noise, drawn
    with the seed [`SEED`, number of the file].
    """
    error, u, p = [], [], []
    for number in range(count):
        readings = simulate(np.random.default_rng([SEED, number]), NOISE_V)
        found = calibrate(readings, MODEL, STAND_U, 9.81, ESTIMATOR.name)
        error.append(found.block.vector - TRUTH)
        u.append(found.u)
        p.append(found.lack_of_fit.p)
    return np.array(error), np.array(u), np.array(p)


def counted(context: Context) -> tuple[Floats, Floats, Floats]:
    """Return `errors(n)` for the number n of files that the validation simulates; the result is cached."""
    if "errors" not in context.shared:
        context.shared["errors"] = errors(QUICK_FILES if context.quick else FILES)
    found: tuple[Floats, Floats, Floats] = context.shared["errors"]
    return found


@statistic("coverage of U", "7.6", "", p_false=12 * CHANCE,
       source="binomial distribution; (11) is the truth, readings from a geometry of its own")  # fmt: skip
def coverage(context: Context) -> Iterator[Finding]:
    """Count how often the true value lies within U (k = 2), for each coefficient, in simulated files."""
    error, u, _ = counted(context)
    files = len(error)
    inside = np.sum(np.abs(error) <= 2.0 * u, axis=0)
    share = 2.0 * stats.norm.cdf(2.0) - 1.0
    # u of a noise that is itself estimated is wider, so that up to 97 % is what is meant
    least = int(stats.binom.ppf(CHANCE / 2.0, files, share))
    most = int(stats.binom.isf(CHANCE / 2.0, files, 0.97))
    for name, count in zip(COEFFICIENTS, inside.tolist(), strict=True):
        words = f"{count} of {files}"
        wanted = f"{least} to {most} of {files} (95.45 %)"
        yield Finding(least <= count <= most, words, of=name, expected=wanted)


@statistic("size of the errors", "7.6", "", p_false=2 * CHANCE,
       source="chi-square distribution")  # fmt: skip
def size_of_errors(context: Context) -> Iterator[Finding]:
    """Test whether the mean square of error divided by u is one, over the coefficients of simulated files."""
    error, u, _ = counted(context)
    # Kxx and Kyy are determined by readings of different channels: independent within a file
    for name in ("Kxx", "Kyy"):
        z = error[:, COEFFICIENTS.index(name)] / u[:, COEFFICIENTS.index(name)]
        low, high = (float(stats.chi2.ppf(q, len(z))) / len(z) for q in (CHANCE / 2.0, 1.0 - CHANCE / 2.0))
        found = float(np.mean(z**2))
        yield Finding(
            0.94 * low <= found <= high, f"{found:.3f}", of=name, expected=f"{0.94 * low:.2f} to {high:.2f}"
        )


@statistic("lack of fit", "7.7.1", "", p_false=CHANCE, source="Kolmogorov-Smirnov test")
def lack_of_fit(context: Context) -> Finding:
    """Test whether the lack-of-fit p-value is uniformly distributed if the model is true."""
    _, _, p = counted(context)
    test = stats.kstest(p, "uniform")
    return Finding(
        bool(test.pvalue > CHANCE), f"p = {test.pvalue:.3g} of {len(p)} files", expected=f"p > {CHANCE:g}"
    )  # fmt: skip
