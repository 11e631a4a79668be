"""The temperature model against known truth: values, degrees, hysteresis; its tables, and the C header run."""

import csv
import json
import re
import shutil
import subprocess
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from bench.calibration import CalibrationError, calibrate
from bench.calibration.temperature import inverse_entries, make_table
from bench.calibration.temperature_fit import temperature_model
from bench.exchange.checks import c_header, json_test, table_checks, table_csv
from bench.model.geometry import COEFFICIENTS, Block
from bench.results.compensation import table_part
from bench.validation.paper_bench import STAND_U, TRUTH
from tests.support.self_tests import compiled_test, own_test, with_a_digit_changed
from tests.support.thermal_bench import MODEL, REFERENCE_C, coefficients, simulate, truth

SEED = 2026
GRID_C = np.linspace(-19.0, 54.0, 30)
SIZES = ((0.0,), (3e-7, 1e-8, 3e-10), (1e-5, 2e-8, 1e-9), (1e-4, 5e-7, 3e-9))


@cache
def several(count=8):
    """Errors over u (runs, temperatures, 12) of simulated runs, their p, p of curve and of hysteresis."""
    errors, tests = [], []
    for k in range(count):
        rng = np.random.default_rng([SEED, k])
        polynomials = truth(rng, SIZES[k % len(SIZES)])
        model = temperature_model([simulate(rng, polynomials)], MODEL, STAND_U, 9.81)
        error = model.coefficients(GRID_C) - coefficients(polynomials, GRID_C)
        u = np.sqrt([np.diag(model.covariance_at(t)) for t in GRID_C])
        errors.append(error / u)
        tests.append((model.fitted.p, model.curve.p, model.hysteresis.p))
    return np.array(errors), np.array(tests)


@pytest.mark.slow
def test_the_uncertainty_is_honest_over_the_whole_range():
    """Runs are independent, the coefficients of one nearly so, and 30 temperatures worth about two values."""
    z2 = several()[0] ** 2
    values = z2.shape[0] * 12 * 2
    # mean of squares of normal numbers: 1 with standard deviation sqrt(2/values); 4 of these, and 10 % for choice
    assert 0.75 - 4 * np.sqrt(2 / values) < z2.mean() < 1.1 + 4 * np.sqrt(2 / values)


@pytest.mark.slow
def test_no_lack_of_fit_and_no_hysteresis_is_found_where_there_is_none():
    """24 tests; one below 0.001 has a chance of 2 %."""
    assert several()[1].min() > 0.001


def test_without_dependence_on_temperature_the_degrees_are_low():
    rng = np.random.default_rng([SEED, 50])
    model = temperature_model([simulate(rng, TRUTH[:, None])], MODEL, STAND_U, 9.81)
    # at 5 % a term each: twelve coefficients with four terms have 2.4 too many on average
    assert model.degrees.sum() <= 12
    assert np.count_nonzero(model.degrees == 0) >= 6
    # a coefficient taken as constant is less sure far from the middle: it may have a slope after all
    middle, end = (np.sqrt(np.diag(model.covariance_at(t))) for t in (20.0, 55.0))
    assert np.all(end[model.degrees == 0] > middle[model.degrees == 0])


def test_each_coefficient_gets_the_degree_that_it_has():
    rng = np.random.default_rng([SEED, 51])
    polynomials = np.column_stack([TRUTH, np.zeros((12, 3))])
    degrees = np.arange(12) % 4
    for j, degree in enumerate(degrees):
        polynomials[j, 1 : degree + 1] = np.array([1e-4, 3e-6, 1e-7])[:degree]
    model = temperature_model([simulate(rng, polynomials)], MODEL, STAND_U, 9.81)
    assert np.all(model.degrees >= degrees)
    assert np.count_nonzero(model.degrees > degrees) <= 4
    assert np.all(model.values[np.arange(5) > model.degrees[:, None]] == 0.0)


def test_hysteresis_is_found_with_its_size_and_enters_the_uncertainty():
    rng = np.random.default_rng([SEED, 52])
    size = np.zeros(12)
    size[[0, 10]] = 3e-4, -4e-4
    polynomials = truth(rng)
    model = temperature_model([simulate(rng, polynomials, hysteresis=size)], MODEL, STAND_U, 9.81)
    found = model.hysteresis
    assert found.p < 1e-6
    assert {COEFFICIENTS[j] for j in np.flatnonzero(found.p_each < 1e-3)} == {"Kxx", "U0y"}
    assert np.max(np.abs(found.size - size) / found.u) < 4.0
    u = np.sqrt(np.diag(model.covariance_at(10.0)))
    assert u[[0, 10]] == pytest.approx([1.5e-4, 2e-4], rel=0.15)
    for side in (0.5, -0.5):
        off = model.coefficients(GRID_C) - coefficients(polynomials, GRID_C) - side * size
        assert np.sqrt(np.mean((off[:, [0, 10]] / u[[0, 10]]) ** 2)) < 1.5


def test_plateaus_stand_by_themselves_and_agree_with_a_calibration_of_one():
    """A plateau alone, the stand's angles common, is at least as good as its calibration from its rows only."""
    rng = np.random.default_rng([SEED, 53])
    polynomials = truth(rng)
    readings = simulate(rng, polynomials, drift_k=0.0)
    model = temperature_model([readings], MODEL, STAND_U, 9.81)
    assert [(round(p.temperature_c), p.branch) for p in model.plateaus] == [
        (-20, -1), (0, 1), (0, -1), (23, 1), (23, 0), (23, -1), (40, 1), (40, -1), (55, 1),
    ]  # fmt: skip
    cold = model.plateaus[0]
    alone = calibrate(readings.select(readings.series == 7), MODEL, STAND_U, 9.81)
    joint = np.hypot(alone.u, cold.u)
    assert np.max(np.abs(cold.value - alone.block.vector) / joint) < 3.0
    # less would be the noise's own scatter: a plateau has 54 settings
    assert np.all(cold.u < 1.25 * alone.u)
    assert np.max(np.abs(cold.value - coefficients(polynomials, -20.0)) / cold.u) < 4.0


def test_temperatures_that_alone_determine_nothing_do_so_together():
    rng = np.random.default_rng([SEED, 54])
    polynomials = truth(rng, (1e-4, 5e-7))
    cycles = {"cycle": (23.0, 0.0, -20.0, 50.0), "cycle_2": (30.0, 10.0, -10.0, 40.0)}
    model = temperature_model([simulate(rng, polynomials, **cycles)], MODEL, STAND_U, 9.81)
    assert all(plateau.value is None for plateau in model.plateaus)
    assert model.curve is None
    assert any("alone do not determine" in note for note in model.notes)
    error = model.coefficients(20.0) - coefficients(polynomials, 20.0)
    assert np.max(np.abs(error) / np.sqrt(np.diag(model.covariance_at(20.0)))) < 4.0


def test_compensated_signals_give_the_acceleration_within_its_uncertainty():
    rng = np.random.default_rng([SEED, 55])
    polynomials = truth(rng)
    model = temperature_model([simulate(rng, polynomials)], MODEL, STAND_U, 9.81)
    force = rng.normal(size=(40, 3))
    temperature = rng.uniform(-20.0, 55.0, 40)
    at = [Block.from_vector(row) for row in coefficients(polynomials, temperature)]
    signal = np.array([block.output(a[None])[0] for block, a in zip(at, force, strict=True)])
    found = model.compensate(signal, temperature)
    assert found.u.shape == (40, 3)
    # one model, many points: about 24 independent errors; 4 sigma of their mean square
    assert np.mean((found.specific_force - force) ** 2 / found.u**2) < 1.0 + 4.0 * np.sqrt(2.0 / 24.0)
    assert np.max(np.abs(found.specific_force - force)) < 3e-4


def test_the_covariance_of_an_acceleration_is_that_of_drawn_coefficients(model):
    rng = np.random.default_rng([SEED, 56])
    signal = model.block(40.0).output(np.array([[0.3, -0.5, 0.8]]))
    drawn = rng.multivariate_normal(model.coefficients(40.0), model.covariance_at(40.0), 4000)
    forces = np.array([Block.from_vector(c).specific_force(signal)[0] for c in drawn])
    # a standard deviation of 4000 draws is good to 1.1 %
    assert model.compensate(signal, 40.0).u[0] == pytest.approx(forces.std(axis=0), rel=0.05)


def test_beyond_the_measured_range_there_is_no_number(model):
    assert model.outside(np.array([-30.0, 20.0, np.nan, 70.0])).tolist() == [True, False, True, True]
    with pytest.raises(CalibrationError, match=r"70 °C is outside .* -2\d\.\d to 5\d\.\d °C"):
        model.compensate(np.ones((1, 3)), 70.0)


def test_files_of_one_temperature_each_make_one_model():
    rng = np.random.default_rng([SEED, 58])
    polynomials = truth(rng, (1e-4,))
    tables = [simulate(rng, polynomials, cycle=(t,)) for t in (-10.0, 23.0, 50.0)]
    model = temperature_model(tables, MODEL, STAND_U, 9.81, degree=1)
    assert model.readings == 3 * 54
    assert [plateau.branch for plateau in model.plateaus] == [0, 0, 0]
    assert model.hysteresis is None
    assert any("excludes hysteresis" in note for note in model.notes)
    error = model.coefficients(GRID_C[8:25]) - coefficients(polynomials, GRID_C[8:25])
    u = np.sqrt([np.diag(model.covariance_at(t)) for t in GRID_C[8:25]])
    assert np.max(np.abs(error) / u) < 5.0


@pytest.mark.slow
def test_u_of_a_temperature_term_knows_that_the_block_was_mounted_anew_at_each_temperature():
    """Kyz and Kzy of each temperature have another mounting roll: seeds 60 to 69, chi-square of 10 slopes."""
    roll, z = np.radians(30 / 3600), []
    for seed in range(60, 70):
        rng = np.random.default_rng([SEED, seed])
        polynomials = truth(rng, (1e-4,))
        tables = [simulate(rng, polynomials, cycle=(t,), roll_rad=roll) for t in (-20.0, 0.0, 23.0, 50.0)]
        model = temperature_model(
            tables, MODEL, STAND_U, 9.81, degree=1, assumed_u={"mounting_roll": float(roll)}
        )
        u, of_readings = (
            np.sqrt(np.diag(c)).reshape(12, -1)
            for c in (model.covariance, model.covariance - model.of_assumed)
        )
        z.append((model.values[5, 1] - polynomials[5, 1]) / u[5, 1])
        # installation 1 alone tells Kyz, in one mounting at each of four temperatures
        assert u[5, 0] == pytest.approx(2.14 * roll / np.sqrt(4), rel=0.2)
        assert of_readings[5, 0] < 0.2 * u[5, 0]
    assert chi2.ppf(1e-4, 10) < np.sum(np.square(z)) < chi2.ppf(1 - 1e-4, 10)


@pytest.mark.slow
@pytest.mark.parametrize(("growing", "told"), [(0.0, 0), (1e-4, 8)])
def test_noise_that_grows_with_the_signal_is_told(growing, told):
    """Seeds 70 to 77: noise of 20 uV near zero, 200 uV at 1 g; without growth, one note in a thousand runs."""
    notes = 0
    for seed in range(70, 78):
        rng = np.random.default_rng([SEED, seed])
        readings = simulate(rng, truth(rng, (1e-4,)), 2e-5, cycle=(0.0, 23.0, 50.0), growing=growing)
        model = temperature_model([readings], MODEL, STAND_U, 9.81, degree=1)
        notes += any(note.startswith("the noise grows with the signal (x ") for note in model.notes)
    assert notes == told


@pytest.mark.slow(5)
def test_noise_that_grows_with_the_signal_enters_u_over_temperature():
    """Seeds 600 to 639: scale factors at 23 °C, 120 errors divided by u, with the bound of 120 degrees of freedom.

    With one size of noise their chi-square was 1.8 times its mean.
    """
    z, at = [], [0, 4, 8]
    for seed in range(600, 640):
        rng = np.random.default_rng([SEED, seed])
        polynomials = truth(rng, (1e-4,))
        readings = simulate(rng, polynomials, 2e-5, cycle=(0.0, 23.0, 50.0), growing=1e-4)
        model = temperature_model([readings], MODEL, STAND_U, 9.81)
        error = model.coefficients(REFERENCE_C) - coefficients(polynomials, REFERENCE_C)
        z.append((error / np.sqrt(np.diag(model.covariance_at(REFERENCE_C))))[at])
    assert np.sum(np.square(z)) < chi2.ppf(1 - 1e-4, 120)


def test_noise_that_mostly_grows_is_found_in_every_channel():
    """Seed 77: noise of 1e-3 of the signal; in channel x it was taken for constant noise, too large for U0x."""
    rng = np.random.default_rng([77, 1])
    readings = simulate(rng, truth(rng, (1e-4,)), 2e-5, cycle=(0.0, 23.0, 50.0), growing=1e-3)
    model = temperature_model([readings], MODEL, STAND_U, 9.81)
    assert model.growth * model.noise.by_channel == pytest.approx(np.full(3, 1e-3), rel=0.15)


def test_a_few_readings_without_repeats_take_the_noise_from_all_residuals():
    rng = np.random.default_rng([SEED, 59])
    polynomials = truth(rng, (1e-4,))
    readings = simulate(rng, polynomials, cycle=(23.0, 50.0, 0.0), passes=1)
    model = temperature_model([readings], MODEL, STAND_U, 9.81)
    assert model.noise.source == "residuals"
    assert model.noise.reading == pytest.approx(1e-4, rel=0.4)
    error = model.coefficients(20.0) - coefficients(polynomials, 20.0)
    assert np.max(np.abs(error) / np.sqrt(np.diag(model.covariance_at(20.0)))) < 4.5


def one_temperature(rng):
    return simulate(rng, TRUTH[:, None], cycle=(REFERENCE_C,))


@pytest.mark.parametrize(
    ("make", "arguments", "told"),
    [
        (one_temperature, {}, r"too narrow a range; measure at three or more"),
        (lambda rng: simulate(rng, truth(rng)), {"reference_c": 90.0}, r"90 °C, lies outside .*--reference"),
        (
            lambda rng: simulate(rng, truth(rng)),
            {"degree": 5},
            r"polynomials of degree 5 .*give a lower degree",
        ),
        (
            lambda rng: simulate(rng, truth(rng), cycle=(0.0, 23.0), cycle_2=(23.0,)),
            {},
            r"2 temperatures \(0, 23 °C\) .*do not determine a dependence on temperature",
        ),
    ],
)
def test_what_cannot_be_modelled_is_refused_with_the_way_out(make, arguments, told):
    readings = make(np.random.default_rng([SEED, 60]))
    with pytest.raises(CalibrationError, match=told):
        temperature_model([readings], MODEL, STAND_U, 9.81, **arguments)


def test_a_reading_without_temperature_is_named():
    readings = simulate(np.random.default_rng([SEED, 61]), TRUTH[:, None])
    readings.temperature_c[[4, 9]] = np.nan
    with pytest.raises(
        CalibrationError, match=r"2 readings have no temperature_c .*series 1, pass 1, point 5"
    ):
        temperature_model([readings], MODEL, STAND_U, 9.81)


SEED_OF_TABLE = 77
REACH_G = 10.0


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(SEED_OF_TABLE)
    return temperature_model([simulate(rng, truth(rng))], MODEL, STAND_U, 9.81)


@pytest.fixture(scope="module")
def table(model):
    return make_table(model, REACH_G)


@pytest.fixture(scope="module")
def drawn(model):
    """Accelerations, temperatures and signals that no table was made of, with the exact answer."""
    rng = np.random.default_rng([SEED_OF_TABLE, 1])
    temperature = rng.uniform(model.minimum_c, model.maximum_c, 2000)
    force = rng.normal(size=(2000, 3))
    force *= (rng.uniform(0.0, REACH_G, 2000) / np.linalg.norm(force, axis=1))[:, None]
    coefficients = model.coefficients(temperature)
    signal = np.einsum("nij,nj->ni", coefficients[:, :9].reshape(-1, 3, 3), force) + coefficients[:, 9:]
    return force, temperature, signal


def allowed_g(table, force):
    size = np.linalg.norm(force, axis=1)[:, None]
    return table.error.bias + table.error.per_g * size + table.error.single


def test_accelerations_out_of_the_table_are_as_close_as_it_says(table, drawn):
    force, temperature, signal = drawn
    off = np.abs(table.specific_force(signal, temperature) - force)
    # single precision was looked at on 26 directions; others may come out a little worse
    assert np.all(off <= 1.5 * allowed_g(table, force))
    assert np.max(off / allowed_g(table, force)) > 0.2


def test_the_table_is_fine_enough_for_its_own_uncertainty(model, table):
    signal = model.block(23.0).output(np.eye(3))
    assert table.error.bias + table.error.per_g < 0.11 * np.min(model.compensate(signal, 23.0).u)
    coarse = make_table(model, REACH_G, step_k=30.0)
    assert coarse.nodes == 4
    assert coarse.error.per_g > 10 * table.error.per_g


def test_nodes_hold_the_inverse_of_the_polynomials(model, table):
    exact = inverse_entries(model, table.temperatures_c)
    assert table.entries == pytest.approx(exact, rel=1e-6)
    k = model.coefficients(table.temperatures_c)[:, :9].reshape(-1, 3, 3)
    assert exact[:, :9].reshape(-1, 3, 3) @ k == pytest.approx(
        np.tile(np.eye(3), (table.nodes, 1, 1)), abs=1e-12
    )


@pytest.mark.parametrize("step_k", [0.0, -1.0, 1e-4, 200.0, float("nan")])
def test_a_step_that_is_none_is_refused(model, step_k):
    with pytest.raises(CalibrationError, match=r"a step of .* does not fit a table from -2"):
        make_table(model, REACH_G, step_k)


def test_the_limits_of_a_step_that_a_refusal_states_are_accepted(model):
    with pytest.raises(CalibrationError) as told:
        make_table(model, REACH_G, 1e-4)
    for limit in re.findall(r"between (\S+) and (\S+) K", str(told.value))[0]:
        assert make_table(model, REACH_G, float(limit)).step_k <= float(limit)


def test_csv_and_json_hold_the_same_entries(model, table):
    text = table_csv(model, table, "block 1")
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert f"{table.error.per_g:.1e} for each g" in " ".join(comments)
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    assert len(rows) == table.nodes
    first = np.array([rows[0][name] for name in ("Nxx", "Nzz", "U0z")], dtype=np.float32)
    assert np.array_equal(first, table.entries[0, [0, 8, 11]])
    plain = json.loads(json.dumps(table_part(table).to_dict()))
    assert np.array_equal(np.array(plain["rows"], dtype=np.float32), table.entries)
    assert plain["approximation"]["up_to_g"] == REACH_G


MAIN = """#include <stdio.h>
#include "compensation.h"
int main(void)
{
    float u[3], t, a[3];
    while (scanf("%f %f %f %f", &t, &u[0], &u[1], &u[2]) == 4) {
        int status;
        a[0] = a[1] = a[2] = -1.0f;
        status = compensation_specific_force(u, t, a);
        printf("%d %.9g %.9g %.9g\\n", status, (double)a[0], (double)a[1], (double)a[2]);
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def compiled(model, table, tmp_path_factory):
    return _compiled(tmp_path_factory.mktemp("c"), c_header(model, table, "block */ 1\\\n#error"), MAIN)


def _compiled(folder, header, main):
    """Return a function of temperatures and signals that runs a C program with the header."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here to compile the header with")
    (folder / "compensation.h").write_text(header)
    (folder / "main.c").write_text(main)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1"]
    subprocess.run([compiler, *strict, "-o", folder / "main", folder / "main.c"], check=True)  # noqa: S603

    def run(temperature, signal):
        rows = np.column_stack([temperature, signal])
        text = "\n".join(" ".join(repr(float(v)) for v in row) for row in rows)
        done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)  # noqa: S603
        found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
        return found[:, 0].astype(int), found[:, 1:]

    return run


def test_the_header_compiles_and_computes_what_the_table_says(compiled, table, drawn):
    force, temperature, signal = drawn
    status, found = compiled(temperature, signal)
    assert np.all(status == 0)
    assert np.all(np.abs(found - force) <= 1.5 * allowed_g(table, force))
    # the same arithmetic in numpy; a fused multiplication may differ in the last digits of 10 g
    assert found == pytest.approx(table.specific_force(signal, temperature), abs=4e-6)


@pytest.mark.slow
def test_what_is_exported_tests_itself_with_temperature(model, table, tmp_path):
    """C to 1e-12 in double precision; CSV and JSON by their three lines; each fails once a digit changes."""
    header = c_header(model, table, "block 1")
    assert compiled_test(tmp_path, "compensation", header) == 0
    at = re.search(r"compensation_table.*?\{\s*\{-?", header, re.DOTALL).end()
    assert compiled_test(tmp_path, "compensation", with_a_digit_changed(header, at)) > 0
    text = table_csv(model, table, "block 1")
    checks = table_checks(model, table)
    assert len(checks) == table.nodes - 1
    data = {"table": table_part(table).to_dict(), "check": checks.tolist(), "python": json_test(len(checks))}
    for name, made, first in (
        ("x.csv", text, r"\n-2\d\.\d+,-?"),
        ("x.json", json.dumps(data), r'"rows": \[\[-?'),
    ):
        (tmp_path / name).write_text(made)
        assert own_test(tmp_path / name) == 0
        changed = with_a_digit_changed(made, re.search(first, made).end())
        (tmp_path / name).write_text(changed)
        assert own_test(tmp_path / name) != 0


DOUBLE = """#include <stdio.h>
#include "compensation.h"
int main(void)
{
    double u[3], t, a[3];
    while (scanf("%lf %lf %lf %lf", &t, &u[0], &u[1], &u[2]) == 4) {
        int status;
        a[0] = a[1] = a[2] = -1.0;
        status = compensation_specific_force_double(u, t, a);
        printf("%d %.9g %.9g %.9g\\n", status, a[0], a[1], a[2]);
    }
    return 0;
}
"""


def test_in_double_precision_no_temperature_outside_is_extrapolated(model, table, tmp_path):
    """The nearest end is used, and the status says so, as in single precision; 1e9 K read beyond the table."""
    run = _compiled(tmp_path, c_header(model, table, "block 1"), DOUBLE)
    t = [model.maximum_c + 20.0, model.minimum_c - 5.0, 1e9, np.nan, model.maximum_c, model.minimum_c]
    ends = [model.maximum_c, model.minimum_c, model.maximum_c, np.nan, model.maximum_c, model.minimum_c]
    up = np.array([[0.0, 0.0, 1.0]])
    signal = np.vstack([model.block(model.minimum_c if np.isnan(end) else end).output(up) for end in ends])
    status, found = run(t, signal)
    assert status.tolist() == [1, 1, 1, -1, 0, 0]
    assert found[:3] == pytest.approx(np.vstack([up] * 3), abs=1e-6)
    assert found[3].tolist() == [-1.0, -1.0, -1.0]


def test_the_errors_that_u_of_a_table_leaves_out_are_stated(model, table):
    """1 K of error in the temperature: the difference quotient of a along 200 directions (seed 6)."""
    a = np.random.default_rng(6).normal(size=(200, 3))
    a /= np.linalg.norm(a, axis=1)[:, None]
    moved = []
    for t in np.linspace(model.minimum_c, model.maximum_c - 1e-4, 40):
        block = model.block(t + 1e-4)
        signal = model.block(t).output(a)
        moved.append(np.linalg.norm((signal - block.U0) @ np.linalg.inv(block.K).T - a, axis=1).max() / 1e-4)
    assert 0.7 * model.per_kelvin_g < max(moved) < 1.01 * model.per_kelvin_g
    head = table_csv(model, table, "block 1")
    assert f"by up to {model.per_kelvin_g:.2g} g" in " ".join(head.split())
    assert repr(model.g_m_s2) in head


def test_the_header_tells_a_temperature_outside_and_one_that_is_none(compiled, model):
    signal = np.tile(model.block(model.maximum_c).output(np.array([[0.0, 0.0, 1.0]])), (4, 1))
    status, found = compiled([model.maximum_c + 20.0, model.minimum_c - 5.0, np.nan, model.maximum_c], signal)
    assert status.tolist() == [1, 1, -1, 0]
    assert found[0] == pytest.approx([0.0, 0.0, 1.0], abs=3e-6)
    assert found[2].tolist() == [-1.0, -1.0, -1.0]
