"""Statistics of the program's results: are the errors in simulated files as large as the stated u?"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np
from scipy import stats

from bench.base.arrays import Floats
from bench.calibration import calibrate
from bench.calibration.gls import ESTIMATOR
from bench.model.geometry import COEFFICIENTS
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from bench.validation.reference import MODEL
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family="statistics of own results", place="bench/calibration")

FILES, QUICK_FILES = 200, 60
NOISE_V: Final = 1e-4
SEED = 34
FALSE_ALARM: Final = 1e-5
"""Probability that one of the tests of this module fails by chance, divided equally between its two sides."""


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
    """Return `errors` for the number of files that the validation uses; the result is cached."""
    if "errors" not in context.shared:
        context.shared["errors"] = errors(QUICK_FILES if context.quick else FILES)
    found: tuple[Floats, Floats, Floats] = context.shared["errors"]
    return found


@check("coverage of U", "7.6", "", p_false=12 * FALSE_ALARM,
       source="binomial distribution; (11) is the truth, readings from a geometry of its own")  # fmt: skip
def coverage(context: Context) -> Iterator[Finding]:
    """Count how often the true value lies within U (k = 2), for each coefficient, in simulated files."""
    error, u, _ = counted(context)
    files = len(error)
    inside = np.sum(np.abs(error) <= 2.0 * u, axis=0)
    share = 2.0 * stats.norm.cdf(2.0) - 1.0
    # u of a noise that is itself estimated is wider, so that up to 97 % is what is meant
    least = int(stats.binom.ppf(FALSE_ALARM / 2.0, files, share))
    most = int(stats.binom.isf(FALSE_ALARM / 2.0, files, 0.97))
    for name, count in zip(COEFFICIENTS, inside.tolist(), strict=True):
        words = f"{count} of {files}"
        wanted = f"{least} to {most} of {files} (95.45 %)"
        yield Finding(least <= count <= most, words, of=name, expected=wanted)


@check("size of the errors", "7.6", "", p_false=2 * FALSE_ALARM,
       source="chi-square distribution")  # fmt: skip
def size_of_errors(context: Context) -> Iterator[Finding]:
    """Test whether the mean square of error divided by u is one, over the coefficients of simulated files."""
    error, u, _ = counted(context)
    # Kxx and Kyy are determined by readings of different channels: independent within a file
    for name in ("Kxx", "Kyy"):
        z = error[:, COEFFICIENTS.index(name)] / u[:, COEFFICIENTS.index(name)]
        low, high = (
            float(stats.chi2.ppf(q, len(z))) / len(z) for q in (FALSE_ALARM / 2.0, 1.0 - FALSE_ALARM / 2.0)
        )
        found = float(np.mean(z**2))
        yield Finding(
            0.94 * low <= found <= high, f"{found:.3f}", of=name, expected=f"{0.94 * low:.2f} to {high:.2f}"
        )


@check("lack of fit", "7.7.1", "", p_false=FALSE_ALARM, source="Kolmogorov-Smirnov test")
def lack_of_fit(context: Context) -> Finding:
    """Test whether the lack-of-fit p-value is uniformly distributed if the model is true."""
    _, _, p = counted(context)
    test = stats.kstest(p, "uniform")
    return Finding(
        bool(test.pvalue > FALSE_ALARM), f"p = {test.pvalue:.3g} of {len(p)} files", expected=f"p > {FALSE_ALARM:g}"
    )  # fmt: skip
