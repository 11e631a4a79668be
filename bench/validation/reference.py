"""Reference data with published results: regressions, a check standard, real accelerometers, gravity."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from bench.base.arrays import Floats, least_squares
from bench.base.languages import message
from bench.calibration import calibrate
from bench.calibration.gls import solve_rows
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, normal_gravity_m_s2
from bench.readings.csv import read_csv
from bench.run.events import sha256
from bench.stats.control_charts import centre_of, ewma_arl, judge
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from bench.validation.registry import REFERENCE, Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family=message("reference data"))

MODEL: Final = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
"""The paper's two installations without effects."""


def agreement(of: str, found: ArrayLike, expected: ArrayLike, tolerance: ArrayLike) -> Finding:
    """Return the finding on numbers that must equal `expected` (same shape) within a tolerance."""
    mine, theirs = np.atleast_1d(np.asarray(found, float)), np.atleast_1d(np.asarray(expected, float))
    share = np.abs(mine - theirs) / np.asarray(tolerance, float)
    worst = int(np.argmax(share))
    words = f"{mine[worst]:.12g}" if len(mine) == 1 else f"all {len(mine)} agree, the worst {mine[worst]:.9g}"
    passed = bool(np.all(share <= 1.0)) and bool(np.all(np.isfinite(mine)))
    if not passed:
        words = f"{mine[worst]:.12g} (number {worst + 1} of {len(mine)})"
    limit = np.broadcast_to(np.asarray(tolerance, float), mine.shape)[worst]
    return Finding(passed, words, of=of, expected=f"{theirs[worst]:.12g} ± {limit:.2g}")


FILES: Final = {
    "strd.json": "0d296ad04155c6bdd3f1767518129b2bf3f28b2bb4c9d29a4b6d805a95fb5423",
    "kilogram-check.csv": "e8b4145cc458a02df1e7aa44d372e69d9a44e7fa1d0d872e469fd26c5f3345f1",
    "xsens-38.csv": "dbedf43033ae0b336674249266df56012e6108332dc884b19931e939b4e99fe7",
    "innalabs-24.csv": "20da389f9a9107278ae7806960cd41b280dba4fd6dcfbe84333f7e26afc97f4d",
    "innalabs-49.csv": "4adaede9f3d13a1625a9dfd4f59a0cbb5d58f04030e876f9614df6a80b596d27",
}
"""The SHA-256 of each file of reference data."""


@check("files of reference data", "7.11.6", "", source="their SHA-256 in the program")
def reference_files(context: Context) -> Iterator[Finding]:
    """Hash the files of reference data, because a changed case would prove nothing."""
    for name, digest in FILES.items():
        found = sha256((REFERENCE / name).read_bytes())
        yield Finding(
            found == digest,
            f"{found[:16]}…",
            of=name,
            where=str(REFERENCE / name),
            expected=f"{digest[:16]}…",
        )


# --- regressions ------------------------------------------------------------------------------------


def strd() -> dict[str, Any]:
    """Return the data sets of the NIST Statistical Reference Datasets (StRD) by name; numbers are decimal text."""
    sets: dict[str, Any] = json.loads((REFERENCE / "strd.json").read_text(encoding="utf-8"))
    return sets


def columns_of(one: dict[str, Any]) -> Floats:
    """Return the design matrix (n, p) of a data set: powers of x, or a constant and the columns in the data."""
    x = np.array(one["x"], float)
    if one["powers"] == "columns":
        return np.column_stack([np.ones(len(x)), x])
    return np.stack([x**power for power in one["powers"]], axis=1)


def correct_digits(found: Floats, certified: Sequence[str]) -> float:
    """Return the smallest number of correct digits (log relative error) among the estimates, at most 15."""
    true = np.array(certified, float)
    error = np.abs(found - true) / np.where(true == 0.0, 1.0, np.abs(true))
    return float(np.min(-np.log10(np.maximum(error, 1e-15))))


@check("NIST StRD", "7.11.2", "", place="bench/calibration/gls.py: solve_rows",
       source="NIST Statistical Reference Datasets, linear regression")  # fmt: skip
def regressions(context: Context) -> Iterator[Finding]:
    """Fit regressions with certified values by the solver of the estimator; log relative error of the estimates."""
    for name, one in strd().items():
        columns, y = columns_of(one), np.array(one["y"], float)
        scale = 1.0 / np.linalg.norm(columns, axis=0)
        solved = solve_rows(columns * scale, y, scale)
        digits = correct_digits(solved.step, one["estimates"])
        left = y - columns @ solved.step
        spread = math.sqrt(left @ left / (len(y) - len(scale)))
        certain = [f"{digits:.1f} digits of the estimates"]
        enough = digits >= one["digits"]
        if float(one["residual_deviation"]):
            of_u = correct_digits(spread * np.sqrt(np.diag(solved.covariance)), one["deviations"])
            certain.append(f"{of_u:.1f} of their u")
            enough &= of_u >= one["digits"]
        wanted = f"≥ {one['digits']} digits"
        yield Finding(bool(enough), ", ".join(certain), of=name, expected=wanted)


@check("start values", "7.11.2", "≥ 9 digits", place="bench/base/arrays.py: least_squares",
       source="NIST StRD, Longley and Norris")  # fmt: skip
def start_values(context: Context) -> Iterator[Finding]:
    """Fit two regressions with certified values by the least squares used for start values and mistakes."""
    for name in ("Longley", "Norris"):
        one = strd()[name]
        found, _ = least_squares(columns_of(one), np.array(one["y"], float))
        digits = correct_digits(found, one["estimates"])
        yield Finding(digits >= 9.0, f"{digits:.1f} digits", of=name)


# --- a check standard over years --------------------------------------------------------------------


def kilogram() -> tuple[Floats, Floats]:
    """Return years and values of the check standard of a kilogram calibration, (217,) each."""
    year, value, _ = np.loadtxt(REFERENCE / "kilogram-check.csv", delimiter=",", skiprows=1).T
    return year, value


@check("control chart", "7.7.1", "in control before 1985, shifted afterwards",
       place="bench/stats/control_charts.py",
       source="NIST/SEMATECH e-Handbook, 2.3.5.2: check standard of a kilogram")  # fmt: skip
def check_standard(context: Context) -> Iterator[Finding]:
    """Chart the check standard of a kilogram calibration, with limits from the values before 1985."""
    year, value = kilogram()
    old = year < 1985.0
    unit = np.ones((len(year), 1, 1))
    centre = centre_of(value[old, None], unit[old], "scatter")
    judged = judge(centre, value[~old, None], unit[~old])
    shewhart = np.abs(judged.z[:, 0])
    ewma = np.abs(judge(centre, value[~old, None], unit[~old], 0.2, settled=True).z[:, 0])
    share = float(np.mean(np.abs(value[old] - value[old].mean()) > 2.0 * value[old].std(ddof=1)))
    spread = value[old].std(ddof=1) * math.sqrt(1.0 + 1.0 / np.sum(old))
    yield agreement("deviations", judged.deviation[:, 0], value[~old] - value[old].mean(), 1e-9)
    yield agreement("u of a value and of the mean", judged.u[:1, 0], spread, 1e-9)
    yield Finding(share < 0.10, f"{share:.1%} beyond 2 s", of="before 1985", expected="as by chance, < 10 %")
    late = float(np.mean(ewma[-60:] > 3.0))
    words = f"{late:.0%} of the last 60 beyond 3 s, of single values {np.mean(shewhart[-60:] > 3.0):.0%}"
    shown = late > 0.5 and float(np.mean(shewhart[-60:] > 3.0)) < 0.05
    yield Finding(shown, words, of="EWMA after 1985", expected="> 50 %, of single values < 5 %")


@check("run length of an EWMA chart", "7.7.1", "11.154267016", place="bench/stats/control_charts.py: ewma_arl",
       source="SAS/QC user's guide, function EWMAARL, example")  # fmt: skip
def run_length(context: Context) -> Finding:
    """Compute the average run length of an EWMA chart for a shift of one standard deviation."""
    return agreement("", ewma_arl(0.25, 3.0, 1.0), 11.154267016, 1e-6)


# --- accelerometers ---------------------------------------------------------------------------------


@check("real accelerometers", "7.2.1", "", place="bench/calibration/free.py",
       source="github.com/Kyle-ak/imu_tk; github.com/mahmood-ul-hasan/IMU-Accelerometer-Calibration")  # fmt: skip
def real_sets(context: Context) -> Iterator[Finding]:
    """Calibrate published data sets of free positions, and compare the results with the authors' numbers."""

    def calibrated(name: str, g_m_s2: float = 9.80665) -> Any:
        return calibrate(read_csv(REFERENCE / f"{name}.csv", ["1", "2"]), MODEL, {}, g_m_s2, "gls")

    xsens = calibrated("xsens-38", 9.81744).triangular
    yield agreement("Xsens, bias (counts)", xsens.bias, [33123.8383, 33275.1630, 32364.4946], 0.02)
    scale = [0.0024130183, 0.0024269964, 0.0024118430]
    yield agreement("Xsens, scale (m/s² per count)", xsens.scale, scale, 1e-5 * np.array(scale))
    for name, before, after in (("innalabs-24", 15.47, 0.426), ("innalabs-49", 15.71, 0.836)):
        signal = read_csv(REFERENCE / f"{name}.csv", ["1", "2"]).signal
        error = np.linalg.norm(signal, axis=1) - 1.0
        yield agreement(f"{name}, |a| - 1 before (mg)", 1e3 * np.sqrt(np.mean(error**2)), before, 0.005)
        yield agreement(f"{name}, after (mg)", 1e3 * calibrated(name).modulus_rms_g, after, 0.0005)


@check("the paper's (11), a simulated round trip", "7.2.1", "", place="bench/model/geometry.py",
       source="Chernyak, Palyushok, Baranovska, equation (11)")  # fmt: skip
def round_trip(context: Context) -> Iterator[Finding]:
    """Simulate error-free readings from the paper's coefficients (11) by separate code; calibrate them."""
    readings = simulate(None, 0.0)
    for estimator in ("closed-form", "gls"):
        found = calibrate(readings, MODEL, STAND_U, 9.81, estimator)
        yield agreement(estimator, found.block.vector, TRUTH, 1e-9)


@check("normal gravity", "7.11.6", "", place="bench/model/geometry.py: normal_gravity_m_s2",
       source="WGS 84 (NIMA TR8350.2, table 3.4): 9.7803253359 and 9.8321849378 m/s²")  # fmt: skip
def gravity(context: Context) -> Iterator[Finding]:
    """Compute normal gravity at the equator and at the poles."""
    yield agreement("equator", normal_gravity_m_s2(0.0), 9.7803253359, 1e-9)
    yield agreement("poles", normal_gravity_m_s2(math.pi / 2.0), 9.8321849378, 2e-9)


@check("gravity of the bench file", "6.4.13", "", place="the bench file, gravity")
def gravity_of_the_bench(context: Context) -> Finding:
    """Compare the stated gravity with the values that occur on the earth, up to a height of 9 km."""
    g = context.bench.gravity_m_s2
    if g is None:
        return Finding(True, "not stated: results are per local g", expected="between 9.75 and 9.85 m/s²")
    return Finding(
        9.75 <= g <= 9.85, f"{g:.6f} m/s²", where=f"{context.bench_path}, gravity",
        expected="between 9.75 and 9.85 m/s²",
    )  # fmt: skip
