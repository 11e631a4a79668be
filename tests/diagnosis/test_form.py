"""What has no name gets a form: terms of the dictionary, sizes, prediction, where it scatters, what stays dark.

The readings come from a geometry of the tests' own, and so do the forms that are hidden in them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.config.formulas import effects_as_written, written_formulas
from bench.diagnosis import Threshold
from bench.diagnosis.linear import make_linear
from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.noise_grid import RATIOS, Repeats, noise_of_repeats
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.residual_dictionary import make_dictionary
from bench.diagnosis.residual_model import SearchSettings, UnexplainedScatter, describe, unnamed_in_place
from bench.model import AppliedEffect, Stage
from bench.results.diagnosis_parts import form_part
from tests.support.diagnosis_bench import MODEL, NOISE_V, paper_run, set_up
from tests.support.paper_bench import SETTING_U_RAD, STAND_U, U0, K

LIMIT = Threshold(1.5, 0.006, 0.0, 0.05, 1.0, 2000)
"""About what 2,000 simulated runs of this procedure give."""


def with_added(readings, volts):
    """Readings with so much added to their signals, V (n, 3)."""
    return replace(readings, signal=readings.signal + volts)


def form_of(readings):
    linear = make_linear(readings, MODEL, STAND_U)
    about = SearchSettings(NOISE_V, SETTING_U_RAD, RATIOS[2:5], LIMIT)
    repeats = noise_of_repeats(linear, readings.resolution)
    return describe(linear, np.zeros((len(linear), 0)), repeats, about)


def in_channel(course, channel, scale=True):
    return course[:, None] * np.eye(3)[channel] * (K[channel, channel] if scale else 1.0)


@pytest.fixture(scope="module")
def run():
    return paper_run(np.random.default_rng(31))


@pytest.fixture(scope="module")
def terms(run):
    linear = make_linear(run, MODEL, STAND_U)
    dictionary = make_dictionary(linear, np.zeros((len(linear), 0)))
    return dictionary, linear


def test_every_term_is_a_formula_that_a_file_may_hold(terms):
    dictionary, _ = terms
    some = {(t.stage, t.adds_to, t.expressions, t.constants): t for t in dictionary.term_of.values()}
    assert len(some) > 400
    for number, term in enumerate(some.values()):
        for per_channel in {False, term.stage is Stage.BLOCK_OUTPUT}:
            effect = term.effect(f"unnamed_{number}", per_channel=per_channel)
            (read,) = effects_as_written(written_formulas([effect])) or (None,)
            assert read == effect, effect.expression


def test_its_columns_are_differences_of_the_forward_model(terms):
    dictionary, linear = terms
    rng = np.random.default_rng(1)
    for number in rng.choice(len(dictionary.candidates.variants), 20, replace=False):
        variant = dictionary.candidates.variants[number]
        kinds = [dictionary.candidates.kinds[c] for c in variant.columns]
        effect = dictionary.of(variant).effect("one", per_channel=kinds[0].channel is not None)
        values = {p.name: np.asarray(p.default) for p in effect.parameters if p.is_shape}
        for column, kind in zip(variant.columns, kinds, strict=True):
            size = dictionary.candidates.scale[column]
            one = np.asarray(size) if kind.channel is None else size * np.eye(3)[kind.channel]
            added = linear.effect_column(AppliedEffect(effect, {**values, kind.parameter: one}))
            # the stand and the head are made linear: what is beyond grows with the square of an angle
            turned = effect.stage in {Stage.STAND, Stage.HEAD_ANGLE}
            atol = 2e-4 * float(np.max(np.abs(added))) if turned else 1e-15
            np.testing.assert_allclose(dictionary.candidates.columns[:, column], added, rtol=1e-7, atol=atol)


@pytest.mark.slow
def test_nothing_gets_no_form(run):
    form = form_of(run)
    assert form.terms == ()
    assert form.applied == ()
    assert form.scatter is None
    assert not form.dark.there
    assert form_part(form).to_dict()["dark_uncertainty"] == 0.0
    assert 0.0 < form.dark.upper < NOISE_V


@pytest.mark.slow
def test_half_a_wave_is_described_and_predicts(run):
    form = form_of(with_added(run, in_channel(200e-6 * np.sin(run.angle_rad / 2), 1)))
    (term,) = form.terms
    assert term.family == "a wave, 0.5 per turn, in the bias"
    assert term.effect.stage is Stage.BLOCK_OUTPUT
    (_, channel, cosine, u_cosine, unit), (_, _, sine, u_sine, _) = term.sizes()
    assert (channel, unit) == ("y", "ug")
    assert abs(sine - 200) < 4 * u_sine < 60
    assert abs(cosine) < 4 * u_cosine
    assert form.closed > 0.8
    assert form.predicts
    assert form.applied[0].effect.name == "unnamed_1"
    assert form.after < 1.5 < form.before
    told = form_part(form).to_dict()
    assert told["terms"][0]["sizes"][1]["u"] == pytest.approx(u_sine)
    assert len(told["gap"]["held_out"]) == 4


@pytest.mark.slow
def test_a_burst_of_noise_is_a_variance_and_where(run):
    rows = (run.installation == "2") & (run.pass_number == 3)
    burst = np.where(rows, np.random.default_rng(8).normal(0, 400e-6, len(rows)), 0.0)
    form = form_of(with_added(run, in_channel(burst, 0, scale=False)))
    assert form.scatter is not None
    assert form.scatter.words in {"channel x, installation 2, pass 3", "channel x, installation 2"}
    assert 150e-6 < form.scatter.sd < 800e-6
    assert form.scatter.elsewhere < 100e-6
    # the repeats scatter by it as well: it is a variance, and nothing beyond theirs
    assert not form.dark.there


@pytest.mark.slow
def test_terms_in_the_model_keep_their_names(run):
    readings = with_added(run, in_channel(200e-6 * np.sin(run.angle_rad / 2), 1))
    (term,) = form_of(readings).terms
    linear = make_linear(readings, replace(MODEL, effects=(term.applied,)), STAND_U)
    again = describe(
        linear,
        np.zeros((len(linear), 0)),
        noise_of_repeats(linear, 0.0),
        SearchSettings(NOISE_V, SETTING_U_RAD, RATIOS[2:5], LIMIT),
    )
    assert all(one.effect.name != "unnamed_1" for one in again.terms)


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


# --- a name is none where something without a name explains the readings as well: in its place, or beside it ----


def suspects(volts_of, family, channels=None):
    """Which of the finds a form may replace; `volts_of` says by run and force (n, 3) what is hidden in the run."""
    run = paper_run(np.random.default_rng(17))
    force = np.linalg.solve(K, (run.signal - U0).T).T
    ready = set_up(replace(run, signal=run.signal + volts_of(run, force)))
    variant = next(
        v
        for v in ready.candidates.variants
        if v.family == family and (channels is None or v.channels == channels)
    )
    naming = Naming((FoundEffect(variant, 0.0, 0.0, 0.0),), -1.0)
    data = ready.whitened.reduce(ready.linear.response[:, None])
    return unnamed_in_place(ready.linear, ready.whitened, data, naming, (), SETTING_U_RAD)


def in_z(course):
    return course[:, None] * np.array([0.0, 0.0, K[2, 2]])


@pytest.mark.slow
def test_a_square_is_a_square():
    assert suspects(lambda _, a: in_z(60e-6 * a[:, 2] ** 2), "quadratic_nonlinearity", (2,)) == ()


@pytest.mark.slow
def test_a_fourth_power_is_none():
    assert suspects(lambda _, a: in_z(150e-6 * a[:, 2] ** 4), "quadratic_nonlinearity", (2,)) == (0,)


@pytest.mark.slow
def test_what_is_left_beside_a_name_speaks_against_it():
    def hidden(run, a):
        return in_z(60e-6 * a[:, 2] ** 2 + 60e-6 * np.sin(run.angle_rad / 2))

    assert suspects(hidden, "quadratic_nonlinearity", (2,)) == (0,)
