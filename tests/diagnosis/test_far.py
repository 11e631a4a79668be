"""Readings far from the final model: their sizes are deletion residuals, and no verdict passes them over."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.diagnosis import diagnose
from bench.diagnosis.levels import BY_CHANCE, FAR
from bench.diagnosis.linear import orientation_of
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.visibility import far_readings
from bench.model.geometry import STAND_ANGLES, specific_force_on_platform
from bench.results.diagnosis_words import verdict_in_words, warnings_in_words
from bench.validation.paper_bench import SETTING_U_RAD, K
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

NOISE = NoiseSize(NOISE_V, SETTING_U_RAD, 150)


def off(readings, row, size_v):
    """The readings with one of them changed by so much along its force, V: in the modulus it shows whole."""
    signal = readings.signal.copy()
    along = signal[row] / np.linalg.norm(signal[row])
    signal[row] += size_v * along
    return replace(readings, signal=signal)


@pytest.mark.parametrize("row", [57, 120, 163])
def test_the_size_is_the_residual_of_a_fit_without_the_row(row):
    """Rows of a setting of installation 1 and 2, and a modulus, off by 30 times the noise."""
    one = set_up(paper_run(np.random.default_rng(51)))
    linear = replace(one.linear, response=one.linear.response + 30 * NOISE_V * (np.arange(166) == row))
    form = next(v for v in one.candidates.variants if v.family == "quadratic_nonlinearity")
    effects = one.candidates.columns[:, list(form.columns)]
    held = np.arange(len(linear)) == row
    # the row given all others, those of its own setting among them, by dense conditioning
    covariance = np.diag((NOISE_V * linear.relative) ** 2)
    same = (linear.setting[:, None] == linear.setting) & (linear.setting >= 0)
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope, linear.slope), 0.0)
    covariance += linear.random @ linear.random.T + 20.0**2 * effects @ effects.T
    rest = ~held
    inverse, x = np.linalg.inv(covariance[np.ix_(rest, rest)]), linear.fixed
    normal = np.linalg.inv(x[rest].T @ inverse @ x[rest])
    fitted = normal @ x[rest].T @ inverse @ linear.response[rest]
    weights = covariance[held][:, rest] @ inverse
    left = linear.response[held] - x[held] @ fitted - weights @ (linear.response[rest] - x[rest] @ fitted)
    free = x[held] - weights @ x[rest]
    variance = covariance[held][:, held] - weights @ covariance[rest][:, held] + free @ normal @ free.T
    expected = abs(float(left[0])) / float(np.sqrt(variance[0, 0]))
    found = far_readings(linear, effects, NOISE)
    reading = linear.rows.reading[row]
    channel = ("x", "y", "z", "modulus")[linear.rows.channel[row]]
    (told,) = [
        one
        for one in found
        if (one.point, one.channel) == (int(linear.readings.point[reading]), channel)
        and one.pass_number == linear.readings.pass_number[reading]
    ]
    assert told.size_u == pytest.approx(expected, rel=1e-4)


def test_nulls_have_none():
    """166 residuals and 54 settings at 6 u: less than once in a million."""
    one = set_up(paper_run(np.random.default_rng(52)))
    assert far_readings(one.linear, np.zeros((len(one.linear), 0)), NOISE) == ()
    assert FAR == 6.0


def off_in_the_headline(times):
    """What is far, and the whole diagnosis, of a run whose second verification point is off by so many u."""
    readings = paper_run(np.random.default_rng(53))
    row = int(np.flatnonzero(readings.installation == "V")[1])
    return off(readings, row, U_OF_POINT * times * NOISE_V)


U_OF_POINT = 1.3
"""u of a modulus without itself, in units of the noise of a reading: stand and coefficients have a part in it."""


@pytest.mark.slow
def test_a_verification_point_that_is_off_is_far_from_the_model_whatever_its_size():
    sizes = []
    for times in (8, 12, 16, 24):
        one = set_up(off_in_the_headline(times))
        found = far_readings(one.linear, np.zeros((len(one.linear), 0)), NOISE)
        (told,) = [far for far in found if far.installation == "V"]
        assert (told.pass_number, told.point, told.channel) == (1, 2, "modulus")
        assert told.p < 1e-6
        sizes.append(told.size_u)
    np.testing.assert_allclose(sizes, [8, 12, 16, 24], rtol=0.25)
    np.testing.assert_allclose(np.diff(sizes) / [4, 4, 8], (sizes[-1] - sizes[0]) / 16, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("times", [8, 24])
def test_a_verification_point_that_is_off_is_never_silent_and_no_name_alone(times):
    """Four moduli tell little: effects of their mounting may explain it, and the readings held out deny them."""
    found = diagnose(off_in_the_headline(times), MODEL, STAND, np.diag(K), OneThreshold())
    # the heavy tails that the readings may have give a small one anywhere: it is told, and decides from 1 % on
    likely = all(far.p >= BY_CHANCE for far in found.far)
    assert found.verdict in {"confounded", "unknown", "mistake", *(["agrees"] if likely else [])}
    assert [far for far in found.far if (far.installation, far.point) == ("V", 2)]
    assert "installation V, pass 1, point 2" in "; ".join(verdict_in_words(found))


@pytest.mark.slow
def test_a_reading_that_is_far_is_in_the_headline_with_its_probability():
    """Where a search finds nothing, as its threshold is out of reach, the reading is told all the same."""
    found = diagnose(
        off_in_the_headline(16), MODEL, STAND, np.diag(K), OneThreshold(1e9, 0.006, 1e8, 0.05, 1.0, 2000)
    )
    assert found.verdict == "unknown"
    told = "; ".join(warnings_in_words(found))
    assert "|a| in installation V, pass 1, point 2 is 1" in told
    assert "probability that noise alone moves any reading that far: p" in told
    # one point that far is also evidence of heavy tails, in which it is rare all the same
    assert found.far[0].p < 0.01


def test_one_direction_off_a_line_in_nine_determines_the_orientation_at_the_verification_points():
    angle_rad = np.radians([*[0.0, 180.0] * 4, 90.0])
    platform = specific_force_on_platform(angle_rad, np.zeros((9, len(STAND_ANGLES))))
    turned = Rotation.from_rotvec(np.radians([0.0, 0.0, 10.0])).as_matrix()
    force = platform @ (turned @ MODEL.installations["V"].block_from_platform).T
    seen = SimpleNamespace(installation=np.full(9, "V"), angle_rad=angle_rad)
    found = orientation_of(MODEL, seen, force, {})
    assert found.contradicts
    assert np.degrees(found.off_rad) == pytest.approx(10.0)
    assert (
        orientation_of(MODEL, SimpleNamespace(**{**vars(seen), "angle_rad": angle_rad * 0.0}), force, {})
        is None
    )
    assert found.head_rad is None  # the turn is about z of the block; the head's axis is between x and y


@pytest.mark.parametrize("off_deg", [90.0, -30.0, 180.0])
def test_a_head_that_was_off_at_the_verification_points_is_in_the_note(off_deg):
    angle_rad = np.radians([0.0, 45.0, 90.0, 200.0])
    still = np.zeros((4, len(STAND_ANGLES)))
    platform = specific_force_on_platform(angle_rad + np.radians(off_deg), still)
    seen = SimpleNamespace(installation=np.full(4, "V"), angle_rad=angle_rad)
    force = platform @ MODEL.installations["V"].block_from_platform.T
    found = orientation_of(MODEL, seen, force, {})
    assert found.contradicts
    assert np.degrees(found.head_rad) % 360 == pytest.approx(off_deg % 360)
    assert f"turned by {abs(off_deg):.0f}° about" in found.in_words()
    assert f"{abs(off_deg):.0f}° from where it says at these points" in found.in_words()
