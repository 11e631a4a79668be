"""Naming on readings of the tests' own geometry: what is hidden is found, what is not there is not."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from bench.base.arrays import ARCSEC
from bench.diagnosis import Threshold, ThresholdCache, diagnose
from bench.diagnosis.candidates import make_candidates, spells, with_terms
from bench.diagnosis.evidence import (
    FALSE_ALARMS,
    Search,
    Whitened,
    fit_tail,
    make_threshold,
    null_responses,
    total_evidence,
)
from bench.diagnosis.linear import make_linear
from bench.diagnosis.naming import ALIAS, Scored, in_place, named_again, needed
from bench.diagnosis.noise_kinds import BENCH_FILE, OWN_SCATTER, NoiseFinding, noise_findings
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.result import UNNAMED_FORM
from bench.model import CATALOGUE, AppliedEffect
from bench.readings.table import FREE, SHORTED
from bench.validation.paper_bench import STAND_U, U0, K
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

NULLS = 400
"""Fewer than the application takes: the threshold of a test need not be as sharp."""


def examine(readings):
    return diagnose(readings, MODEL, STAND, np.array([-2.18, -2.14, -2.14]), OneThreshold())


@pytest.fixture(scope="module")
def quadratic():
    return examine(paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0)))


@pytest.fixture(scope="module")
def nothing():
    """Readings in which nothing is hidden, as they were before the search, and what is said of them."""
    readings = paper_run(np.random.default_rng(22))
    before = readings.signal.copy()
    return readings, before, examine(readings)


@pytest.mark.slow
def test_a_quadratic_term_is_named_added_and_closes_the_gap(quadratic):
    found = quadratic
    assert found.verdict == "named"
    (effect,) = found.effects
    assert (effect.name, effect.channels) == ("quadratic_nonlinearity", ("y",))
    (k2,) = effect.parameters
    assert (k2.parameter, k2.channel) == ("K2", "y")
    assert abs(k2.value - 80) < 4 * k2.u
    assert effect.p_all_looks < 1e-6
    assert "cross_quadratic" in {*effect.plainer_than, *(one.name for one in effect.odds)}
    assert effect.odds[0].name == effect.name
    assert 0.95 < effect.odds[0].probability <= sum(one.probability for one in effect.odds) <= 1.0 + 1e-9
    assert found.gap.before > 1.5 > found.gap.after
    assert found.gap.p_after > 0.01
    assert [fold.label for fold in found.gap.folds] == [
        "pass 1", "pass 2", "pass 3", "verification and free positions",
    ]  # fmt: skip


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is(nothing):
    readings, before, found = nothing
    np.testing.assert_array_equal(readings.signal, before)  # the record is left as it is
    assert found.verdict == "agrees"
    assert found.effects == ()
    assert found.form is None
    assert found.gap.before == found.gap.after
    assert set(found.hidden) >= {"voltmeter_gain", "voltmeter_offset", "thermal_emf", "wrong_gravity"}


@pytest.mark.slow
def test_equal_quadratic_terms_are_never_named_alone():
    found = examine(paper_run(np.random.default_rng(23), K2=(60e-6, 60e-6, 60e-6)))
    assert found.verdict == "confounded"
    names = {found.effects[0].name, *found.effects[0].cannot_tell_from}
    assert {"quadratic_nonlinearity", "voltmeter_nonlinearity"} <= names


@pytest.mark.slow
def test_of_aliases_of_any_size_the_true_one_is_in_the_set():
    """With settings every 45° and no other ones, odd functions of one component differ by a factor only."""
    readings = paper_run(np.random.default_rng(24), verification=False)
    force = (readings.signal - U0) @ np.linalg.inv(K).T
    added = 1.3e-3 * force * np.abs(force) * np.diag(K)
    effect = examine(replace(readings, signal=readings.signal + added)).effects[0]
    odds = {one.name: one.probability for one in effect.odds}
    assert effect.rho > 100
    assert odds.keys() >= {"odd_quadratic_nonlinearity", "cubic_nonlinearity", "bias_asymmetry"}
    assert odds["odd_quadratic_nonlinearity"] > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("k2", "most"), [(0.39e-3, 0.6), (0.9e-3, 0.1)])
def test_the_same_size_in_all_accelerometers_is_no_evidence_for_the_voltmeters(k2, most):
    """Of 0.39 mg/g^2 in each accelerometer, a voltmeter would have 117 plausible sizes of its nonlinearity."""
    readings = paper_run(np.random.default_rng(24), noise_v=1e-4)
    force = (readings.signal - U0) @ np.linalg.inv(K).T
    (effect,) = examine(replace(readings, signal=readings.signal + k2 * force**2 * np.diag(K))).effects
    assert (effect.name, effect.channels) == ("quadratic_nonlinearity", ("x", "y", "z"))
    assert [one.value for one in effect.parameters] == pytest.approx([k2 * 1e6] * 3, rel=0.2)
    assert sum(one.probability for one in effect.odds if one.name == "voltmeter_nonlinearity") < most


@pytest.mark.slow
def test_the_same_size_in_all_accelerometers_is_no_evidence_for_a_form():
    readings = paper_run(np.random.default_rng(24), noise_v=1e-4)
    force = (readings.signal - U0) @ np.linalg.inv(K).T
    effect = examine(replace(readings, signal=readings.signal + 1.3e-3 * force**3 * np.diag(K))).effects[0]
    assert effect.rho > 40
    assert effect.name == "cubic_nonlinearity"
    assert sum(one.probability for one in effect.odds if one.name == UNNAMED_FORM) < 0.1


@pytest.mark.slow
def test_the_same_step_of_all_biases_is_confirmed_where_its_place_is_held_out():
    """Without the pass after the step, a step in time common to all channels could be anywhere in a gap."""
    readings = paper_run(np.random.default_rng(31), noise_v=2e-4)
    step = 400e-6 * np.outer(readings.installation != "1", np.diag(K))
    found = examine(replace(readings, signal=readings.signal + step))
    assert (found.verdict, found.effects[0].name) == ("named", "turn_on_shift")
    assert found.gap.shrinks
    assert [fold.label for fold in found.gap.folds] == [
        "pass 1",
        "pass 2",
        "pass 3",
        "verification and free positions",
    ]
    assert all("turn_on_shift" in fold.gains for fold in found.gap.folds)


def test_a_find_that_is_not_needed_beside_the_others_goes():
    """Beside the square of y that is there, a drift of z that is not there falls below any threshold."""
    one = set_up(paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0)))
    data = one.whitened.reduce(one.linear.response[:, None])
    limit = Threshold(2.0, FALSE_ALARMS, 1.0, 0.05, 1.0, NULLS)
    scored = Scored.beside(one.whitened, data, ())
    square, drift = scored.found("quadratic_nonlinearity"), scored.found("bias_drift")
    assert needed(one.whitened, data, [drift, square], limit) == [square]
    assert needed(one.whitened, data, [square], limit) == [square]


def test_a_find_that_another_effect_explains_better_gets_its_name():
    """Beside the drift of z, the square of y was called a cube: the largest odds decide again."""
    one = set_up(paper_run(np.random.default_rng(21), K2=(0.0, 80e-6, 0.0)))
    data = one.whitened.reduce(one.linear.response[:, None])
    scored = Scored.beside(one.whitened, data, ())
    finds = [scored.found("cubic_nonlinearity"), scored.found("bias_drift")]
    limit = Threshold(2.0, FALSE_ALARMS, 1.0, 0.05, 1.0, NULLS)
    again = named_again(one.whitened, data, limit, finds)
    assert again.found[0].variant.family == "quadratic_nonlinearity"
    for found in again.found:
        likeliest = max((odds for odds in found.odds), key=lambda odds: odds.probability)
        assert likeliest.name == found.variant.family


def test_what_is_hardly_there_does_not_tie_with_everything():
    """In a null the best scale drift explains next to nothing; what it is alike is little more than its kin."""
    one = set_up(paper_run(np.random.default_rng(22)))
    data = one.whitened.reduce(one.linear.response[:, None])
    scored = Scored.beside(one.whitened, data, ())
    small = in_place(scored, scored.found("scale_drift"))
    assert small.size < 2 * ALIAS
    # none is probable, so that the set is long; aliases are not looked for
    assert small.plainer_than == ()
    assert sum(odds.probability for odds in small.odds) == pytest.approx(1.0, abs=0.03)


def test_a_form_that_the_likeliest_effect_reproduces_is_no_other_explanation():
    """A wave of the foundation, of a period between two that are tried (seed 28): in three hours, a slow wave."""
    one = set_up(paper_run(np.random.default_rng(28)))
    candidates = with_terms(one.candidates, one.linear)
    wave = {"cosine": 0.0, "sine": 0.0, "across_cosine": 15 * ARCSEC, "across_sine": 0.0, "period": 24300.0}
    added = one.linear.effect_columns(AppliedEffect(CATALOGUE["foundation_tilt"], wave)).sum(axis=1)
    whitened = Whitened.of(one.grid, candidates)
    scored = Scored.beside(whitened, whitened.reduce((one.linear.response + added)[:, None]), ())
    before = scored.scores.families(candidates)[:, 0] + candidates.log_prior - scored.total
    tilt, form = "foundation_tilt", "a slow wave in time, in a tilt of the axis"
    assert math.exp(before[candidates.families.index(tilt)]) < 0.5
    assert math.exp(before[candidates.families.index(form)]) > 0.5
    after = {family: math.exp(log - scored.total) for family, log in scored.log_odds.items()}
    assert after[tilt] > 0.95
    assert sum(after.values()) == pytest.approx(1.0)
    effect = scored.likeliest(tilt).plain.columns
    assert scored.unexplained(scored.likeliest(form), effect) < ALIAS
    # if no names are permitted, the form is not left to the name
    alone = in_place(scored, scored.best(is_nameless), is_nameless)
    assert (alone.variant.family, alone.odds[0].name) == (form, form)


def is_nameless(family):
    return family not in CATALOGUE


@pytest.mark.slow
def test_two_effects_are_both_found():
    found = examine(paper_run(np.random.default_rng(24), K2=(0, 120e-6, 0), drift_v_per_h=(0, 0, 150e-6)))
    sets = [{e.name, *e.cannot_tell_from} for e in found.effects]
    assert any("quadratic_nonlinearity" in names for names in sets)
    assert any("bias_drift" in names for names in sets)


@pytest.mark.slow
def test_backlash_is_seen_with_both_directions_only(nothing):
    """All rising it is one with an offset of zero; with one pass falling its 100 arcsec stand out."""
    both = examine(paper_run(np.random.default_rng(25), directions=(1, -1, 1), backlash_rad=100 * ARCSEC))
    assert both.effects[0].name == "backlash"
    assert both.detectable["backlash"] < 10
    rising = nothing[2]
    assert rising.detectable["backlash"] > 2 * both.detectable["backlash"]


@pytest.mark.slow
def test_a_mounting_roll_is_hidden_without_verification_points(nothing):
    found = examine(paper_run(np.random.default_rng(26), verification=False))
    assert "mounting_roll" in found.hidden
    assert "mounting_roll" not in nothing[2].hidden


@pytest.mark.slow
def test_the_threshold_keeps_false_alarms_rare():
    """1,000 fresh nulls at 0.6 %: 6 expected, u of the threshold aside; 21 or more come once in 1e6 (Poisson)."""
    one = set_up(paper_run(np.random.default_rng(27)))
    limit = make_threshold(one.linear, one.whitened, NULLS)
    rng = np.random.default_rng(28)
    responses = null_responses(one.linear, one.whitened.grid.sigma, np.full(1000, 2.3), rng)
    evidence = total_evidence(
        Search.beside(one.whitened, ()).score(one.whitened.reduce(responses)), one.whitened
    )
    assert np.count_nonzero(evidence > limit.value) < 21
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
    monkeypatch.setattr("bench.diagnosis.evidence.NULLS", 100)
    made = []
    monkeypatch.setattr(
        "bench.diagnosis.evidence.make_threshold",
        lambda linear, whitened: made.append(1) or make_threshold(linear, whitened, 100),
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
def test_what_was_settled_before_is_hashed(nothing, quadratic):
    assert nothing[2].registered.sha256 == quadratic.registered.sha256
    assert quadratic.registered.held_out[0] == "pass 1"


@pytest.mark.slow
def test_what_the_model_has_is_not_found_again_and_the_other_channels_are():
    readings = paper_run(np.random.default_rng(33), K2=(100e-6, 80e-6, 0.0))
    has_y = AppliedEffect(
        CATALOGUE["quadratic_nonlinearity"], {"K2": np.array([0.0, 80e-6, 0.0])}, channels=("y",)
    )
    model = replace(MODEL, effects=(has_y,))
    found = diagnose(readings, model, STAND, np.array([-2.18, -2.14, -2.14]), OneThreshold())
    (effect,) = found.effects
    assert (effect.name, effect.channels) == ("quadratic_nonlinearity", ("x",))


# --- slips, zeros set anew, exchanged meters; noise that is too large -------------------------


SEED = 61


def turned(readings, rows, axis, angle_rad):
    """Readings of a block that stands turned about an axis of the platform in some rows: exact, by Rodrigues.

    In installation 1 the axes of block and platform are the same.
    """
    bias = np.linalg.lstsq(
        np.column_stack([np.sin(readings.angle_rad), np.cos(readings.angle_rad), np.ones(len(readings))])[
            rows
        ],
        readings.signal[rows],
        rcond=None,
    )[0][2]
    force = np.linalg.solve(K, (readings.signal - bias).T).T
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross
    return replace(readings, signal=np.where(rows[:, None], force @ turn.T @ K.T + bias, readings.signal))


def in_pass(readings, mount, *numbers):
    return (readings.installation == mount) & np.isin(readings.pass_number, numbers)


@pytest.mark.slow
def test_a_slip_is_in_the_set_and_the_noise_stays_what_it_is():
    """From pass 2 on, by a degree, where second order is ten times the noise.

    A whole degree about the axis of the head would be pass 1 with its angles read wrong by a mark.
    """
    readings = paper_run(np.random.default_rng(SEED))
    slipped = turned(readings, in_pass(readings, "1", 2, 3), (0, 0, 1), np.radians(1.0))
    found = diagnose(slipped, MODEL, STAND, np.diag(K), OneThreshold())
    assert found.verdict in {"named", "confounded"}
    (effect,) = found.effects
    assert "block_slip" in {effect.name, *effect.cannot_tell_from}
    assert found.noise.reading < 1.5 * NOISE_V
    assert not found.findings


@pytest.mark.slow
def test_a_slip_within_a_pass_is_one_of_the_pass_beside_the_readings_before_it():
    """In pass 2 from its third point on."""
    readings = paper_run(np.random.default_rng(SEED))
    rows = in_pass(readings, "1", 2) & (readings.point > 2)
    slipped = turned(readings, rows, (0.6, 0.0, 0.8), np.radians(0.3))
    n = len(readings)
    sampled = replace(slipped, samples=np.full(n, 10), signal_sd=np.full((n, 3), NOISE_V * np.sqrt(10)))
    found = diagnose(sampled, MODEL, STAND, np.diag(K), OneThreshold())
    assert found.verdict == "mistake"
    assert {(one.name, one.installations, one.pass_number, one.point) for one in found.mistakes.mistakes} == {
        ("outlier", ("1",), 2, 1), ("outlier", ("1",), 2, 2),
    }  # fmt: skip
    assert [effect.name for effect in found.effects] == ["block_slip"]


def test_spells_are_named_once():
    """Two installations of three passes and the verification points: neither is mounted twice."""
    readings = paper_run(None)
    passes = [
        [(f"{i} pass 2", f"{i} pass 3"), (f"{i} pass 3",), (f"{i} pass 1",), (f"{i} pass 2",)] for i in "12"
    ]
    assert list(spells(readings, lasting=False)) == [*passes[0], *passes[1]]
    own = [*passes[0], ("1",), *passes[1], ("2",)]
    more = list(spells(readings, lasting=True))
    assert more[: len(own)] == own
    assert more[len(own) :] == [
        ("1 pass 2", "1 pass 3", "2", "V"), ("1 pass 3", "2", "V"), ("2", "V"),
        ("2 pass 2", "2 pass 3", "V"), ("2 pass 3", "V"), ("V",),
    ]  # fmt: skip


def gain_spells(readings):
    """The passes and mountings in which the gain of a channel may have made a step."""
    linear = make_linear(readings, MODEL, STAND_U)
    candidates = make_candidates(linear, NOISE_V)
    return {one.mounts for one in candidates.variants if one.family == "scale_step"}


@pytest.mark.parametrize("first", ["1", SHORTED])
def test_a_step_of_the_gain_is_one_of_the_later_readings(first):
    """The coefficients absorb whether it is before or after, also if a shorted input is read at first."""
    run = paper_run(None)
    run = replace(run, installation=np.where(np.arange(len(run)) == 0, first, run.installation))
    found = gain_spells(run)
    assert {("2", "V"), ("1 pass 2", "1 pass 3", "2", "V")} <= found
    assert not {("1",), ("1 pass 1",)} & found


def test_a_step_before_free_positions_is_one_of_the_first_mounting():
    """No set of later passes holds the free positions, which the step changes, too."""
    run = paper_run(None)
    assert ("1",) in gain_spells(
        replace(run, installation=np.where(run.installation == "V", FREE, run.installation))
    )


def test_a_second_visit_is_a_spell_of_its_own():
    readings = paper_run(None, verification=False)
    again = np.where(in_pass(readings, "1", 3), 2, 1)
    labels = list(spells(replace(readings, series=again), lasting=False))
    assert {("1",), ("1/2",), ("1 pass 2",)} <= set(labels)
    assert ("2",) not in labels


def return_run(rng, slip_arcsec):
    """The paper's run with a pass of installation 1 mounted anew, in which the block sits turned."""
    readings = paper_run(rng)
    again = in_pass(readings, "1", 3)
    slipped = turned(readings, again, (1, 0, 0), slip_arcsec * ARCSEC)
    return replace(slipped, series=np.where(again, 2, 1))


@pytest.mark.slow
def test_a_slip_of_a_visit_is_a_mounting_angle_of_it_and_that_is_said():
    found = diagnose(return_run(np.random.default_rng(SEED), 60), MODEL, STAND, np.diag(K), OneThreshold())
    assert found.verdict == "confounded"
    (effect,) = found.effects
    alike = {"block_slip", "mounting_roll"}
    assert alike <= {effect.name, *effect.cannot_tell_from}
    (told,) = (note for note in found.notes if "the same signature" in note)
    assert alike <= set(told.replace(",", "").split())


@pytest.mark.slow
def test_a_roll_of_the_block_is_named_alone_where_verification_points_show_it():
    """In installations that are mounted once nothing says that the block slipped: it sits rolled."""
    readings = paper_run(np.random.default_rng(SEED))
    rolled = turned(readings, readings.installation == "1", (1, 0, 0), 90 * ARCSEC)
    found = diagnose(rolled, MODEL, STAND, np.diag(K), OneThreshold())
    (effect,) = found.effects
    assert "block_slip" not in {effect.name, *effect.cannot_tell_from}
    assert "mounting_roll" in {effect.name, *effect.cannot_tell_from}


# --- noise that is larger than stated ---------------------------------------------------------------


def sampled(sd_v):
    readings = paper_run(None)
    n = len(readings)
    return replace(readings, samples=np.full(n, 10), signal_sd=np.full((n, 3), sd_v))


def findings(reading_v, setting_arcsec, readings, **stated):
    noise = NoiseSize(reading_v, setting_arcsec * ARCSEC, 150)
    return noise_findings(noise, readings, stated, 2.2)


def test_the_larger_of_the_readings_own_scatter_and_the_bench_file_counts():
    """45 uV over 10 samples are 14 uV, rounding to 0.1 uV adds nothing."""
    assert findings(150e-6, 0.0, sampled(45e-6), voltmeter_error=100e-6) == ()
    (stated,) = findings(949e-6, 0.0, sampled(45e-6), voltmeter_error=100e-6)
    assert (stated.source, stated.stated) == (BENCH_FILE, 100e-6)
    (found,) = findings(40e-6, 0.0, sampled(45e-6), voltmeter_error=10e-6)
    assert (found.what, found.source) == ("reading", OWN_SCATTER)
    assert found.stated == pytest.approx(45e-6 / np.sqrt(10), rel=1e-3)
    assert found.factor == pytest.approx(40e-6 / found.stated)
    assert found.p < 1e-9
    assert "readings' own scatter" in found.words


@pytest.mark.parametrize("reading_v", [1e-6, 14e-6, 28e-6])
def test_noise_that_is_smaller_or_less_than_twice_as_large_is_none(reading_v):
    assert findings(reading_v, 3.3, sampled(45e-6), setting_error=3.3 * ARCSEC) == ()


def test_without_samples_the_bench_file_counts():
    (found,) = findings(949e-6, 0.0, paper_run(None), voltmeter_error=100e-6)
    assert (found.source, found.stated) == (BENCH_FILE, 100e-6)
    assert findings(949e-6, 0.0, replace(paper_run(None), unit="counts"), voltmeter_error=100e-6) == ()


def test_a_setting_error_is_a_finding_where_it_shows():
    """20 arcsec for 3 show 210 uV beside 15 uV; beside 1 mV of noise they do not."""
    (found,) = findings(15e-6, 20.0, paper_run(None), setting_error=3 * ARCSEC)
    assert found.what == "setting"
    assert found.unit == "arcsec"
    assert findings(1e-3, 20.0, paper_run(None), setting_error=3 * ARCSEC) == ()


def test_slow_noise_counts_as_noise_of_a_reading():
    """Ten components of 10 uV in z are 32 uV beside 15 uV; one of them alone is 18 uV."""
    readings, stated = paper_run(None), {"voltmeter_error": 15e-6}
    noise, slow = NoiseSize(15e-6, 0.0, 150), np.zeros((len(readings), 3, 10))
    slow[:, 2, :1] = 10e-6
    assert noise_findings(noise, readings, stated, 2.2, slow=slow) == ()
    slow[:, 2] = 10e-6
    (found,) = noise_findings(noise, readings, stated, 2.2, slow=slow)
    assert (found.what, found.source) == ("slow", BENCH_FILE)
    assert found.found == pytest.approx(np.hypot(15e-6, np.sqrt(10) * 10e-6))
    assert found.p == pytest.approx(chi2.sf(10 * found.factor**2, 10), rel=1e-6)
    quiet = np.array([1.5, 0.6, 0.6])  # z is less noisy than x
    (found,) = noise_findings(noise, readings, stated, 2.2, slow=slow, by_channel=quiet)
    assert found.found == pytest.approx(np.hypot(9e-6, np.sqrt(10) * 10e-6))
    loud = noise_findings(NoiseSize(60e-6, 0.0, 150), readings, stated, 2.2, slow=slow)
    assert [one.what for one in loud] == ["reading"]


def test_slow_noise_is_named_in_words():
    found = NoiseFinding("slow", 35e-6, 15e-6, "V", 35 / 15, 1e-8, BENCH_FILE)
    assert "slow noise included, is 35 µV, 2.3 times the 15 µV" in found.words
