"""bench compensate, and the note of bench calibrate that leads to it."""

import json

import numpy as np
import pytest

from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import write_csv
from tests.support.paper_bench import TRUTH
from tests.support.thermal_bench import coefficients, simulate, truth

SEED = 5


@pytest.fixture
def polynomials():
    return truth(np.random.default_rng(SEED))


@pytest.fixture
def readings(polynomials, empty_folder, tmp_path):
    path = tmp_path / "warm.csv"
    write_csv(simulate(np.random.default_rng([SEED, 1]), polynomials), path)
    return path


def test_a_run_over_temperature_is_compensated_and_written(bench, readings, polynomials, tmp_path):
    status, out, err = bench("compensate", readings, "--json", "model.json")
    assert (status, err) == (0, "")
    assert "486 readings, -2" in out
    assert "hysteresis, rising minus falling: p = " in out
    result = json.loads((tmp_path / "model.json").read_text())
    at = coefficients(polynomials, 23.0)
    for j, name in enumerate(COEFFICIENTS):
        term = result["coefficients"][name]["terms"][0]
        assert abs(term["value"] - at[j]) < 4.5 * term["u"]
    assert len(result["covariance"]) == len(result["order"])
    assert len(result["plateaus"]) == 9
    written = sorted(path.name for path in (tmp_path / "compensate").iterdir())
    assert written == ["warm.csv", "warm.h", "warm.json"]
    assert json.loads((tmp_path / "compensate" / "warm.json").read_text()) == result


def test_json_on_standard_output_is_json_alone(bench, readings):
    status, out, err = bench("compensate", readings, "--json", "-", "--degree", "3", "--reference", "40")
    assert status == 0
    result = json.loads(out)
    assert result["reference_c"] == 40.0
    assert {c["degree"] for c in result["coefficients"].values()} == {3}
    assert "Temperature model" in err


@pytest.mark.slow
def test_a_curve_that_is_no_polynomial_is_told_and_not_accepted(bench, polynomials, tmp_path):
    """A hysteresis that is there at one temperature only."""
    table = simulate(np.random.default_rng([SEED, 2]), polynomials)
    table.signal[table.series == 8] += 1e-3
    write_csv(table, tmp_path / "odd.csv")
    status, out, _ = bench("compensate", "odd.csv")
    assert status == 1
    assert "THE CURVES ARE NOT THESE POLYNOMIALS" in out


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--degree", "many"), "--degree many: expected 'auto', or a whole number"),
        (("--step", "500"), "a step of 500 K does not suit"),
        (("--reference", "99"), "--reference"),
    ],
)
def test_mistakes_are_one_line_each(bench, readings, options, told):
    status, _, err = bench("compensate", readings, *options)
    assert status == 2
    assert told in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_calibrate_points_to_compensate_where_temperatures_are_mixed(bench, polynomials, tmp_path):
    three = simulate(np.random.default_rng([SEED, 4]), polynomials, cycle=(-20.0, 23.0, 55.0), passes=2)
    write_csv(three, tmp_path / "three.csv")
    _, out, _ = bench("calibrate", "three.csv")
    assert (
        "readings span 75 K at 3 temperatures, and these coefficients mix them: see bench compensate" in out
    )
    bench("report", "three.csv")
    (page,) = tmp_path.rglob("*.html")
    assert "these coefficients mix them" in page.read_text(encoding="utf-8")
    one = simulate(np.random.default_rng([SEED, 3]), TRUTH[:, None], cycle=(23.0,))
    write_csv(one, tmp_path / "one.csv")
    assert "bench compensate" not in bench("calibrate", "one.csv")[1]
