"""Coefficients of another calibration: of this block, not fitted to the points, at another temperature."""

import json
from pathlib import Path

import numpy as np
import pytest

import bench as api
from bench.readings.csv import write_csv
from bench.run.folder import Run
from tests.support.commands import printed, refused

BIAS_PER_K, SCALE_PER_K = 30e-6 / np.sqrt(3), 180e-6 / np.sqrt(3)
"""Standard uncertainties of the temperature coefficients of a block for which the bench file states none."""


@pytest.fixture
def run(bench, paper_run):
    return Run(Path("runs/run"))


def verified(bench, *arguments):
    return json.loads(bench("verify", *arguments, "--json", "-")[1])


def test_coefficients_of_another_block_are_named_beside_the_verdict(bench, run):
    told = json.loads(Path("runs/run/calibrate.json").read_text())
    told["unit_under_test"]["serial"] = "7"
    Path("other.json").write_text(json.dumps(told))
    named = (
        "THE COEFFICIENTS ARE OF ANOTHER BLOCK, as recorded: other.json is of 'triaxial block of the paper 7'"
    )
    _, out, _ = bench("verify", "run", "--coefficients", "other.json", "--json", "result.json")
    assert named in " ".join(out.split())
    assert any(note.startswith(named) for note in json.loads(Path("result.json").read_text())["notes"])


@pytest.mark.slow
def test_points_that_joined_a_fit_cannot_verify_it(bench, run):
    assert bench("calibrate", "run", "--join-verification", "--json", "joined.json")[0] == 0
    for place in ("run", "runs/run"):
        said = bench("verify", place, "--coefficients", "joined.json")
        refused(said, "calibrate without --join-verification")
    joined = api.calibrate("runs/run", join_verification=True)
    joined.report("joined.html")
    assert "Not verified" in Path("joined.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_u_contains_the_temperature_difference_between_calibration_and_check(bench, run):
    """The same check, 1 K and 30 K warmer than the calibration: the difference of the variances, in closed form."""
    measured = run.readings()
    at_c = float(np.mean(measured.oriented().temperature_c))
    calibrated = ("--coefficients", "runs/run/calibrate.json")
    told = json.loads(Path("runs/run/calibrate.json").read_text())
    assert told["temperature_c"] == pytest.approx(at_c)
    points = measured.select(measured.installation == "V")
    u = {}
    for warmer in (1.0, 30.0):
        points.temperature_c[:] = at_c + warmer
        write_csv(points, Path("check.csv"))
        result = verified(bench, "check.csv", *calibrated)
        u[warmer] = np.array([point["u"] for point in result["points"]])
        assert any("verified at" in note for note in result["notes"]) == (warmer > 1.0)
    points.temperature_c[:] = np.nan
    write_csv(points, Path("check.csv"))
    unknown = np.array([point["u"] for point in verified(bench, "check.csv", *calibrated)["points"]])
    assert np.all(unknown <= u[1.0])  # nothing is known of a difference
    K = np.array([[told["coefficients"][f"K{a}{b}"]["value"] for b in "xyz"] for a in "xyz"])
    U0 = np.array([told["coefficients"][f"U0{a}"]["value"] for a in "xyz"])
    n = (points.signal - U0) @ np.linalg.inv(K).T
    # by K of a small cross-coupling: n^2 of a bias and n^4 of a scale factor for each channel
    per_k2 = (n**2 * BIAS_PER_K**2 + n**4 * SCALE_PER_K**2).sum(axis=1)
    np.testing.assert_allclose(u[30.0] ** 2 - u[1.0] ** 2, (30.0**2 - 1.0**2) * per_k2, rtol=0.02)


@pytest.mark.slow
def test_a_comparison_says_that_the_block_was_at_two_temperatures(bench, run):
    told = json.loads(Path("runs/run/calibrate.json").read_text())
    told["temperature_c"] += 30.0
    told["made_at"] = "2027-03-01T08:00:00+00:00"
    Path("warm.json").write_text(json.dumps(told))
    printed(bench("compare", "run", "warm.json"), "a change may be due to the temperature")
