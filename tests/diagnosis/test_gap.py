"""Held-out readings: prediction and its covariance against dense conditioning of a Gaussian."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.gap import Fold, Gap, HeldOut, folds_of, held_out, measure_gap, restrict, thirds_of
from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.noise_grid import noise_of_repeats
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.visibility import find_places
from bench.results.diagnosis_parts import gap_part
from bench.validation.paper_bench import SETTING_U_RAD
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up


@pytest.mark.parametrize("label", ["pass 2", "verification and free positions"])
def test_prediction_is_the_conditional_gaussian(label):
    """The coefficients get a prior of 1e3 V each in the dense computation: as good as none."""
    one = set_up(paper_run(np.random.default_rng(41)))
    linear = one.linear
    held = dict(folds_of(linear))[label]
    variant = next(v for v in one.candidates.variants if v.family == "quadratic_nonlinearity")
    effects = one.candidates.columns[:, list(variant.columns)]
    noise = NoiseSize(NOISE_V, SETTING_U_RAD, 100)
    found = held_out(linear, effects, noise, held)

    same = (linear.setting[:, None] == linear.setting[None, :]) & (linear.setting >= 0)[:, None]
    covariance = NOISE_V**2 * np.eye(len(linear))
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope, linear.slope), 0.0)
    covariance += linear.random @ linear.random.T + KNOWN_SIZE**2 * effects @ effects.T
    inverse = np.linalg.inv(covariance[np.ix_(~held, ~held)])
    x = linear.fixed
    gain = np.linalg.solve(x[~held].T @ inverse @ x[~held], x[~held].T @ inverse)
    weights = covariance[np.ix_(held, ~held)] @ inverse
    predictor = weights + (x[held] - weights @ x[~held]) @ gain
    expected = linear.response[held] - predictor @ linear.response[~held]
    both = np.concatenate([-predictor, np.eye(held.sum())], axis=1)
    order = np.concatenate([np.flatnonzero(~held), np.flatnonzero(held)])
    spread = both @ covariance[np.ix_(order, order)] @ both.T
    np.testing.assert_allclose(found.error, expected, atol=1e-9)
    assert found.chi2 == pytest.approx(expected @ np.linalg.solve(spread, expected), rel=1e-4)


@pytest.mark.slow
def test_held_out_chi_square_of_nulls_is_its_floor():
    """30 nulls (seed 42), each pass held out at known noise: mean of 90 reduced chi-squares of 54.

    Its standard error is at most sqrt(2/54/90) = 0.0203; 4 of them.
    """
    rng = np.random.default_rng(42)
    values = []
    for _ in range(30):
        linear = set_up(paper_run(rng, verification=False)).linear
        nothing = np.zeros((len(linear), 0))
        noise = NoiseSize(NOISE_V, SETTING_U_RAD, 100)
        values += [held_out(linear, nothing, noise, held).reduced for _, held in folds_of(linear)]
    assert abs(np.mean(values) - 1.0) < 4 * 0.0203


def test_a_part_of_the_rows_numbers_its_settings_anew():
    linear = set_up(paper_run(np.random.default_rng(43))).linear
    held = dict(folds_of(linear))["pass 1"]
    part = restrict(linear, ~held)
    assert len(part) == int((~held).sum())
    assert sorted(set(part.setting.tolist())) == [-1, *range(36)]


def test_noise_of_repeats_is_found_in_spite_of_an_effect():
    """24 settings of freedom, two directions across: sigma within 4 times 1/sqrt(2 * 48) of the truth."""
    for k2 in ((0, 0, 0), (300e-6, -200e-6, 100e-6)):
        linear = set_up(paper_run(np.random.default_rng(44), K2=k2, drift_v_per_h=(0, 50e-6, 0))).linear
        found = noise_of_repeats(linear, 0.0)
        assert found.freedom == 24
        assert abs(found.sigma / NOISE_V - 1) < 4 / np.sqrt(2 * 48)


def test_where_names_channel_installation_and_harmonic():
    """K2 of y in installation 2, where y turns in the plane: its square goes twice a turn."""
    one = set_up(paper_run(np.random.default_rng(45), K2=(0.0, 150e-6, 0.0)))
    repeats = noise_of_repeats(one.linear, 0.0)
    places = find_places(one.linear, one.grid, 3, repeats.sigma, 3 * repeats.freedom)
    first = places[0]
    assert (first.channel, first.installation, first.pattern) == ("y", "2", "twice per turn")
    assert first.p < 1e-6
    # a_y^2 = 1/2 + cos(2 phi)/2: half of K_yy K2
    assert first.size == pytest.approx(0.5 * 2.14 * 150e-6, rel=0.15)


@pytest.mark.slow
def test_where_is_silent_on_nulls():
    """20 nulls at 1 %, all looks counted: more than 3 have a probability of about 4e-5 (binomial)."""
    rng = np.random.default_rng(46)
    alarms = 0
    for _ in range(20):
        one = set_up(paper_run(rng))
        repeats = noise_of_repeats(one.linear, 0.0)
        alarms += bool(find_places(one.linear, one.grid, 3, repeats.sigma, 3 * repeats.freedom))
    assert alarms <= 3


# --- what is held out: passes where what was found repeats in them, else every third setting ----------


def gap_of(one, family, mounts=()):
    """The gap of one form of a family, which the search of each part of the readings finds again."""
    form = next(v for v in one.candidates.variants if (v.family, v.mounts) == (family, mounts))
    naming = Naming((FoundEffect(form, 100.0, 100.0, 10.0),))
    limit = OneThreshold().threshold(one.linear, one.whitened, SETTING_U_RAD)
    return measure_gap(one.linear, one.whitened, naming, NOISE, limit, SETTING_U_RAD, lambda *_: naming.found)


@pytest.fixture(scope="module")
def null():
    return set_up(paper_run(np.random.default_rng(47)))


def test_passes_are_held_out_where_an_effect_repeats_and_thirds_where_it_is_of_one(null):
    passes, thirds = ([label for label, _ in of(null.linear)] for of in (folds_of, thirds_of))
    assert [fold.label for fold in gap_of(null, "quadratic_nonlinearity").folds] == passes
    once = gap_of(null, "head_zero_shift", ("1 pass 2",))
    assert [fold.label for fold in once.folds] == thirds
    assert all(set(fold.gains) == {"head_zero_shift"} for fold in once.folds)


def stepped(channels, fraction):
    """A run in which the gain of channels made a step at the remount."""
    run = paper_run(np.random.default_rng(48))
    gain = np.where(np.isin(np.arange(3), channels), fraction, 0.0)
    return replace(run, signal=run.signal * (1.0 + gain * (run.installation != "1")[:, None]))


def test_thirds_are_held_out_where_a_part_alone_tells_the_form():
    """A step at the remount is one from installation 2 on; a third of the readings shows it alone."""
    one = set_up(stepped([0, 1, 2], 100e-6))
    thirds = [label for label, _ in thirds_of(one.linear)]
    assert [fold.label for fold in gap_of(one, "reference_step", ("2", "V")).folds] == thirds


@pytest.mark.slow
def test_a_step_of_the_gain_at_the_remount_closes_its_gap():
    """200 ppm, some 20 to 30 units of noise; the coefficients are those before the step, not after it."""
    found = diagnose(stepped([0], 200e-6), MODEL, STAND, cache=OneThreshold())
    assert [(one.name, one.installations) for one in found.effects] == [("scale_step", ("2", "V"))]
    assert found.gap.shrinks
    assert found.gap.closed > 0.8


def test_each_setting_is_in_one_third_and_each_angle_in_several(null):
    held = np.array([rows for _, rows in thirds_of(null.linear)])
    assert np.all(held.sum(axis=0) == 1)
    angle = np.round(np.degrees(null.linear.readings.angle_rad[null.linear.rows.reading]))
    in_1 = null.linear.readings.installation[null.linear.rows.reading] == "1"
    for degrees in (0.0, 45.0, 180.0):
        assert np.all(held[:, in_1 & (angle == degrees)].any(axis=1))


# --- the rule by which a gap shrinks, on folds made up: what it takes for a name alone ------------


ROWS = 50
NOISE = NoiseSize(15e-6, 1.6e-5, 150)


def made_up(reduced, rms=20e-6):
    error = np.full(ROWS, rms)
    return HeldOut(error, error / 2.0, np.full(ROWS, 9e-6), reduced * ROWS)


def fold(label, before, after, rms=(30e-6, 20e-6), name="bias_drift"):
    gains = {name: ROWS * (before - after)} if name else {}
    return Fold(label, gains, made_up(before, rms[0]), made_up(after, rms[1]))


def gap(*folds, named=("bias_drift",), undetermined=()):
    return Gap(folds, NOISE, "V", named, undetermined)


def test_a_gap_that_closes_shrinks_and_says_how_far():
    one = gap(fold("pass 1", 3.0, 1.0), fold("pass 2", 5.0, 1.2))
    assert one.shrinks is True
    assert one.reason == ""
    assert (one.before, one.after) == (pytest.approx(4.0), pytest.approx(1.1))
    assert one.closed == pytest.approx(2.9 / 3.0)
    told = gap_part(one).to_dict()
    assert told["before_rms_ug"] == pytest.approx(15.0)
    assert told["after_rms_ug"] == pytest.approx(10.0)
    assert told["expected_rms_ug"] == pytest.approx(9.0)
    assert told["reason"] is None


@pytest.mark.parametrize(
    "folds",
    [
        (fold("pass 1", 0.97, 1.02), fold("pass 2", 0.97, 1.02)),  # it grows
        (fold("pass 1", 1.10, 1.03),),  # by 3.5 in chi-square: chance does that
        (fold("pass 1", 5.0, 4.0),),  # a quarter of what is far above the noise
        (fold("pass 1", 3.0, 1.0, name="warm_up"), fold("pass 2", 3.0, 1.0, name="")),  # another name does it
    ],
)
def test_what_does_not_shrink_is_not_confirmed_and_says_so(folds):
    one = gap(*folds)
    assert one.shrinks is False
    assert one.unconfirmed == ("bias_drift",) or one.before_rms_g != one.after_rms_g
    assert f"{one.before:.2f} before, {one.after:.2f} after" in one.reason


def test_of_two_names_the_one_that_gains_nothing_is_told():
    both = {"bias_drift": 100.0, "backlash": 1.0}
    one = gap(Fold("pass 1", both, made_up(3.0, 30e-6), made_up(1.0)), named=("bias_drift", "backlash"))
    assert one.shrinks is False
    assert one.unconfirmed == ("backlash",)
    assert "do not confirm backlash (" in one.reason


def test_a_small_gap_need_only_fall_by_more_than_chance():
    """1.15 over 50 rows, 150 of freedom: chance reaches it in 26 %, and no half of 0.25 can be asked for."""
    assert gap(fold("pass 1", 1.25, 1.15)).shrinks is True


def test_a_gap_shrinks_where_chance_explains_what_remains():
    """Chance reaches 1.75 in 0.5 % and 1.4 in 6 %: less than half closes, and what remains is noise."""
    assert gap(fold("pass 1", 1.75, 1.4)).shrinks is True


def test_a_fold_that_is_made_worse_counts():
    """Passes close, and the verification points go from 9 to 103: no name alone."""
    one = gap(fold("pass 1", 3.95, 1.2), fold("verification and free positions", 8.9, 103.0))
    assert one.shrinks is False
    told = [(f["what"], f["counted"], f["left_out"]) for f in gap_part(one).to_dict()["held_out"]]
    assert told == [("pass 1", True, None), ("verification and free positions", True, None)]


def test_where_nothing_can_be_held_out_the_gap_is_none_and_says_why():
    assert gap().reason == "no readings can be held out: one pass, and no verification or free position"
    one = gap(undetermined=("pass 1",))
    told = gap_part(one).to_dict()
    assert one.shrinks is None
    assert (told["before"], told["after"], told["closed"], told["before_rms_ug"]) == (None,) * 4
    assert "without pass 1 the rest does not determine the coefficients" in told["reason"]
    assert told["held_out"][0]["before"] is None
    assert not told["held_out"][0]["confirmable"]


def test_with_nothing_found_there_is_nothing_to_confirm():
    one = gap(fold("pass 1", 1.0, 1.0, name=""), named=())
    assert (one.shrinks, one.reason) == (None, "")
    assert one.closed is None
