"""The robust estimator: outliers found, their number right, nothing lost where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bench.calibration import Noise, calibrate
from bench.calibration.outliers import critical
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from tests.support.honest_runs import MODEL
from tests.support.results import calibration_json

RUNS = 50


def run(seed, noise_v=1e-4, passes=3):
    return simulate(np.random.default_rng(seed), noise_v, passes=passes)


def robust(readings):
    return calibrate(readings, MODEL, STAND_U, 9.81, "robust")


@pytest.fixture(scope="module")
def clean():
    """Both estimates of 50 clean runs, seeds [61, k]."""
    tables = [run([61, k]) for k in range(RUNS)]
    return [(robust(t), calibrate(t, MODEL, STAND_U, 9.81)) for t in tables]


@pytest.mark.slow
def test_efficiency_on_clean_data(clean):
    """Promised: 0.95 or more, the variance of the default estimator over that of the robust one."""
    errors = [np.array([r[i].block.vector - TRUTH for r in clean]) for i in (0, 1)]
    efficiency = np.mean(errors[1] ** 2, axis=0) / np.mean(errors[0] ** 2, axis=0)
    assert np.all(efficiency > 0.95), efficiency.round(3)


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_they_should_be(clean):
    """The level is 1 % for a whole table, all looks together; binomial bound 1e-4. So for the default's note."""
    most = stats.binom.ppf(1 - 1e-4, RUNS, 0.01)
    assert sum(bool(r[0].outliers) for r in clean) <= most
    assert sum(any("outlier" in note for note in r[1].notes) for r in clean) <= most
    for with_weights, plain in clean:
        if not with_weights.outliers:
            np.testing.assert_array_equal(with_weights.block.vector, plain.block.vector)


@pytest.mark.parametrize("size_v", [1.5e-3, 0.05, 3.0])
@pytest.mark.parametrize("passes", [1, 3])
def test_one_wrong_signal_is_found_and_costs_nothing(size_v, passes):
    readings = run([62, passes], passes=passes)
    readings.signal[13, 1] += size_v
    result = robust(readings)
    (found,) = result.outliers
    assert (found.row, found.installation, found.point, found.channel) == (
        14, readings.installation[13], readings.point[13], "y"
    )  # fmt: skip
    assert found.size == pytest.approx(size_v, abs=5e-4)
    assert found.sigma > 5
    assert found.weight == 0
    (told,) = calibration_json(result)["outliers"]
    assert (told["row"], told["pass"], told["point"]) == (14, readings.pass_number[13], found.point)
    assert (told["channel"], told["unit"]) == ("y", "V")
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)
    assert len(result.fitted) == len(readings)
    # the size is that of the fit without what readings share, which weighs them otherwise
    assert result.residuals[13, 1] == pytest.approx(found.size, abs=0.2e-4)
    without = replace(readings, signal=readings.signal.copy())
    without.signal[13, 1] -= size_v
    undisturbed = robust(without)
    assert np.all(np.abs(result.block.vector - undisturbed.block.vector) < 1.5 * undisturbed.u)
    assert np.all(result.u < 1.5 * undisturbed.u)


def test_a_wrong_setting_is_one_outlier_of_the_head():
    """Ten minutes of angle written wrongly move all three signals along du/dphi."""
    readings = run([63, 1])
    readings.angle_rad[19] -= np.radians(10 / 60)
    result = robust(readings)
    (found,) = result.outliers
    assert (found.row, found.channel, found.unit) == (20, "head", "arcsec")
    assert found.size == pytest.approx(600, abs=60)
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)


def test_several_that_hide_each_other_are_all_found():
    """Two of three passes at one point wrong by the same amount, and two more elsewhere."""
    readings = run([64, 1])
    for row, channel, size in ((4, 0, 5e-3), (13, 0, 5e-3), (33, 2, -4e-3), (50, 1, 6e-3)):
        readings.signal[row, channel] += size
    result = robust(readings)
    assert {(o.row - 1, o.channel) for o in result.outliers} == {(4, "x"), (13, "x"), (33, "z"), (50, "y")}
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)
    assert result.noise.reading == pytest.approx(1e-4, rel=0.35)
    assert result.lack_of_fit.p > 1e-3


def test_the_default_says_that_an_outlier_is_evident_and_keeps_it():
    readings = run([65, 1])
    readings.signal[8, 2] += 5e-3
    result = calibrate(readings, MODEL, STAND_U, 9.81)
    note = result.notes[0]
    assert "outlier found: row 9 (installation 1, pass 1, point 9), z: off by +0.00" in note
    assert "'robust'" in note
    assert result.outliers == ()
    assert result.noise.reading > 3e-4


def test_given_sizes_of_the_noise_take_part_in_the_test():
    readings = run([66, 1], passes=1)
    readings.signal[3, 0] += 1e-3
    given = Noise(1e-4, 1e-5, np.inf, "given")
    assert [o.row for o in calibrate(readings, MODEL, STAND_U, 9.81, "robust", given).outliers] == [4]
    loose = Noise(1e-3, 1e-5, np.inf, "given")
    assert calibrate(readings, MODEL, STAND_U, 9.81, "robust", loose).outliers == ()


def test_critical_values():
    """Two-sided 1 % over all candidates, by scipy's distributions."""
    assert critical(216, 71.0) == pytest.approx(stats.t.ppf(1 - 0.005 / 216, 71))
    assert critical(216, np.inf) == pytest.approx(stats.norm.ppf(1 - 0.005 / 216))


def test_gross_slip_of_a_degree_leaves_the_truth():
    """A whole degree: the second order of the slip is beyond the noise, too."""
    readings = run([67, 1], noise_v=2e-5)
    readings.angle_rad[30] += np.radians(1.0)
    result = robust(readings)
    assert {o.row for o in result.outliers} == {31}
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)
