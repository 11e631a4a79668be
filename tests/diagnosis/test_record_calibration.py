"""Calibrations of records at a known input: gain and offset with a u that slow noise and the reference widen."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from bench.calibration.budget.sources import meter_gain_sources, unread_sources
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis.record_calibration import calibrate_record
from bench.diagnosis.record_diagnosis import GAIN_IN_DRIFT, diagnose_record
from bench.diagnosis.record_noise import NoiseTrials, slow_kernels
from bench.model import ForwardModel
from bench.model.effects import CATALOGUE, AppliedEffect
from bench.readings.columns import numbers
from bench.readings.csv import read_csv
from bench.readings.table import REFERENCE_V
from tests.support.known_inputs import GAIN, OFFSET, record_at_levels, switched_on


def test_two_levels_tell_gain_from_offset(tmp_path):
    found = calibrate_record(record_at_levels(tmp_path, 1))
    (x,) = found.channels
    assert abs(x.gain.value - GAIN) < 3 * x.gain.u
    assert abs(x.offset_v.value - OFFSET) < 3 * x.offset_v.u
    assert x.gain.u == pytest.approx(0.2e-6 / 5.0 / np.sqrt(240), rel=0.3)
    assert found.not_observable == ()
    assert x.covariance_v < 0.0
    assert not found.repeats.too_small


def test_a_mean_across_a_change_of_level_keeps_gain_and_offset(tmp_path):
    """1000 readings in 300 means: a mean has the readings, and the reference, of one level only."""
    (x,) = calibrate_record(record_at_levels(tmp_path, 9, count=1000)).channels
    assert abs(x.gain.value - GAIN) < 4 * x.gain.u
    assert abs(x.offset_v.value - OFFSET) < 4 * x.offset_v.u
    assert x.gain.u < 0.02e-6


def with_reference(readings, reference_v):
    extra = {**readings.extra, "reference_v": np.array([repr(v) for v in reference_v.tolist()])}
    return replace(readings, extra=extra)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_reference_that_only_rises_in_time_tells_no_gain(tmp_path, noise):
    readings = record_at_levels(tmp_path, 9, levels=(0.0,))
    ramp = 10.0 * readings.time_s / readings.time_s[-1]
    read = ramp + np.random.default_rng(1).normal(0.0, noise, len(ramp))
    ramped = with_reference(replace(readings, signal=readings.signal + GAIN * ramp[:, None]), read)
    gains = tuple(meter_gain_sources(load_bench(find_bench("paper-stand")), None))
    found = calibrate_record(ramped, hidden=gains)
    assert found.channels[0].gain is None
    assert "an error of the gain looks like a drift" in found.not_observable[0]
    (x,) = found.channels
    assert abs(x.offset_v.value - OFFSET) < 4 * x.offset_v.u
    assert abs(x.drift_v_h.value) < 4 * x.drift_v_h.u
    if not noise:  # u of the gain times the mean level, and times the slope
        u = gains[0].u
        assert (x.offset_v.u, x.drift_v_h.u) == pytest.approx((5.0 * u, 0.25 * u), rel=1e-3)
    assert any("u includes voltmeter_gain" in note for note in found.notes)
    assert found.repeats is None
    if noise:  # a diagnosis says the same of both
        assert GAIN_IN_DRIFT in diagnose_record(ramped).notes
    with pytest.raises(CalibrationError, match="no u of the gain"):
        calibrate_record(ramped)


@pytest.mark.parametrize(("level", "hidden"), [(0.0, "gain"), (10.0, "offset")])
def test_one_level_gives_one_of_the_two_and_says_so(tmp_path, level, hidden):
    found = calibrate_record(record_at_levels(tmp_path, 2, levels=(level,)))
    (x,) = found.channels
    assert (x.gain is None, x.offset_v is None) == (hidden == "gain", hidden == "offset")
    assert found.not_observable[0].startswith(f"{hidden}: the reference stays at")
    if hidden == "gain":
        assert abs(x.offset_v.value - OFFSET) < 3 * x.offset_v.u


def test_a_short_circuit_read_with_noise_tells_no_gain(tmp_path):
    readings = record_at_levels(tmp_path, 9, levels=(0.0,))
    read = np.random.default_rng(2).normal(0.0, 1e-7, len(readings))
    found = calibrate_record(with_reference(readings, read))
    assert found.channels[0].gain is None
    assert found.not_observable[0].startswith("gain: the reference stays at")


@pytest.mark.slow
def test_u_covers_the_truth_beside_slow_noise(tmp_path):
    """Random walks of 0.5 µV a reading wander by 8 µV; u of white noise alone would be 0.01 µV.

    Of 480 readings a mean has one or two: their scatter says little of the noise, and nothing of the walk.
    """
    pulls = []
    for seed in range(6):
        record = record_at_levels(tmp_path, seed, levels=(0.0,), walk=0.5e-6, count=480 if seed % 2 else 240)
        (x,) = calibrate_record(record).channels
        pulls.append((x.offset_v.value - OFFSET) / x.offset_v.u)
    # a chi-square of 6 degrees of freedom over 6 lies below 2.5 but for 2 in 100; with u of white noise it is 10^5
    assert np.mean(np.square(pulls)) < 2.5


@pytest.mark.slow
def test_u_of_the_gain_covers_a_gain_that_changes_slowly(tmp_path):
    """A gain with noise of 0.3 ppm that is correlated over 3 h (20 of 240 readings) is off by 0.12 ppm in the mean.

    With slow noise that is the same at 0 and 10 V only, these pulls have a mean square of 49.
    """
    pulls = []
    for seed in range(6):
        record = record_at_levels(tmp_path, seed)
        gain = signal.lfilter(
            [np.sqrt(1.0 - np.exp(-0.1))],
            [1.0, -np.exp(-0.05)],
            np.random.default_rng([7, seed]).normal(size=300),
        )
        added_v = 0.3e-6 * gain[60:, None] * numbers(record.extra[REFERENCE_V])[:, None]
        (x,) = calibrate_record(replace(record, signal=record.signal + added_v)).channels
        pulls.append((x.gain.value - GAIN) / x.gain.u)
    # as above: 2 in 100
    assert np.mean(np.square(pulls)) < 2.5


@pytest.mark.slow
def test_u_of_a_drift_covers_a_random_walk():
    """White noise and a walk of 100 times its variance; with equally probable kinds, 88 % are within 2 u."""
    time_h, rng = np.linspace(0.0, 10.0, 60), np.random.default_rng(11)
    line = np.column_stack([np.ones(60), time_h / 5.0 - 1.0])
    trials = NoiseTrials(tuple(np.linalg.eigh(kernel) for kernel in slow_kernels(time_h)), line)
    walks = np.cumsum(rng.normal(size=(150, 60)), axis=1) * np.sqrt(200.0 / 60.0)
    found = [trials.averaged(line, one[:, None]) for one in walks + rng.normal(size=(150, 60))]
    within = [abs(mean[1, 0]) < 2.0 * np.sqrt(spread[1, 1]) for mean, spread, _ in found]
    assert np.mean(within) > 0.92


def test_the_scatter_of_the_reference_is_in_u(tmp_path):
    plain, told = (
        calibrate_record(record_at_levels(tmp_path, 3, levels=(10.0,), sd=sd)) for sd in ("", "2e-5")
    )
    assert any("reference_sd_v is missing" in note for note in plain.notes)
    assert told.channels[0].gain.u == pytest.approx(2e-6, rel=0.01)
    assert told.channels[0].gain.u_readings == pytest.approx(plain.channels[0].gain.u)
    assert not any("reference_sd_v" in note for note in told.notes)


@pytest.mark.parametrize("u", [None, 0.1e-6])
def test_effects_of_a_model_are_taken_away_and_widen_u(tmp_path, u):
    """With u at their values, without u estimated again."""
    readings = record_at_levels(tmp_path, 4, levels=(0.0,), per_k=1e-6)
    effect = CATALOGUE["voltmeter_thermal_offset"]
    size = np.array([1e-6, 0.0, 0.0])
    applied = AppliedEffect(
        effect, {"offset": size}, ("x",), u={} if u is None else {"offset": size / 1e-6 * u}
    )
    before, after = calibrate_record(readings), calibrate_record(readings, [applied])
    assert after.channels[0].offset_v.u < before.channels[0].offset_v.u
    left = after.residual_of(readings)[:, 0]
    assert np.std(left) == pytest.approx(0.2e-6, rel=0.15)
    assert abs(after.channels[0].offset_v.value - OFFSET) < 4 * after.channels[0].offset_v.u


@pytest.mark.slow
def test_u_includes_the_uncertainty_of_a_time_constant_found_in_the_same_readings(tmp_path):
    """A time constant of 80 min in a record of 10 h is hardly separable from zero and drift."""
    readings = read_csv(switched_on(tmp_path, 3100, 20e-6, 80), ())
    diagnosis = diagnose_record(readings)
    (heating,), (effect,) = diagnosis.applied, diagnosis.effects
    tau, u_tau = (60.0 * minutes for minutes in (effect.parameters[1].value, effect.parameters[1].u))
    assert abs(tau - 80.0 * 60.0) < 2.0 * u_tau < 0.5 * tau
    assert float(heating.values["tau"]) == pytest.approx(tau)
    low, high = (
        calibrate_record(
            readings, [replace(heating, u={}, values={**heating.values, "tau": np.array(value)})]
        ).channels[0]
        for value in (tau - 0.5 * u_tau, tau + 0.5 * u_tau)
    )
    found = calibrate_record(readings, [replace(heating, u={})]).channels[0]
    by_tau = abs(high.gain.value - low.gain.value)
    assert abs(found.gain.value - 1.0) < 2.0 * by_tau < 3e-6
    assert found.gain.u_readings == pytest.approx(by_tau, rel=0.3)


@pytest.mark.slow
def test_a_note_says_that_a_model_states_no_u_of_a_shape(tmp_path):
    readings = record_at_levels(tmp_path, 4, per_k=1e-6)
    size = np.array([1e-6, 0.0, 0.0])
    values = {"offset": size, "lag": np.array(600.0)}
    applied = AppliedEffect(CATALOGUE["voltmeter_thermal_offset"], values, ("x",), u={"offset": size / 10.0})
    note = "voltmeter_thermal_offset keeps lag 10 min"
    assert any(note in one for one in calibrate_record(readings, [applied]).notes)
    again = calibrate_record(readings, [replace(applied, u={})])
    assert not any(note in one for one in again.notes)
    assert abs(again.channels[0].gain.value - GAIN) < 4 * again.channels[0].gain.u


@pytest.mark.parametrize("unit", ["gain", "offset"])
def test_an_effect_of_a_temperature_that_is_not_recorded_widens_u(tmp_path, unit):
    """With a lag far longer than the record, 5 ppm/K (µV/K) within ±5 K: 14.4 ppm, or 14.4 µV."""
    readings = record_at_levels(tmp_path, 5)
    values = {unit: np.full(3, 3e-6), "lag": np.array(1e9)}
    effect = AppliedEffect(CATALOGUE[f"voltmeter_thermal_{unit}"], values, u={unit: np.full(3, 4e-6)})
    unread = tuple(unread_sources(load_bench(find_bench("paper-stand")), ForwardModel({}, effects=(effect,))))
    without = {name: cells for name, cells in readings.extra.items() if name != "meter_temperature_c"}
    found = calibrate_record(replace(readings, extra=without), [effect], unread)
    (x,) = found.channels
    assert (x.gain.u if unit == "gain" else x.offset_v.u) == pytest.approx(
        5e-6 * 5.0 / np.sqrt(3.0), rel=1e-3
    )
    assert (x.offset_v.u if unit == "gain" else x.gain.u) < 1e-6
    assert any("temperature not recorded" in note for note in found.notes)
    known = calibrate_record(readings, [effect], unread)
    assert not any("temperature not recorded" in note for note in known.notes)


def test_signals_in_another_unit_than_the_reference_are_told(tmp_path):
    readings = record_at_levels(tmp_path, 6, levels=(10.0,))
    assert not any("units" in note for note in calibrate_record(readings).notes)
    found = calibrate_record(replace(readings, signal=1e-6 * readings.signal))
    assert "ux_v is 1e-05 V where reference_v is 10 V; check their units in the mapping" in found.notes
