"""How readings are sorted into mountings and temperatures; how terms are dropped."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import temperature_fit
from bench.calibration.result import CalibrationError, Noise
from bench.calibration.temperature import inner_range, separate_temperatures, sort_readings
from bench.calibration.temperature_fit import ThermalFit, choose_degrees, held_at_zero, temperature_model
from bench.readings.table import make_readings
from bench.validation.paper_bench import STAND_U
from tests.support.thermal_bench import CYCLE_C, MODEL, simulate, truth

SEED = 41


def rows(*stays):
    """Three readings for each (installation, series, temperature), in this order."""
    columns = [stay for stay in stays for _ in range(3)]
    label, series, temperature = (list(column) for column in zip(*columns, strict=True))
    n = len(label)
    return make_readings(
        label, [1] * n, list(range(1, n + 1)), np.zeros(n), np.ones((n, 3)),
        series=series, temperature_c=np.array(temperature, dtype=float),
    )  # fmt: skip


def mountings(*stays):
    return sort_readings([rows(*stays)]).mounting[::3].tolist()


def test_a_block_stays_mounted_while_the_temperature_changes():
    assert mountings(("1", 1, 20), ("1", 2, 40), ("1", 3, 20), ("2", 1, 20), ("2", 2, 40)) == [1, 1, 1, 2, 2]


def test_it_is_mounted_anew_after_another_installation_and_for_a_new_series_at_the_same_temperature():
    assert mountings(("1", 1, 20), ("2", 1, 20), ("1", 2, 20)) == [1, 2, 3]
    assert mountings(("1", 1, 20), ("1", 2, 20.5), ("1", 2, 40)) == [1, 2, 2]


def test_the_column_of_mountings_decides_where_there_is_one():
    table = rows(("1", 1, 20), ("1", 2, 40), ("1", 3, 40))
    noted = replace(table, extra={"mounting_number": np.repeat(["1", "2", "2"], 3)})
    assert sort_readings([noted]).mounting[::3].tolist() == [1, 2, 2]
    partly = replace(table, extra={"mounting_number": np.repeat(["", "", "2"], 3)})
    assert sort_readings([partly]).mounting[::3].tolist() == [1, 1, 2]


def test_verification_takes_it_off_a_shorted_input_does_not():
    between = sort_readings([rows(("1", 1, 20), ("V", 1, 20), ("1", 2, 40))])
    assert between.mounting.tolist() == [1] * 3 + [3] * 3
    assert set(between.rows.installation) == {"1"}
    assert sort_readings([rows(("1", 1, 20), ("S", 1, 20), ("1", 2, 40))]).mounting.tolist() == [1] * 6


def test_mountings_of_two_files_are_never_the_same():
    parts = [rows(("1", 1, 20), ("2", 1, 20)), rows(("2", 1, 40), ("1", 1, 40))]
    both = sort_readings(parts)
    assert both.mounting[::3].tolist() == [1, 2, 3, 4]
    assert both.visit[::3].tolist() == [0, 1, 2, 3]
    assert both.branch.tolist() == [0] * 12


def test_the_side_from_which_a_temperature_was_reached_is_that_of_the_step_before():
    readings = simulate(np.random.default_rng(SEED), truth(np.random.default_rng(SEED)))
    found = sort_readings([readings])
    assert sorted(set(found.mounting.tolist())) == [1, 2]
    assert found.levels == 5
    for installation in "12":
        own = found.rows.installation == installation
        branch = [int(found.branch[own & (found.rows.series == s)][0]) for s in range(1, 10)]
        assert branch == [0, 1, 1, -1, -1, -1, -1, 1, 1]
    levels = np.array([-20, 0, 23, 40, 55])[found.level].tolist()
    between = dict(zip(levels, found.both_sides.tolist(), strict=True))
    assert between == {-20: False, 0: True, 23: True, 40: True, 55: False}
    assert separate_temperatures(readings) == pytest.approx(sorted(set(CYCLE_C)), abs=0.2)


def test_a_series_that_warms_up_is_cut_into_plateaus():
    n = 40
    ramp = make_readings(
        ["1"] * n,
        [1] * n,
        list(range(1, n + 1)),
        np.zeros(n),
        np.ones((n, 3)),
        temperature_c=np.linspace(20, 30, n),
    )
    found = sort_readings([ramp])
    assert set(found.mounting.tolist()) == {1}
    assert 3 <= found.levels <= 6
    assert set(found.branch.tolist()) == {0, 1}


@pytest.fixture
def line():
    """Twelve coefficients with powers 0…3, measured at random with correlated noise; least squares of all."""
    rng = np.random.default_rng([SEED, 1])
    design = rng.normal(size=(200, 48))
    target = design @ np.where(np.arange(48) % 4 <= 1, 5.0, 0.0) + rng.normal(size=200)
    covariance = np.linalg.inv(design.T @ design)
    value = covariance @ design.T @ target
    noise = Noise(1.0, 0.0, 500.0, "repeats")
    nothing = np.zeros((1, 3))
    terms = np.ones((12, 4), dtype=bool)
    whole = ThermalFit(
        value.reshape(12, 4),
        terms,
        covariance,
        0.0 * covariance,
        np.zeros(0),
        noise,
        0.0,
        nothing,
        nothing,
        nothing,
    )
    return whole, design, target


def restricted(design, target, keep):
    solution = np.zeros(design.shape[1])
    solution[keep], *_ = np.linalg.lstsq(design[:, keep], target, rcond=None)
    return solution


def test_holding_terms_at_zero_is_fitting_without_them(line):
    whole, design, target = line
    keep = np.arange(48) % 4 <= 2
    value, covariance = held_at_zero(whole.vector, whole.covariance, keep)
    assert value == pytest.approx(restricted(design, target, keep)[keep], abs=1e-9)
    assert covariance == pytest.approx(np.linalg.inv(design[:, keep].T @ design[:, keep]), abs=1e-12)


def test_terms_that_are_chance_are_dropped_and_their_doubt_is_what_they_would_change(line):
    whole, design, target = line
    choice = choose_degrees(whole, 3)
    assert np.all(choice.degrees >= 1)
    # 24 terms of no size: 5 % stay by chance
    assert choice.degrees.sum() <= 12 + 5
    power = np.arange(48) % 4
    keep = power <= np.repeat(choice.degrees, 4)
    without = restricted(design, target, keep)
    j = int(np.argmin(choice.degrees))
    for step in (0, 1):
        new = 4 * j + choice.degrees[j] + 1 + step
        change = restricted(design, target, keep | (np.arange(48) == new)) - without
        assert choice.doubts[step, j] == pytest.approx(change[4 * j : 4 * j + 4], abs=1e-9)


def test_of_a_full_degree_there_is_no_doubt(line):
    whole, _, _ = line
    steep = replace(whole, values=whole.values + np.array([0, 0, 0, 9.0]))
    choice = choose_degrees(steep, 3)
    assert choice.degrees.tolist() == [3] * 12
    assert not np.any(choice.doubts)


@pytest.mark.parametrize(
    ("low_c", "high_c", "told"),
    [(19.96, 85.04, "20.0 to 85.0 °C"), (20.03, 84.97, "20.1 to 84.9 °C"), (-10.04, 0.3, "-10.0 to 0.3 °C")],
)
def test_the_ends_of_a_range_in_words_lie_within_it(low_c, high_c, told):
    assert inner_range(low_c, high_c) == told


def test_a_fit_that_still_moves_after_the_last_step_is_refused(monkeypatch):
    monkeypatch.setattr(temperature_fit, "MOST_ITERATIONS", 1)
    readings = simulate(np.random.default_rng(SEED), truth(np.random.default_rng(SEED)))
    with pytest.raises(CalibrationError, match="did not converge: after 1 steps"):
        temperature_model([readings], MODEL, STAND_U, 9.81)
