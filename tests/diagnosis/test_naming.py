"""Naming on readings of the tests' own geometry: what is hidden is found, what is not there is not."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import Threshold, ThresholdCache, diagnose
from bench.diagnosis.evidence import (
    FALSE_ALARMS,
    Search,
    fit_tail,
    make_threshold,
    null_responses,
    total_evidence,
)
from bench.diagnosis.naming import LEAK, Scored, held, tied
from bench.model import CATALOGUE, AppliedEffect
from tests.support.diagnosis_bench import MODEL, STAND, paper_run, set_up
from tests.support.paper_bench import ARCSEC

NULLS = 1200
"""Fewer than the application takes: the thresholds of a test need not be as sharp."""


class Ready(ThresholdCache):
    """The threshold of one design for all tests: it hardly depends on the readings."""

    def threshold(self, linear, whitened, setting_rad):
        key = (len(linear), tuple(linear.readings.direction.tolist()))
        if key not in KNOWN:
            KNOWN[key] = make_threshold(linear, whitened, NULLS)
        return KNOWN[key]


KNOWN: dict[tuple, Threshold] = {}


def examine(readings):
    return diagnose(readings, MODEL, STAND, np.array([-2.18, -2.14, -2.14]), Ready(None))


@pytest.mark.slow
def test_a_quadratic_term_is_named_added_and_closes_the_gap():
    found = examine(paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0)))
    assert found.verdict == "named"
    (effect,) = found.effects
    assert (effect.name, effect.channels) == ("quadratic_nonlinearity", ("y",))
    (k2,) = effect.parameters
    assert (k2.parameter, k2.channel) == ("K2", "y")
    assert abs(k2.value - 80) < 4 * k2.u
    assert effect.p_all_looks < 1e-6
    assert "cross_quadratic" in effect.plainer_than
    assert found.gap.before > 1.5 > found.gap.after
    assert found.gap.p_after > 0.01
    assert [fold.label for fold in found.gap.folds] == [
        "pass 1", "pass 2", "pass 3", "verification and free positions",
    ]  # fmt: skip


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is():
    found = examine(paper_run(np.random.default_rng(22)))
    assert found.verdict == "agrees"
    assert found.effects == ()
    assert found.gap.before == found.gap.after
    assert set(found.hidden) >= {"voltmeter_gain", "voltmeter_offset", "thermal_emf", "wrong_gravity"}


@pytest.mark.slow
def test_equal_quadratic_terms_are_never_named_alone():
    found = examine(paper_run(np.random.default_rng(23), K2=(60e-6, 60e-6, 60e-6)))
    assert found.verdict == "confounded"
    names = {found.effects[0].name, *found.effects[0].cannot_tell_from}
    assert {"quadratic_nonlinearity", "voltmeter_nonlinearity"} <= names


def test_a_find_that_is_not_needed_beside_the_others_goes():
    """Beside the square of y that is there, a drift of z that is not there falls below any threshold."""
    one = set_up(paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0)))
    data = one.whitened.reduce(one.linear.response[:, None])
    limit = Threshold(2.0, FALSE_ALARMS, 1.0, 0.05, 1.0, NULLS)
    scored = Scored.beside(one.whitened, data, ())
    square, drift = scored.found("quadratic_nonlinearity"), scored.found("bias_drift")
    assert held(one.whitened, data, [drift, square], limit) == [square]
    assert held(one.whitened, data, [square], limit) == [square]


def test_what_is_hardly_there_does_not_tie_with_everything():
    """In a null the best scale drift explains next to nothing; what it is alike is little more than its kin."""
    one = set_up(paper_run(np.random.default_rng(22)))
    data = one.whitened.reduce(one.linear.response[:, None])
    scored = Scored.beside(one.whitened, data, ())
    small = tied(scored, scored.found("scale_drift"))
    assert small.size < LEAK
    assert len(small.ties) + len(small.plainer_than) < len(scored.evidence) / 2


@pytest.mark.slow
def test_two_effects_are_both_found():
    found = examine(paper_run(np.random.default_rng(24), K2=(0, 120e-6, 0), drift_v_per_h=(0, 0, 150e-6)))
    sets = [{e.name, *e.cannot_tell_from} for e in found.effects]
    assert any("quadratic_nonlinearity" in names for names in sets)
    assert any("bias_drift" in names for names in sets)


@pytest.mark.slow
def test_backlash_is_seen_with_both_directions_only():
    """All rising it is one with an offset of zero; with one pass falling its 100 arcsec stand out."""
    both = examine(paper_run(np.random.default_rng(25), directions=(1, -1, 1), backlash_rad=100 * ARCSEC))
    assert both.effects[0].name == "backlash"
    assert both.detectable["backlash"] < 10
    rising = examine(paper_run(np.random.default_rng(25)))
    assert rising.detectable["backlash"] > 2 * both.detectable["backlash"]


@pytest.mark.slow
def test_a_mounting_roll_is_hidden_without_verification_points():
    found = examine(paper_run(np.random.default_rng(26), verification=False))
    assert "mounting_roll" in found.hidden
    found = examine(paper_run(np.random.default_rng(26)))
    assert "mounting_roll" not in found.hidden


@pytest.mark.slow
def test_the_threshold_keeps_false_alarms_rare():
    """1,500 fresh nulls at 0.3 %: 4.5 expected; 17 or more have a probability below 1e-5 (Poisson)."""
    one = set_up(paper_run(np.random.default_rng(27)))
    limit = make_threshold(one.linear, one.whitened, NULLS)
    rng = np.random.default_rng(28)
    responses = null_responses(one.linear, one.whitened.grid.sigma, np.full(1500, 2.3), rng)
    evidence = total_evidence(
        Search.beside(one.whitened, ()).score(one.whitened.reduce(responses)), one.whitened
    )
    assert np.count_nonzero(evidence > limit.value) < 17
    assert limit.p(limit.value) == pytest.approx(FALSE_ALARMS)
    assert limit.p(limit.start - 1) == 1.0


def test_the_tail_of_an_exponential_is_found():
    """20,000 numbers with decay 0.7 (seed 5): the tail's 1,000 give it within 4 standard errors, 0.7/sqrt(1000)."""
    evidence = np.random.default_rng(5).exponential(0.7, 20000)
    limit = fit_tail(evidence)
    assert abs(limit.decay - 0.7) < 4 * 0.7 / np.sqrt(1000)
    assert limit.value == pytest.approx(-0.7 * np.log(FALSE_ALARMS), rel=0.15)


@pytest.mark.slow
def test_a_cached_threshold_belongs_to_its_design(tmp_path, monkeypatch):
    """Times and temperatures are part of the design; the size of a signal's noise digits is not."""
    monkeypatch.setattr("bench.diagnosis.evidence.NULLS", 300)
    made = []
    monkeypatch.setattr(
        "bench.diagnosis.evidence.make_threshold",
        lambda linear, whitened: made.append(1) or make_threshold(linear, whitened, 300),
    )
    cache = ThresholdCache(tmp_path / "kept")
    readings = paper_run(np.random.default_rng(29))

    def ask(table):
        one = set_up(table)
        return cache.threshold(one.linear, one.whitened, STAND["setting_error"])

    first = ask(readings)
    assert ask(paper_run(np.random.default_rng(30))) == first
    assert len(made) == 1
    ask(replace(readings, time_s=1.5 * readings.time_s))
    ask(replace(readings, temperature_c=readings.temperature_c + 0.01 * np.arange(len(readings))))
    assert len(made) == 3
    broken = next((tmp_path / "kept").glob("*.json"))
    broken.write_text("not json")
    ask(readings)
    assert len(list((tmp_path / "kept").glob("*.json"))) == 3


@pytest.mark.slow
def test_what_was_settled_before_is_hashed():
    found = examine(paper_run(np.random.default_rng(22)))
    again = examine(paper_run(np.random.default_rng(31)))
    assert found.registered.sha256 == again.registered.sha256
    assert found.registered.held_out[0] == "pass 1"


def test_the_record_is_left_as_it_is():
    readings = paper_run(np.random.default_rng(32))
    before = readings.signal.copy()
    examine(readings)
    np.testing.assert_array_equal(readings.signal, before)


@pytest.mark.slow
def test_signals_that_are_not_volts_have_no_effects_in_microvolts():
    """The same run in units of 10 mV as "counts": the block's effect is named alike, the meters' are hidden."""
    readings = paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0))
    counts = replace(readings, unit="counts", signal=100.0 * readings.signal)
    found = diagnose(counts, MODEL, STAND, 100.0 * np.array([-2.18, -2.14, -2.14]), Ready(None))
    assert found.effects[0].name == "quadratic_nonlinearity"
    assert "voltmeter_drift" in found.hidden
    assert not any(v.family == "range_offset" for v in found.candidates.variants)


@pytest.mark.slow
def test_what_the_model_has_is_not_found_again_and_the_other_channels_are():
    readings = paper_run(np.random.default_rng(33), K2=(100e-6, 80e-6, 0.0))
    has_y = AppliedEffect(
        CATALOGUE["quadratic_nonlinearity"], {"K2": np.array([0.0, 80e-6, 0.0])}, channels=("y",)
    )
    model = replace(MODEL, effects=(has_y,))
    found = diagnose(readings, model, STAND, np.array([-2.18, -2.14, -2.14]), Ready(None))
    (effect,) = found.effects
    assert (effect.name, effect.channels) == ("quadratic_nonlinearity", ("x",))
    both = replace(has_y, values={"K2": np.array([100e-6, 80e-6, 0.0])}, channels=("x", "y"))
    assert diagnose(readings, replace(MODEL, effects=(both,)), STAND, None, Ready(None)).verdict == "agrees"
