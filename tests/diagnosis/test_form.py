"""What has no name gets a form: terms of the dictionary, sizes, prediction, where it scatters, what stays dark.

The readings come from a geometry of the tests' own, and so do the forms that are hidden in them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.config.formulas import effects_as_written, written_formulas
from bench.diagnosis import diagnose
from bench.diagnosis.candidates import make_candidates, with_terms, without_copies
from bench.diagnosis.evidence import Whitened
from bench.diagnosis.linear import make_linear
from bench.diagnosis.naming import Scored
from bench.diagnosis.noise_grid import Repeats, make_whitener
from bench.diagnosis.noise_kinds import larger_scatter
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.residual_dictionary import FORCES, dictionary
from bench.diagnosis.result import UNNAMED_FORM, UnexplainedScatter
from bench.model import Stage
from bench.model.effects.formula import ValueReading, interpret
from bench.results.diagnosis_parts import form_part
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, K
from tests.support.diagnosis_bench import (
    MODEL,
    NOISE_V,
    STAND,
    OneThreshold,
    columns_by_model,
    paper_run,
    set_up,
)


def with_added(readings, volts):
    """Readings with so much added to their signals, V (n, 3)."""
    return replace(readings, signal=readings.signal + volts)


LAGGING = "the temperature, at once or with a lag"


def form_of(readings, model=MODEL):
    return diagnose(readings, model, STAND, np.diag(K), OneThreshold()).form


def in_channel(course, channel, scale=True):
    return course[:, None] * np.eye(3)[channel] * (K[channel, channel] if scale else 1.0)


@pytest.fixture(scope="module")
def run():
    return paper_run(np.random.default_rng(31))


@pytest.fixture(scope="module")
def terms(run):
    linear = make_linear(run, MODEL, STAND_U)
    return list(dictionary(linear)), linear


def test_every_term_is_a_formula_that_a_file_may_hold(terms):
    some = {(t.stage, t.adds_to, t.expressions, t.constants): t for t, _, _ in terms[0]}
    assert len(some) > 400
    for number, term in enumerate(some.values()):
        for per_channel in {False, term.stage is Stage.BLOCK_OUTPUT}:
            effect = term.effect(f"unnamed_{number}", per_channel=per_channel)
            (read,) = effects_as_written(written_formulas([effect])) or (None,)
            assert read == effect, effect.expression


def test_a_form_of_the_force_is_zero_at_no_force():
    """So the bias that a model with the form gives is the signal at no force, and not half a step beside it."""
    nothing = ValueReading(dict.fromkeys(("a", "aj", "ak"), np.zeros(1)), lambda of, _: of)
    for text in (text for texts in FORCES.values() for text in texts):
        assert interpret(text, nothing) == 0.0, text


@pytest.mark.parametrize(("place", "at"), [("bias", 0.0), ("scale factor", 1.0)])
def test_a_creep_of_a_bias_is_zero_at_the_start_and_that_of_a_scale_factor_at_the_end(terms, place, at):
    """A scale factor settles: if its creep were zero at the start, K would hold for a cold bench."""
    creeps = {t for t, _, _ in terms[0] if t.family == f"what creeps with time, in the {place}"}
    assert len(creeps) == 3
    end_s = float(np.ptp(terms[1].conditions.elapsed_s))
    for term in creeps:
        known = {p.name: np.asarray(p.default) for p in term.constants}
        for time_s in (0.0, end_s):
            names = known | {"a": np.ones(1), "time": np.full(1, time_s)}
            (value,) = interpret(term.expressions[0], ValueReading(names, lambda of, _: of))
            assert (abs(value) < 1e-3) == (time_s == at * end_s)


def test_its_columns_are_differences_of_the_forward_model(terms):
    listed, linear = terms
    for number in np.random.default_rng(1).choice(len(listed), 20, replace=False):
        # the stand and the head are made linear: what is beyond grows with the square of an angle
        turned = listed[number][0].stage in {Stage.STAND, Stage.HEAD_ANGLE}
        for column, added in columns_by_model(listed[number], linear):
            atol = 2e-4 * float(np.max(np.abs(added))) if turned else 1e-15
            np.testing.assert_allclose(column, added, rtol=1e-7, atol=atol)


@pytest.mark.slow
def test_the_gain_of_one_pass_is_no_exchange_of_meters(run):
    """What one channel reads, its zero included, grows by 1e-4 in a pass."""
    chosen = (run.installation == "1") & (run.pass_number == 3)
    one = set_up(with_added(run, 1e-4 * run.signal * np.outer(chosen, [0, 0, 1])))
    whitened = Whitened.of(one.grid, with_terms(one.candidates, one.linear))
    scored = Scored.beside(whitened, whitened.reduce(one.linear.response[:, None]), ())
    best = scored.best().variant
    assert (best.family, best.channels) == ("one pass of one mounting, in the gain of the voltmeter", (2,))
    assert scored.log_odds[best.family] > scored.log_odds["meters_exchanged"] + 3.0


@pytest.mark.slow
def test_an_effect_of_the_catalogue_that_is_written_as_a_form_is_no_rival_of_it(terms):
    """The square of y is `quadratic_nonlinearity`, whatever it is called; a fourth power is no such thing.

    A warm-up and a bias that lags behind the temperature are the effects of that name with any constant.
    """
    _, linear = terms
    whole = with_terms(make_candidates(linear, NOISE_V), linear)
    left = without_copies(whole, make_whitener(linear, NOISE_V, SETTING_U_RAD))
    told = [{v.term.expressions for v in of.variants if v.term is not None} for of in (whole, left)]
    assert {("a**2",), ("a**4",)} <= told[0]
    assert ("a**2",) not in told[1]
    assert ("a**4",) in told[1]
    families = {v.family for v in left.variants if v.term is not None and len(v.channels) == 1}
    assert "what creeps with time, in the bias" in families
    assert not families & {f"{what}, in the bias" for what in ("what fades with time", LAGGING)}
    assert [v for v in left.variants if v.named] == [v for v in whole.variants if v.named]


@pytest.mark.slow
def test_a_creep_by_the_logarithm_of_the_time_is_no_warm_up(run):
    """800 ug for each factor e of the time, beside an exponential that leaves some 6 units of noise of it."""
    found = diagnose(
        with_added(run, in_channel(800e-6 * np.log1p(run.time_s / 120.0), 1)),
        MODEL,
        STAND,
        np.diag(K),
        OneThreshold(),
    )
    assert found.effects[0].name == UNNAMED_FORM
    assert found.form.terms[0].family == "what creeps with time, in the bias"


@pytest.fixture(scope="module")
def wave(run):
    """Readings with half a wave in the bias of y, and the form that describes it."""
    readings = with_added(run, in_channel(200e-6 * np.sin(run.angle_rad / 2), 1))
    return readings, form_of(readings)


@pytest.mark.slow
def test_half_a_wave_is_described_and_predicts(wave):
    _, form = wave
    (term,) = form.terms
    assert term.family == "a wave, 0.5 per turn, in the bias"
    assert term.effect.stage is Stage.BLOCK_OUTPUT
    cosine, sine = values_of((term.applied,))
    assert (sine.channel, sine.unit) == ("y", "ug")
    assert abs(sine.value - 200) < 4 * sine.u < 60
    assert abs(cosine.value) < 4 * cosine.u
    assert form.gap.closed > 0.8
    assert form.predicts
    assert form.applied[0].effect.name == "unnamed_1"
    assert form.gap.after < 1.5 < form.gap.before
    told = form_part(form).to_dict()
    assert told["terms"][0]["sizes"][1]["u"] == pytest.approx(sine.u)
    assert len(told["gap"]["held_out"]) == 4


def test_a_burst_of_noise_is_told_where_it_is(run):
    """400 uV in one pass of one channel, beside 15 uV: no other place scatters as much."""
    linear = make_linear(run, MODEL, STAND_U)
    here = (run.installation == "2") & (run.pass_number == 3)
    rows = here[linear.rows.reading] & (linear.rows.channel == 0) & (linear.setting >= 0)
    left = np.random.default_rng(8).normal(0.0, np.where(rows, 400e-6, NOISE_V))
    found = larger_scatter(linear, left)
    assert found.words == "channel x, installation 2, pass 3"
    assert found.sd == pytest.approx(400e-6, rel=0.6)
    assert found.elsewhere == pytest.approx(NOISE_V, rel=0.2)
    assert larger_scatter(linear, np.random.default_rng(9).normal(0.0, NOISE_V, len(linear))) is None


@pytest.mark.slow
def test_terms_in_the_model_keep_their_names(wave):
    readings, form = wave
    (term,) = form.terms
    assert form_of(readings, replace(MODEL, effects=(term.applied,))) is None


def test_what_stays_dark_has_its_own_u_and_a_limit():
    repeats = Repeats(10e-6, 36)
    there = UnexplainedScatter.of(NoiseSize(15e-6, 16e-6, 150), repeats)
    assert there.there
    assert there.value == pytest.approx(np.sqrt(15**2 - 10**2) * 1e-6)
    assert 0.5e-6 < there.u < 3e-6
    assert there.value + there.u < there.upper < there.value + 4 * there.u
    chance = UnexplainedScatter.of(NoiseSize(10.2e-6, 16e-6, 150), repeats)
    assert not chance.there
    assert 2e-6 < chance.upper < 10e-6
    # smaller than the repeats by chance: no smaller limit for it
    assert UnexplainedScatter.of(NoiseSize(9e-6, 16e-6, 150), repeats).upper > 2e-6
    assert UnexplainedScatter.of(NoiseSize(9e-6, 16e-6, 70), repeats).upper == np.inf


def test_u_of_what_stays_dark_is_the_scatter_of_independent_mean_squares():
    """10 degrees of freedom of repeats of 10, 60 of others of 15 (20,000 draws, seed 5): to 2 %."""
    rng = np.random.default_rng(5)
    drawn = [size**2 * rng.chisquare(freedom, 20_000) for size, freedom in ((10.0, 10), (15.0, 60))]
    excess = sum(drawn) / 70 - drawn[0] / 10
    found = UnexplainedScatter.of(
        NoiseSize(((10 * 10**2 + 60 * 15**2) / 70) ** 0.5, 0.0, 70), Repeats(10.0, 5)
    )
    assert 2 * found.value * found.u == pytest.approx(np.std(excess), rel=0.02)


def test_little_scatter_about_the_model_has_a_finite_u():
    """Cut-down readings: eleven degrees of freedom, ten of repeats, whose scatter is by chance the larger."""
    found = UnexplainedScatter.of(NoiseSize(0.9, 0.0, 11), Repeats(1.0, 5))
    assert found.value == 0.0
    assert 0.0 < found.u < 1.0
