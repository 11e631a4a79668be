"""`bench compensate` and the note of `bench calibrate` that leads to it; `bench tumble` of turns."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench import compensate as compensate_in_python
from bench import tumble as tumble_in_python
from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import EXAMPLE, write_csv
from bench.validation.paper_bench import TRUTH, specific_force
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to
from tests.support.thermal_bench import coefficients, simulate, truth
from tests.support.tumble_bench import Terms, centrifuge, tumble

SEED = 5


@pytest.fixture
def polynomials():
    return truth(np.random.default_rng(SEED))


@pytest.fixture
def readings(polynomials, empty_folder, tmp_path):
    path = tmp_path / "warm.csv"
    write_csv(simulate(np.random.default_rng([SEED, 1]), polynomials), path)
    return path


@pytest.mark.slow
def test_a_run_over_temperature_is_compensated_and_written(bench, readings, polynomials, tmp_path):
    status, out, err = bench("compensate", readings, "--json", "model.json")
    assert (status, err) == (0, "")
    assert "486 readings, -2" in out
    assert "hysteresis, rising minus falling: " in out
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
    (tmp_path / "python.json").write_text(json.dumps(compensate_in_python([str(readings)]).to_dict()))
    assert json.loads((tmp_path / "python.json").read_text()) == result
    assert "u of a at 1 g: at most" in out
    _is_enough_for_u_at_a_temperature(
        result, float(re.search(r"at most (\S+) g at 1 g", _header(tmp_path))[1])
    )


def _header(folder):
    return " ".join((folder / "compensate" / "warm.h").read_text().replace("*", "").split())


def _is_enough_for_u_at_a_temperature(result, largest):
    """From the JSON alone, as `uncertainty` says: the covariance at T. The header states the largest u of a."""
    assert result["accepted"]
    assert "local g" in result["equation"]
    C, H = np.array(result["covariance"]), np.array(result["hysteresis"]["covariance"])
    value = np.array([[t["value"] for t in result["coefficients"][n]["terms"]] for n in COEFFICIENTS])
    found = []
    for at in np.linspace(*result["valid_c"], 9):
        powers = (at - result["reference_c"]) ** np.arange(value.shape[1])
        J = np.kron(np.eye(12), powers)
        own = J @ C @ J.T + H
        N = np.linalg.inv((value @ powers)[:9].reshape(3, 3))
        for a in np.vstack([np.eye(3), -np.eye(3)]):
            by = -N @ np.hstack([np.kron(np.eye(3), a), np.eye(3)])
            found.append(np.sqrt(np.diag(by @ own @ by.T)).max())
    assert max(found) == pytest.approx(largest, rel=0.06)


@pytest.mark.slow
def test_the_roll_of_a_mounting_is_in_u_once_whatever_the_block_does_over_temperature(bench, readings):
    """30″ of the third mounting angle are 311 µV/g of Kyz and Kzy (metrology: 934 uV/g for 90″)."""
    result = json.loads(bench("compensate", readings, "--json", "-")[1])
    (roll,) = [one for one in result["uncertainty_sources"] if one["name"] == "mounting_roll"]
    assert [roll["u"][name] for name in ("Kyz", "Kzy")] == pytest.approx([311e-6, 311e-6], rel=0.02)


@pytest.mark.slow
def test_the_error_of_the_calibrations_temperatures_is_in_u_through_the_slopes(readings):
    """At any temperature the covariance has at least the slopes times u(T) of the shipped bench, 0.5 K / √3."""
    result = compensate_in_python([str(readings)]).to_dict()
    terms = [[term["value"] for term in result["coefficients"][name]["terms"]] for name in COEFFICIENTS]
    covariance = np.array(result["covariance"])
    for warmth in (-30.0, 0.0, 25.0):
        powers = warmth ** np.arange(len(terms[0]))
        at = np.kron(np.eye(12), powers)
        slope = np.array(terms)[:, 1:] @ (np.arange(1, len(powers)) * powers[:-1])
        rest = at @ covariance @ at.T - np.outer(slope, slope) * 0.5**2 / 3
        assert np.linalg.eigvalsh(rest)[0] > -1e-6 * np.trace(rest)
    assert "temperature" in [one["name"] for one in result["uncertainty_sources"]]


@pytest.mark.slow
def test_points_of_one_plateau_are_verified_together(bench, readings, polynomials, tmp_path):
    """A thermometer shows another temperature at each point: four temperatures are not four verifications.

    At 1 K from the mean the gain of these coefficients is 100 ppm off: each reading needs its own temperature.
    """
    temperature = np.array([22.2, 22.9, 23.3, 23.6, 39.1, 40.0, 40.2, 40.7])
    angle = np.tile([45.0, 135.0, 225.0, 315.0], 2)
    force = specific_force(["V"] * 8, np.radians(angle), psi=np.radians(45.0))
    at = coefficients(polynomials, temperature)
    signal = np.einsum("nij,nj->ni", at[:, :9].reshape(8, 3, 3), force) + at[:, 9:]
    with readings.open("a", encoding="utf-8") as file:
        for k, (volts, t) in enumerate(zip(signal.tolist(), temperature.tolist(), strict=True)):
            x, y, z = volts
            file.write(f"{1 + k // 4},V,1,{k % 4 + 1},{angle[k]},,,,{t},1,{x},{y},{z},,,\n")
    bench("compensate", readings, "--json", "model.json")
    checks = json.loads((tmp_path / "model.json").read_text())["verification"]
    assert [(round(one["temperature_c"], 2), len(one["points"])) for one in checks] == [(23.0, 4), (40.0, 4)]
    assert all(abs(point["delta_g"]) < 2 * point["u"] for one in checks for point in one["points"])
    assert max(abs(point["delta_g"]) for one in checks for point in one["points"]) < 6e-5


@pytest.mark.slow
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
    printed(bench("compensate", "odd.csv"), "THE CURVES ARE NOT THESE POLYNOMIALS", status=1)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--degree", "many"), "--degree many: give 'auto' or a whole number"),
        (("--step", "500"), "a step of 500 K does not fit"),
        (("--reference", "99"), "--reference"),
    ],
)
def test_mistakes_are_one_line_each(bench, readings, options, told):
    refused(bench("compensate", readings, *options), told)


@pytest.mark.slow
def test_calibrate_points_to_compensate_where_temperatures_are_mixed(bench, polynomials, tmp_path):
    three = simulate(np.random.default_rng([SEED, 4]), polynomials, cycle=(-20.0, 23.0, 55.0), passes=2)
    write_csv(three, tmp_path / "three.csv")
    told = "readings span 75 K at 3 temperatures, and these coefficients mix them; use 'bench compensate'"
    assert told in bench("calibrate", "three.csv")[1]
    two = simulate(np.random.default_rng([SEED, 4]), polynomials, cycle=(20.0, 30.0), passes=2)
    write_csv(two, tmp_path / "two.csv")
    assert "readings span 10 K at 2 temperatures" in bench("calibrate", "two.csv")[1]
    one = simulate(np.random.default_rng([SEED, 3]), TRUTH[:, None], cycle=(23.0,))
    write_csv(one, tmp_path / "one.csv")
    assert "bench compensate" not in bench("calibrate", "one.csv")[1]


SEED_OF_TURNS = 8
TERMS = Terms(K2=np.array([200e-6, 0.0, 0.0]))


@pytest.fixture
def turns(empty_folder):
    for points in (8, 12):
        write_csv(
            tumble(np.random.default_rng(SEED_OF_TURNS), 1e-4, TERMS, points=points),
            Path(f"turn-{points}.csv"),
        )


def test_a_square_is_found_and_what_is_not_separable_is_said(bench, turns):
    status, out, err = bench("tumble", "turn-8.csv", "--json", "r.json")
    assert (status, err) == (0, "")
    assert out.splitlines()[0].startswith("bench file: paper-stand")
    result = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("tumble", result)
    assert result == json.loads(Path("tumble/turn-8.json").read_text(encoding="utf-8"))
    square = result["axes"]["x"]["quantities"]["K2"]
    assert abs(square["value"] - 200e-6) < 4 * square["u"] < 100e-6
    assert [axis["rank"] for axis in result["axes"].values()] == [6, 6, 6]
    assert out.count("Koq cannot be separated") == 3
    assert "x  K3 + 0.586 Koq" in out


def test_twelve_points_separate_and_say_how_little(bench, turns):
    out = bench("tumble", "turn-12.csv", "--strict")[1]
    assert out.count("7 of 7 terms are determined") == 3
    assert out.count("are correlated (r = -0.99") == 3
    assert "assumed zero in channel x: 1 µg/g² of Kpp changes K0 +0.50" in out
    assert "u, readings" in out


def test_terms_that_are_left_out_show_as_lack_of_fit(bench, turns):
    status, out, _ = bench("tumble", "turn-12.csv", "--terms", "K3,Koq", "--strict")
    assert status == 1
    # a prior of K2 is in the uncertainty, one of Kpp is not
    assert "not fitted, but included in u, in channel x: 1 µg/g² of K2 changes" in out
    assert "assumed zero in channel x: 1 µg/g² of Kpp changes" in out


def test_points_of_a_centrifuge_join_and_python_gives_the_same(bench, turns):
    points = centrifuge(np.random.default_rng(SEED_OF_TURNS), TERMS, 1e-4, 1e-3)
    table = np.column_stack([points.force_ms2, points.u_ms2, points.u_relative, points.signal])
    rows = [",".join("" if np.isnan(cell) else repr(float(cell)) for cell in row) for row in table]
    Path("points.csv").write_text("\n".join([EXAMPLE, *rows]) + "\n")
    out = bench("tumble", "turn-8.csv", "--centrifuge", "points.csv", "--json", "r.json")[1]
    result = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("tumble", result)
    assert "18 points up to 10 g agree with the readings at 1 g: chi-square" in out
    assert [axis["rank"] for axis in result["axes"].values()] == [7, 7, 7]
    assert result["axes"]["x"]["quantities"]["K2"]["u_readings"] < 5e-6
    (python,) = tumble_in_python(["turn-8.csv"], bench="paper-stand", centrifuge="points.csv")
    assert python.above_1g.chi2 == pytest.approx(result["above_1g"]["chi2"])


def test_a_mistake_is_one_line(bench, turns):
    refused(
        bench("tumble", "turn-12.csv", "--terms", "K2,K9"),
        "terms K9: unknown; give each once, from K2, K3, Koq",
    )
