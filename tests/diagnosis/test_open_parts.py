"""What readings left open of a shape goes into a model file, and from there into the u of other readings."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration.design import make_problem
from bench.config.model_file import load_model, write_model_file
from bench.diagnosis.confirm import confirm
from bench.diagnosis.linear import make_linear
from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.posterior import (
    NoiseSize,
    applied_of,
    beside,
    fit_found,
    left_open,
    posterior,
    sizes_alone,
    with_other_shapes,
)
from bench.diagnosis.search import SearchTask, find_effects
from bench.model.effects.base import InPart
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, TRUTH
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

MINUTES = 60.0
NOISE = NoiseSize(NOISE_V, SETTING_U_RAD, 120)


def settling(seed):
    """A run in which channel x settles with two time constants, 8 and 45 min, neither of the catalogue."""
    readings = paper_run(np.random.default_rng([91, seed]))
    minutes = readings.time_s / MINUTES
    course = 400e-6 * np.exp(-minutes / 8.0) + 300e-6 * np.exp(-minutes / 45.0)
    return replace(readings, signal=readings.signal + np.outer(course, [1.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def found():
    """The system, the fit with the parts, the warm-up of 20 min with the shape held, and what is open of it."""
    ready = set_up(settling(1))
    shape = (("tau", 20 * MINUTES),)
    variant = next(
        v
        for v in ready.candidates.variants
        if v.family == "warm_up" and v.channels == (0,) and v.shape == shape
    )
    naming = Naming((FoundEffect(variant, 100.0, 100.0, 30.0),))
    sized = fit_found(ready.linear, ready.candidates, naming, NOISE)
    others = beside(ready.candidates, naming, sized)
    fitted = fit_found(with_other_shapes(ready.linear, others[0]), ready.candidates, naming, NOISE)
    rest = left_open(ready.linear, ready.candidates, naming, others, fitted, NOISE)
    u = np.sqrt(np.diag(sized.amplitude_covariance))
    return ready.linear, fitted, applied_of(ready.candidates, variant, sized.amplitudes, u), rest


def written(tmp_path, effects):
    """The effects as they come back from a model file."""
    path = tmp_path / "model.yaml"
    write_model_file(path, "warm", effects)
    return load_model(path).applied_effects()


def test_a_file_has_what_is_open_as_it_was(found, tmp_path):
    *_, main, rest = found
    back = written(tmp_path, (*main, *rest))
    assert [a.effect.name for a in back] == ["warm_up", *(f"warm_up_shape_{k + 1}" for k in range(len(rest)))]
    for one, again in zip(rest, back[1:], strict=True):
        assert isinstance(one.effect, InPart)
        assert isinstance(again.effect, InPart)
        assert float(again.values["part"]) == float(one.values["part"])
        assert [p.shapes_text() for p in again.effect.parts] == [p.shapes_text() for p in one.effect.parts]


def test_main_shape_and_parts_together_are_what_was_fitted(found):
    linear, fitted, main, rest = found
    ours = linear.view.rows_of(linear.view.own(linear.model, (*main, *rest), linear.block))
    start = linear.fixed.shape[1] + linear.random.shape[1]
    whole = linear.response - ours
    # the sum of parts settles as the truth does: what is left of it after the fit is noise
    left = replace(linear, response=whole)
    fit = posterior(left, np.zeros((len(linear), 0)), NOISE)
    rms = np.std(whole - np.concatenate([linear.fixed, linear.random], axis=1) @ fit.mean)
    assert rms < 3 * NOISE_V
    assert len(fitted.mean) > start


@pytest.mark.slow
def test_the_u_of_another_run_holds_it(found, tmp_path):
    _, _, main, rest = found
    back = written(tmp_path, (*main, *rest))
    pulls = {True: [], False: []}
    for seed in range(2, 10):
        for open_too in (True, False):
            effects = back if open_too else back[:1]
            linear = make_linear(settling(seed), replace(MODEL, effects=effects), STAND_U)
            fit = posterior(linear, np.zeros((len(linear), 0)), NOISE)
            off = linear.block.vector[9] + fit.mean[9] - TRUTH[9]
            pulls[open_too].append(off / np.sqrt(fit.covariance[9, 9]))
    # one truth, one file: all runs share its error, so that the mean pull is like one draw
    assert abs(np.mean(pulls[True])) < 3.0
    assert abs(np.mean(pulls[False])) > 3.0


@pytest.mark.slow
def test_new_readings_confirm_it_and_the_shape_is_no_effect_of_its_own(found, tmp_path):
    _, _, main, rest = found
    model = replace(MODEL, effects=written(tmp_path, (*main, *rest)))
    result = confirm(settling(20), model, STAND, cache=OneThreshold())
    assert [effect.applied.effect.name for effect in result.effects] == ["warm_up"]
    assert result.verdict == "confirmed"


def test_odds_of_a_shape_between_two_are_those_of_the_whole_model():
    """A body behind two lags of 15 min (seed 93): beside one lag alone, the readings miss something else, too."""
    run = paper_run(np.random.default_rng([93, 0]))
    fine = np.arange(run.time_s[0], run.time_s[-1] + 5.0, 5.0)
    course = 1.5 * np.sin(2 * np.pi * fine / 9000.0) + 0.4 * np.sin(fine / 700.0)
    body = course
    for _ in range(2):
        behind = body.copy()
        for i in range(1, len(fine)):
            behind[i] += (behind[i - 1] - behind[i]) * np.exp(-5.0 / (15 * MINUTES))
        body = behind
    air, inside = (np.interp(run.time_s, fine, one) for one in (course, body))
    signal = run.signal + np.outer(inside, [0.0, 0.0, 400e-6])
    task = SearchTask(MODEL, STAND, 0.0, OneThreshold())
    _, naming = find_effects(task, replace(run, temperature_c=22.0 + air, signal=signal))
    assert [one.variant.family for one in naming.found] == ["thermal_bias"]
    assert naming.found[0].odds[0].probability > 0.95


def test_a_fit_with_the_parts_has_no_parameters_that_the_effect_found_lacks():
    ready = set_up(paper_run(np.random.default_rng(92)))
    offset = next(
        v
        for v in ready.candidates.variants
        if v.family == "mounting_creep"
        and v.mounts == ("1", "2")
        and {ready.candidates.kinds[c].parameter for c in v.sizes} == {"mounting_offset"}
    )
    naming = Naming((FoundEffect(offset, 100.0, 100.0, 30.0),))
    (others,) = beside(ready.candidates, naming, fit_found(ready.linear, ready.candidates, naming, NOISE))
    alone = tuple(sizes_alone(ready.linear, others, 3))
    problem = make_problem(replace(MODEL, effects=alone), ready.linear.conditions, STAND_U)
    assert [(one.prior_mean, one.prior_u) for one in problem.effects] == [(0.0, 1.0)] * len(others)
    own = (replace(one, values=one.values | one.u, u={}) for one in others)
    for part, whole in zip(alone, own, strict=True):
        wanted = ready.linear.view.own(MODEL, (whole,), ready.linear.block)
        of_part = replace(part, values=part.u)
        np.testing.assert_allclose(ready.linear.view.own(MODEL, (of_part,), ready.linear.block), wanted)
