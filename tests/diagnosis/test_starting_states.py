"""The unknown state at the start of a mounting: names, calibrated u, and what a model file keeps of it."""

from dataclasses import replace

import numpy as np
import pytest

from bench.base.arrays import MINUTE
from bench.calibration.design import make_problem
from bench.config.model_file import load_model, write_model_file
from bench.diagnosis import diagnose
from bench.diagnosis.evidence import null_responses
from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.posterior import NoiseSize, fit_found, starting_states
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.model.effects.block import state
from bench.validation.paper_bench import K
from benchmarks.blind_trial.cases import Row, make_case
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

LAG_S = 20 * MINUTE
NOISE = NoiseSize(NOISE_V, STAND["setting_error"], 120)


@pytest.fixture(scope="module")
def ready():
    return set_up(paper_run(None))


def variant_of(ready, family, shape, channels=(1,)):
    (one,) = (
        v
        for v in ready.candidates.variants
        if v.family == family and v.channels == channels and v.shape == (shape,) and v.starts
    )
    return one


def naming_of(variant):
    return Naming((FoundEffect(variant, 100.0, 100.0, 30.0),))


@pytest.mark.slow
def test_a_lag_that_did_not_begin_in_equilibrium_is_no_drift():
    """The trial's body has followed the temperature for hours; from equilibrium, a drift would fit better."""
    case, answer = make_case(3, Row("single", "paper", 12.0), 69)
    assert answer.names == ("thermal_bias",)
    stand_u = STAND | {"voltmeter_error": NOISE_V}
    found = diagnose(case.readings, MODEL, stand_u, np.diag(K), OneThreshold())
    assert [one.name for one in found.effects] == ["thermal_bias"]
    assert "bias_drift" not in found.effects[0].cannot_tell_from


def body(conditions, rng):
    """Temperature (n,) of a body behind the lag, K, whose state differs from equilibrium in each mounting."""
    fine = np.arange(conditions.time_s[0], conditions.time_s[-1] + 1.0)
    air = np.interp(fine, conditions.time_s, conditions.temperature_c - 20.0)
    inside = air.copy()
    for i in range(1, len(fine)):
        inside[i] = inside[i - 1] + ((air[i] + air[i - 1]) / 2 - inside[i - 1]) / LAG_S
    since = conditions.time_s - np.array(
        [conditions.time_s[conditions.mount == m][0] for m in conditions.mount]
    )
    off = rng.normal(0.0, np.std(conditions.temperature_c), (500, len(conditions.mounts)))[
        :, conditions.mount
    ]
    return np.interp(conditions.time_s, fine, inside), off * np.exp(-since / LAG_S)


@pytest.mark.slow
def test_u_of_a_size_contains_the_unknown_state(ready):
    linear, rng = ready.linear, np.random.default_rng(5)
    calm, off = body(linear.conditions, rng)
    size_v = K[1, 1] * 300e-6
    noise = null_responses(linear, NOISE_V, np.zeros(len(off)), rng)
    variant = variant_of(ready, "thermal_bias", ("lag", LAG_S))

    def pulls(variant):
        found = []
        for k in range(120):
            change = np.zeros((len(calm), 3))
            change[:, 1] = size_v * (calm + off[k])
            response = linear.view.rows_of(change) + noise[:, k]
            of = fit_found(
                replace(linear, response=response), ready.candidates, naming_of(variant),
                NoiseSize(NOISE_V, 1e-12, 120),
            )  # fmt: skip
            found.append((of.amplitudes[0] - 5.0) / np.sqrt(of.amplitude_covariance[0, 0]))
        return float(np.sqrt(np.mean(np.square(found))))

    assert 0.8 < pulls(variant) < 1.2
    assert pulls(variant.plain) > 1.5  # from equilibrium, u is too small


def test_a_model_file_states_the_prior_of_each_mounting(ready, tmp_path):
    variant = variant_of(ready, "thermal_bias", ("lag", LAG_S))
    naming = naming_of(variant)
    sized = fit_found(ready.linear, ready.candidates, naming, NOISE)
    mean = np.full_like(sized.mean, 3.0)  # one channel: a size, and a state for each mounting
    states = starting_states(ready.linear, ready.candidates, naming, replace(sized, mean=mean))
    write_model_file(tmp_path / "model.yaml", "started", states)
    again = load_model(tmp_path / "model.yaml", MODEL.installations).applied_effects()
    assert [one.effect.parts[0].installations for one in again] == [("1",), ("2",), ("V",)]
    assert [(float(one.values["part"]), float(one.u["part"])) for one in again] == [(0.0, 1.0)] * 3
    spread = np.std(ready.linear.conditions.temperature_c)
    expected = [0.0, 3.0 * 60e-6 * spread, 0.0]
    assert again[0].effect.parts[0].values["start"] == pytest.approx(expected, rel=1e-6)
    # and the fit of the model file has the column of the search, of one channel
    column = ready.linear.effect_columns(replace(again[0], values={"part": np.ones(())}))[:, 1]
    searched = ready.candidates.columns[:, variant.columns[len(variant.sizes)]]
    assert column == pytest.approx(3.0 * searched, abs=1e-12)


@pytest.mark.parametrize("name", ["thermal_bias", "thermal_scale", "hysteresis"])
def test_without_a_stated_u_a_mounting_begins_in_equilibrium(ready, name):
    effect = CATALOGUE[name]
    size = next(p for p in effect.parameters if p.is_size)
    shape = next(p for p in effect.parameters if p.is_shape)
    values = {size.name: np.full(3, size.plausible), shape.name: np.asarray(shape.grid[-1])}
    plain = AppliedEffect(effect, values, u={size.name: np.full(3, size.plausible)})
    problem = make_problem(ForwardModel(MODEL.installations, (plain,)), ready.linear.moved, {})
    assert {unknown.parameter for unknown in problem.effects} == {size.name}
    zero = replace(plain, values={**values, "start": np.zeros(3)})
    assert np.array_equal(ready.linear.effect_column(plain), ready.linear.effect_column(zero))


def test_a_play_forgets_its_start(ready):
    conditions, _ = MODEL._turned(ready.linear.conditions)
    risen, middle, fallen = (state(conditions, 0.25, start) for start in (1.0, 0.0, -1.0))
    # x of installation 1 rises at 0 deg from -5 deg on: by 0.087 g, which is 0.35 half-widths
    assert risen[0, 0] == 1.0
    assert middle[0, 0] == pytest.approx(np.sin(np.radians(5.0)) / 0.25)
    assert fallen[0, 0] == pytest.approx(middle[0, 0] - 1.0)
    later = np.flatnonzero(conditions.mount == 0)[2:]
    assert np.array_equal(risen[later][:, [0, 2]], fallen[later][:, [0, 2]])
    assert np.all(
        risen[later, 1] - fallen[later, 1] == 2.0
    )  # the force on y is constant: nothing moves its play
