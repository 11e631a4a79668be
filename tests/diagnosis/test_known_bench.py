"""What of a bench is known: what it has not is no candidate, where its file is wrong the signals are believed."""

from dataclasses import replace

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis import ThresholdCache, diagnose
from bench.diagnosis.candidates import make_candidates
from bench.diagnosis.evidence import make_threshold
from bench.diagnosis.known_bench import NOTHING_KNOWN, KnownBench
from bench.diagnosis.linear import make_linear
from bench.diagnosis.result import assumed
from bench.diagnosis.visibility import looking_like
from bench.model import CATALOGUE, AppliedEffect, Installation
from bench.validation.paper_bench import STAND_U
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, paper_run, set_up

TOLD_OF_METERS = ("voltmeter_gain", "wrong_gravity")


def known(name):
    return KnownBench.of(load_bench(find_bench(name)))


WITHOUT_A_RECORD = [
    "voltmeter_thermal_gain", "voltmeter_thermal_offset", "voltmeter_move", "reference_supply",
]  # fmt: skip


NOT_SHOWN = [name for name in WITHOUT_A_RECORD if name != "voltmeter_move"]


def absent(bench, readings):
    """What this bench cannot have, without what no run shows that has no temperature of the meters."""
    return [name for name in bench.absent(readings) if name not in WITHOUT_A_RECORD]


def test_effects_of_the_meters_temperature_are_looked_for_where_it_was_recorded():
    readings = paper_run(None)
    assert list(NOTHING_KNOWN.absent(readings)) == WITHOUT_A_RECORD
    warm = replace(readings, extra={"meter_temperature_c": np.full(len(readings), "24.5")})
    assert list(NOTHING_KNOWN.absent(warm)) == WITHOUT_A_RECORD[2:]


def test_a_bench_with_meters_of_their_own_and_fixed_ranges_has_no_crosstalk_and_no_other_range():
    readings = paper_run(None)
    assert absent(known("paper-stand"), readings) == ["range_offset", "channel_crosstalk"]
    assert absent(known("bench-multiplexer"), readings) == ["meters_exchanged", "range_offset"]
    assert "backlash" in known("bench-rate-table").absent(readings)
    assert absent(NOTHING_KNOWN, readings) == []


def test_the_record_of_ranges_counts_for_more_than_the_bench_file():
    readings = paper_run(None)
    changing = np.where(np.abs(readings.signal[:, 0]) < 1.2, "1", "10")
    both = replace(readings, extra={"range_v": changing})
    assert "range_offset" not in known("paper-stand").absent(both)
    one = replace(readings, extra={"range_v": np.full(len(readings), "10")})
    assert absent(NOTHING_KNOWN, one) == ["range_offset"]


def test_what_is_absent_is_no_candidate():
    linear = make_linear(paper_run(np.random.default_rng(1)), MODEL, STAND_U)
    cannot = known("paper-stand").absent(linear.readings)
    families = make_candidates(linear, NOISE_V, absent=cannot).families
    assert set(make_candidates(linear, NOISE_V).families) - set(families) == set(cannot) - set(NOT_SHOWN)


def test_periods_that_look_alike_at_the_angles_measured_are_known():
    eighths, twelfths = np.radians(np.arange(0, 361, 45)), np.radians(np.arange(0, 361, 30))
    assert looking_like(eighths, 2)[:3] == (6, 10, 14)
    assert looking_like(eighths, 0)[:2] == (8, 16)
    assert 72 in looking_like(eighths, 0)
    assert looking_like(twelfths, 2)[:2] == (10, 14)
    rng = np.random.default_rng(2)
    # settings scatter by seconds of arc, and that tells nothing apart
    scattered = np.concatenate([eighths] * 3) + rng.normal(0, 2e-5, 27)
    assert looking_like(scattered, 2)[:3] == (6, 10, 14)
    assert looking_like(rng.uniform(0, 2 * np.pi, 300), 2) == ()


def turned(psi_deg):
    """Return the model of a bench file that states another angle of the verification points."""
    other = Installation.from_axes("V", ("x", "y", "z"), np.radians(psi_deg), "z")
    return replace(MODEL, installations={**MODEL.installations, "V": other})


def unseen_by_coefficients(linear, name):
    """How much of an effect's rows the twelve coefficients leave, as a part of it."""
    effect = CATALOGUE[name]
    (parameter,) = effect.parameters
    column = linear.effect_column(AppliedEffect(effect, {parameter.name: np.asarray(parameter.plausible)}))
    fitted = linear.fixed @ np.linalg.lstsq(linear.fixed, column, rcond=None)[0]
    return float(np.linalg.norm(column - fitted) / np.linalg.norm(column))


@pytest.mark.parametrize("stated_deg", [45.0, 10.0, 80.0])
def test_the_verification_points_stand_as_their_signals_say(stated_deg):
    readings = paper_run(np.random.default_rng(3))
    linear = make_linear(readings, turned(stated_deg), STAND_U)
    off = linear.orientation
    # mounting errors of 30 arcsec, 1 sigma, and the noise: within a minute or two of arc
    assert np.degrees(off.off_rad) == pytest.approx(abs(45 - stated_deg), abs=0.1)
    assert off.contradicts is (stated_deg != 45)
    told = [line for line in assumed(linear) if "contradict" in line]
    assert len(told) == (stated_deg != 45)
    measured = linear.model.installations["V"].block_from_platform
    right = MODEL.installations["V"].block_from_platform
    np.testing.assert_allclose(measured, right, atol=2e-3)
    for name in TOLD_OF_METERS:  # a common factor shows nowhere, whatever the bench file says of V
        assert unseen_by_coefficients(linear, name) < 1e-3


def test_what_needs_temperatures_is_said_not_to_be_looked_for():
    readings = paper_run(np.random.default_rng(4))
    blind = replace(readings, temperature_c=np.full(len(readings), np.nan))
    ready = set_up(blind)
    assert not {"thermal_bias", "thermal_scale"} & set(ready.candidates.families)
    assert any("no temperatures" in line for line in assumed(ready.linear))


class Quick(ThresholdCache):
    """A threshold of fewer nulls: a test needs none that is sharp."""

    def threshold(self, linear, whitened, setting_rad):
        return make_threshold(linear, whitened, 300)


@pytest.mark.slow
def test_equal_volts_in_three_channels_point_at_what_they_share():
    readings = paper_run(np.random.default_rng(5), directions=(1, -1, 1))
    settling = 150e-6 * np.exp(-readings.time_s / 1200.0)
    spoilt = replace(readings, signal=readings.signal + settling[:, None])
    found = diagnose(spoilt, MODEL, STAND, np.array([-2.18, -2.14, -2.14]), Quick(None))
    (effect,) = found.effects
    assert effect.name == "voltmeter_warm_up"
    assert "warm_up" in effect.cannot_tell_from
    assert found.verdict == "confounded"


def test_what_nobody_judged_is_said():
    told = NOTHING_KNOWN.not_judged(paper_run(np.random.default_rng(1)))
    assert "range_offset, meters_exchanged, channel_crosstalk" in told or "channel_crosstalk" in told
    assert "--bench FILE" in told
    known = KnownBench(own_meters=True, fixed_ranges=True, scale_on_axis=False)
    assert known.not_judged(paper_run(np.random.default_rng(1))) == ""
