"""How fast are the estimators, beside what a user would take instead? All in one run, on the paper's design.

    python -m benchmarks.estimator_speed --units 2000

Side by side for 54 readings (2 installations, 9 angles, 3 passes): the default fit with its covariance beside
`scipy.optimize.least_squares` with 18 parameters and priors, its covariance from the Jacobian, the noise given to
both; the fit with the noise estimated; `calibrate` as a program calls it (checks, noise sizes, fit, covariance,
look for outliers, components that repeats share), the same by the other estimators; the whole result with every
source of the budget (62 readings, 8 of them verification points); the batch. For imucal's Ferraris calibration
six positions and the rotations that it needs; it gives no uncertainty. Medians of processor time, taken in turns.
Exit status 1 when a promise is broken: a fit with covariance in less than 5 ms and three times as fast as scipy,
the whole result in less than 50 ms, the batch 20 times faster than a loop.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import least_squares

from bench.calibration import Noise, calibrate
from bench.calibration.calibrate import first_guess
from bench.calibration.design import make_problem
from bench.calibration.gls import fit
from bench.readings.table import Readings
from benchmarks.campaign import arguments
from benchmarks.many_units import calibrate_batch
from benchmarks.signed_uncertainty import Calibrator
from tests.support.honest_runs import MODEL, simulate_many
from tests.support.paper_bench import SETTING_U_RAD, STAND_U, TRUTH, design, simulate, specific_force
from tests.support.whole_truth import simulate_whole

NOISE_V = 1e-4
FIT = "fit with covariance, noise given"
SCIPY = "scipy least_squares, 18 parameters with priors, noise given"
DEFAULT = "calibrate, gls (default), noise estimated"
WHOLE = "the whole result, every source of the budget"
FIT_MS, SCIPY_RATIO, WHOLE_MS, BATCH_RATIO = 5.0, 3.0, 50.0, 20.0


def medians_ms(calls: Mapping[str, Callable[[int], object]], times: int) -> dict[str, float]:
    """Return the median processor time of each, taken in turns, so that a busy machine is busy for all."""
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for k in range(times):
        for name, call in calls.items():
            start = time.process_time()
            call(k)
            spent[name].append(1e3 * (time.process_time() - start))
    return {name: statistics.median(each) for name, each in spent.items()}


def by_scipy(readings: Readings) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients and u as a user's own script would: 12 coefficients, 6 angles with priors."""
    installation, _, _, phi = design()
    second = np.array(installation) == "2"
    prior = np.tile(list(STAND_U.values()), 2)
    # the noise of each signal is given: setting error through the derivative at the nominal block
    h = 1e-5
    K = TRUTH[:9].reshape(3, 3)
    slope = (
        (specific_force(installation, phi, alpha4=h) - specific_force(installation, phi, alpha4=-h))
        @ K.T
        / (2 * h)
    )
    covariances = NOISE_V**2 * np.eye(3) + SETTING_U_RAD**2 * np.einsum("ni,nj->nij", slope, slope)
    whitening = np.linalg.inv(np.linalg.cholesky(covariances))
    sine, cosine = np.sin(phi), np.cos(phi)

    def left(p: np.ndarray) -> np.ndarray:
        angles = np.where(second[:, None], p[15:], p[12:15])
        a1, a2, a3 = angles.T
        # the paper's (3)-(4), first order
        along = sine + a2 * cosine
        across, up = a1 - a3 * sine, cosine - a2 * sine
        force = np.where(second[:, None], np.stack([-along, up, across], 1), np.stack([along, across, up], 1))
        residual = readings.signal - force @ p[:9].reshape(3, 3).T - p[9:12]
        return np.concatenate([np.einsum("nij,nj->ni", whitening, residual).ravel(), p[12:] / prior])

    start = np.concatenate([np.diag([-2.2, -2.1, -2.1]).ravel(), np.zeros(9)])
    found = least_squares(left, start, x_scale=np.concatenate([np.ones(12), prior]))
    covariance = np.linalg.inv(np.asarray(found.jac).T @ np.asarray(found.jac))
    return found.x[:12], np.sqrt(np.diag(covariance))[:12]


def by_imucal() -> Callable[[int], object] | None:
    """Return a call of imucal's Ferraris calibration on six positions of 100 samples; None if not installed."""
    try:
        import pandas as pd
        from imucal import FerrarisCalibration, ferraris_regions_from_df
    except ImportError:
        return None
    rng = np.random.default_rng(1)
    parts = ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a", "x_rot", "y_rot", "z_rot")
    up = {name: (-1.0 if name[2:] == "a" else 1.0) * np.eye(3)["xyz".index(name[0])] for name in parts}
    rows = []
    for name in parts:
        turn = 360.0 * np.eye(3)["xyz".index(name[0])] if name.endswith("rot") else np.zeros(3)
        both = np.concatenate([9.81 * up[name], turn]) + rng.normal(0, 1e-3, (100, 6))
        rows.append(
            pd.DataFrame(both, columns=["acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]).assign(
                part=name
            )
        )
    regions = ferraris_regions_from_df(pd.concat(rows).set_index("part"))

    def call(_: int) -> object:
        return FerrarisCalibration().compute(
            regions, sampling_rate_hz=100.0, from_acc_unit="m/s^2", from_gyr_unit="deg/s"
        )

    return call


def agreement(tables: list[Readings]) -> float:
    """Return the largest difference of the default's coefficients from scipy's, in u; the noise given to both."""
    given = Noise(NOISE_V, SETTING_U_RAD, np.inf, "given")
    largest = 0.0
    for table in tables:
        value, u = by_scipy(table)
        ours = calibrate(table, MODEL, STAND_U, 9.81, noise=given).block.vector
        largest = max(largest, float(np.max(np.abs(ours - value) / u)))
    return largest


def of_fits(tables: list[Readings]) -> dict[str, Callable[[int], object]]:
    """Return the fit alone, as `calibrate` calls it: the noise given, and estimated from the repeats."""
    problems = [make_problem(MODEL, t.conditions(), STAND_U) for t in tables]
    starts = [first_guess(p, t.signal) for p, t in zip(problems, tables, strict=True)]
    given = Noise(NOISE_V, SETTING_U_RAD, np.inf, "given")
    return {
        FIT: lambda k: fit(problems[k], tables[k].signal, starts[k], given),
        "fit with covariance, noise estimated": lambda k: fit(problems[k], tables[k].signal, starts[k]),
    }


def main() -> int:
    given = arguments(__doc__, units=(2000, "units of the batch"), times=(60, "calls of each"))
    tables = [simulate(np.random.default_rng([3, k]), NOISE_V) for k in range(given.times)]
    runs = [simulate_whole(np.random.default_rng([4, k]), "stand").readings for k in range(given.times)]
    whole = Calibrator()

    def by(estimator: str) -> Callable[[int], object]:
        return lambda k: calibrate(tables[k], MODEL, STAND_U, 9.81, estimator)

    calls = {**of_fits(tables), SCIPY: lambda k: by_scipy(tables[k])}
    calls |= {DEFAULT: by("gls")}
    calls |= {f"calibrate, {name}": by(name) for name in ("robust", "least-squares", "closed-form")}
    calls |= {WHOLE: lambda k: whole.of(runs[k])}
    ms = medians_ms(calls, given.times)
    for name, each in ms.items():
        print(f"{name:62}{each:8.2f} ms")
    imucal = by_imucal()
    if imucal is None:
        print("imucal: not installed (pip install imucal)")
    else:
        print(
            f"{'imucal Ferraris, six positions and rotations':62}{medians_ms({'': imucal}, 20)['']:8.2f} ms"
        )
    signals, conditions = simulate_many(5, given.units, NOISE_V), tables[0].conditions()
    batch = {"": lambda _: calibrate_batch(signals, conditions, MODEL, STAND_U)}
    each = medians_ms(batch, 3)[""] / given.units
    print(f"{f'batch of {given.units}, per unit, noise estimated':62}{each:8.4f} ms")
    ratio = ms[SCIPY] / ms[FIT]
    print(f"the fit is {ratio:.1f} times as fast as scipy")
    print(f"a loop of the default takes {ms[DEFAULT] / each:.0f} times as long as the batch")
    print(
        "largest difference from scipy's, which is of first order, the same noise given to both: "
        f"{agreement(tables[:20]):.3f} u"
    )
    held = (
        ms[FIT] < FIT_MS
        and ratio >= SCIPY_RATIO
        and ms[WHOLE] < WHOLE_MS
        and ms[DEFAULT] / each >= BATCH_RATIO
    )
    print(
        "every promise holds"
        if held
        else f"broken: a fit in {FIT_MS:.0f} ms, {SCIPY_RATIO:.0f} times as fast as scipy, {WHOLE_MS:.0f} ms for "
        f"the whole, {BATCH_RATIO:.0f} times for the batch are promised"
    )
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
