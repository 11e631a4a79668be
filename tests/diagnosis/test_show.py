"""Simulation beside bench: what is simulated again, how it is tested, and what a rival would change."""

from dataclasses import replace

import numpy as np
import pytest

from bench.base.files import cache_folder
from bench.calibration import calibrate
from bench.calibration.result import DeviatingReadings
from bench.calibration.verification import verify
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis import ThresholdCache, diagnose
from bench.diagnosis.pipeline import UNEXPLAINED, diagnose_fully, rivals
from bench.diagnosis.show import label, show
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.validation.paper_bench import STAND_U
from tests.support.diagnosis_bench import MODEL, STAND, paper_run

G = 9.81
LARGE = (0.0, 3e-3, 0.0)


def quadratic(y=0.0, u=None):
    stated = {} if u is None else {"K2": np.array([0.0, u, 0.0])}
    return AppliedEffect(CATALOGUE["quadratic_nonlinearity"], {"K2": np.array([0.0, y, 0.0])}, ("y",), stated)


def test_without_effects_it_is_what_calibrate_and_verify_give():
    readings = paper_run(np.random.default_rng(3))
    shown = show(readings, MODEL, (), STAND, G)
    whole = calibrate(readings, MODEL, STAND_U, G)
    assert shown.after is None
    assert np.allclose(shown.before.calibration.block.vector, whole.block.vector, rtol=1e-12)
    calibration = calibrate(readings, MODEL, STAND_U, G, find_shared=False)
    assert shown.before.test.chi2 == pytest.approx(calibration.lack_of_fit.chi2, rel=1e-6)
    assert shown.before.test.dof == calibration.lack_of_fit.dof
    points = verify(readings, calibration.block, calibration.covariance, calibration.noise.by_channel, 3e-4)
    for mine, theirs in zip(shown.before.points, points.points, strict=True):
        assert mine.delta_g == pytest.approx(theirs.delta_g, abs=1e-12)
        # one size of the noise for all channels there, one for each here
        assert mine.u == pytest.approx(theirs.u, rel=0.1)


def test_u_includes_slow_noise_by_what_a_refit_of_each_of_its_components_changes():
    readings = paper_run(np.random.default_rng(6))
    time = readings.conditions().elapsed_s[:, None] / 1e4
    slow = np.zeros((len(readings), 3, 2))
    slow[:, 0] = 20e-6 * np.hstack([np.ones_like(time), time])
    slow[~readings.is_oriented] = 0.0
    plain = show(readings, MODEL, (), STAND, G).before.calibration
    wide = show(readings, MODEL, (), STAND, G, slow=slow).before.calibration
    moved = [
        calibrate(replace(readings, signal=readings.signal + slow[:, :, k]), MODEL, STAND, G).block.vector
        for k in range(2)
    ]
    expected = plain.u**2 + np.sum((np.array(moved) - plain.block.vector) ** 2, axis=0)
    assert np.allclose(wide.u, np.sqrt(expected), rtol=0.02)
    assert wide.u[9] > 20e-6 > 3 * plain.u[9]  # a constant is indistinguishable from the bias


@pytest.mark.slow
def test_the_effect_is_taken_off_at_the_verification_points():
    # 3 mg/g^2 in channel y, noise hardly any: the modulus is out by far without it and right with it
    readings = paper_run(np.random.default_rng(4), K2=LARGE, noise_v=1e-6)
    shown = show(readings, MODEL, (quadratic(2.9e-3),), STAND, G)
    before = np.array([p.delta_g for p in shown.before.points])
    after = np.array([p.delta_g for p in shown.after.points])
    u = np.array([p.u for p in shown.after.points])
    assert np.max(np.abs(before)) > 1e-4
    assert np.all(np.abs(after) < 4 * u)
    assert np.max(u) < 1e-4
    (found,) = shown.after.effects
    assert abs(found.values["K2"][1] - 3e-3) < 4 * found.u["K2"][1]


@pytest.mark.slow
def test_the_fresh_test_fails_before_and_passes_after():
    p = []
    for seed in range(20, 30):
        readings = paper_run(np.random.default_rng(seed), K2=(0.0, 2e-4, 0.0))
        shown = show(readings, MODEL, (quadratic(1e-4),), STAND, G)
        assert shown.before.test.p < 1e-6
        p.append(shown.after.test.p)
        # a simulated run scatters like the readings: two estimates from 96 signals each, 10 % apart by chance
        assert shown.after.repeated.lack_of_fit.rms == pytest.approx(shown.after.test.rms, rel=0.4)
    # uniform when the model is right: ten of which the least is below 0.001 come once in a hundred times
    assert min(p) > 1e-3


def test_a_known_effect_keeps_what_is_known_and_a_new_one_is_estimated_anew():
    readings = paper_run(np.random.default_rng(5), K2=(0.0, 1e-4, 0.0))
    known = ForwardModel(MODEL.installations, (quadratic(1e-4, u=1e-7),), "known")
    drift = AppliedEffect(CATALOGUE["bias_drift"], {"rate": np.zeros(3)}, ("x",), {"rate": np.full(3, 1e-12)})
    shown = show(readings, known, (drift,), STAND, G)
    k2, rate = shown.after.effects
    assert k2.u["K2"][1] < 1.01e-7
    assert rate.u["rate"][0] > 1e-10
    assert shown.after.model.name == "known + bias_drift[x]"
    assert label(AppliedEffect(CATALOGUE["backlash"], {})) == "backlash"


def test_what_an_effect_found_lacks_is_at_most_plausible():
    """Of a tilt of the foundation across the axis alone, the tilt along it would open a coefficient."""
    tilt = CATALOGUE["foundation_tilt"]
    shape = {p.name: np.array(p.grid[-1]) for p in tilt.parameters if p.grid}
    across = {name: np.array(1e-4) for name in ("across_cosine", "across_sine")}
    shown = show(paper_run(np.random.default_rng(5)), MODEL, (AppliedEffect(tilt, shape | across),), STAND, G)
    (found,) = shown.after.effects
    plausible = {p.name: p.plausible for p in tilt.parameters}
    assert all(0.0 < found.u[name] <= plausible[name] for name in ("cosine", "sine"))
    assert max(shown.after.calibration.u / shown.before.calibration.u) < 3.0


def test_an_effect_that_only_verification_points_show_lets_them_take_part():
    readings = paper_run(np.random.default_rng(6))
    roll = AppliedEffect(CATALOGUE["mounting_roll"], {"angle": np.zeros(())}, installations=("1",))
    shown = show(readings, MODEL, (roll,), STAND, G)
    assert shown.after.joined
    (found,) = shown.after.effects
    assert abs(float(found.values["angle"])) < 4 * float(found.u["angle"])
    # 90 arcsec make about 218 ug of the modulus (facts of the paper's geometry): u of 15 ug is some 6 arcsec
    assert np.degrees(float(found.u["angle"])) * 3600 < 30
    without = show(readings.select(readings.installation != "V"), MODEL, (roll,), STAND, G)
    assert not without.after.joined
    assert without.after.points == ()


def test_verification_points_that_tell_no_more_of_an_effect_remain_a_check():
    readings = paper_run(np.random.default_rng(6))
    marks = AppliedEffect(CATALOGUE["head_graduation"], {})
    # no reading tells of the marks between its angles, and a modulus depends on no angle of the head
    assert not show(readings, MODEL, (marks,), STAND, G).after.joined


def test_a_pass_that_no_mistake_or_effect_explains_is_named_with_what_to_do(monkeypatch):
    """The head stood 120° off in one pass, no number of stops; the diagnosis does not recommend itself."""
    readings = paper_run(np.random.default_rng(9))
    wrong = (readings.installation == "1") & (readings.pass_number == 2)
    bad = replace(readings, angle_rad=readings.angle_rad + np.where(wrong, np.radians(120.0), 0.0))
    with pytest.raises(DeviatingReadings) as spoiled:
        show(bad, MODEL, (), STAND, G)
    assert spoiled.value.args[0].endswith("these readings are far off: all of installation 1, pass 2")
    monkeypatch.setattr("bench.diagnosis.pipeline.show", lambda *_, **__: show(bad, MODEL, (), STAND, G))
    bench, cache = load_bench(find_bench("paper-stand")), ThresholdCache(cache_folder("thresholds"))
    with pytest.raises(DeviatingReadings) as told:
        diagnose_fully(readings, MODEL, bench, G, cache, source="", simulated=True)
    assert told.value.args == (spoiled.value.args[0], UNEXPLAINED)


@pytest.mark.slow
def test_a_rival_changes_the_coefficients_as_a_calibration_with_it_does():
    readings = paper_run(np.random.default_rng(7), K2=(0.0, 6e-5, 0.0), verification=False)
    diagnosis = diagnose(readings, MODEL, STAND, None, ThresholdCache(cache_folder("thresholds")))
    (ranked,) = rivals(diagnosis)
    by_name = {rival.family: rival for rival in ranked}
    assert ranked[0].family == diagnosis.effects[0].name == "quadratic_nonlinearity"
    assert np.allclose(ranked[0].shift, 0.0, atol=1e-9)
    evidence = [rival.evidence for rival in ranked]
    assert evidence == sorted(evidence, reverse=True)
    named = calibrate(
        readings, ForwardModel(MODEL.installations, (quadratic(),)), STAND_U, G, find_shared=False
    )
    other = AppliedEffect(CATALOGUE["scale_asymmetry"], {"Kabs": np.zeros(3)}, ("y",))
    instead = calibrate(readings, ForwardModel(MODEL.installations, (other,)), STAND_U, G, find_shared=False)
    shift = (instead.block.vector - named.block.vector) / named.u
    # calibrate has the noise of the repeats, the diagnosis that of all residuals: alike to some 15 %
    assert np.allclose(by_name["scale_asymmetry"].shift, shift, atol=0.3 + 0.2 * np.max(np.abs(shift)))


@pytest.mark.slow
def test_u_with_a_find_includes_what_calibrations_with_its_ties_give():
    readings = paper_run(np.random.default_rng(7), K2=(0.0, 3e-5, 0.0), verification=False)
    diagnosis = diagnose_fully(
        readings,
        MODEL,
        load_bench(find_bench("paper-stand")),
        G,
        ThresholdCache(cache_folder("thresholds")),
        source="",
        simulated=True,
    )
    after = diagnosis.shown.last.calibration
    (effect,) = diagnosis.diagnosis.effects
    assert effect.name == "quadratic_nonlinearity"
    odds = {one.name: one.probability for one in effect.odds}
    named, absolute, product = (
        calibrate(readings, ForwardModel(MODEL.installations, (one,)), STAND_U, G, find_shared=False)
        for one in (
            quadratic(),
            AppliedEffect(CATALOGUE["scale_asymmetry"], {"Kabs": np.zeros(3)}, ("y",)),
            AppliedEffect(CATALOGUE["cross_quadratic"], {"Kpp": np.zeros(3), "Koo": np.zeros(3)}, ("y",)),
        )
    )
    # the bias of y; thermal_nonlinearity changes it alike, and two sizes of the noise differ by some 15 %
    of_absolute, of_product = (one.block.vector[10] - named.block.vector[10] for one in (absolute, product))
    by_names = odds["scale_asymmetry"] * of_absolute**2 + odds["cross_quadratic"] * of_product**2
    assert by_names > 0.7 * named.u[10] ** 2
    assert after.u[10] == pytest.approx(np.sqrt(named.u[10] ** 2 + by_names), rel=0.15)
