"""A form without a name in readings of several blocks: terms of the bench shared, coefficients each its own."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import diagnose
from bench.diagnosis.multi_run_system import make_system
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.residual_dictionary import dictionary
from bench.readings.table import JoinedPart, together
from tests.support.diagnosis_bench import MODEL, STAND, STAND_U, OneThreshold, columns_by_model, paper_run

HALF_WAVE_V = 200e-6
SCALE = 1.0 + np.array([[0.0, 0.0, 0.0], [0.01, -0.02, 0.015]])


def system_of_two_blocks():
    """Two blocks, to whose channel y the bench adds volts in half a wave per turn."""
    rng = np.random.default_rng(31)
    tables = []
    for change in SCALE:
        run = paper_run(rng)
        wave = HALF_WAVE_V * np.sin(run.angle_rad / 2)[:, None] * np.eye(3)[1]
        tables.append(replace(run, signal=run.signal * change + wave))
    joined = together([JoinedPart(table, block=i) for i, table in enumerate(tables)])
    return make_system(joined, MODEL, STAND_U)


@pytest.fixture(scope="module")
def system():
    return system_of_two_blocks()


def test_the_clock_and_the_turns_of_a_run_begin_with_it(system):
    turns, run = system.conditions.head_turns, system.readings.run
    for course in (turns.visit, turns.wound, turns.turned, turns.travelled):
        np.testing.assert_allclose(course[run == 1], course[run == 0], atol=1e-12)
    assert set(turns.visit) == {1.0, 2.0, 3.0}  # the verification is the third


@pytest.mark.slow
def test_terms_are_those_of_one_run_and_add_the_same_to_every_block(system):
    listed, alone = list(dictionary(system)), list(dictionary(system.parts[0]))
    assert {term.family for term, _, _ in listed} == {term.family for term, _, _ in alone}
    for number in np.random.default_rng(2).choice(len(listed), 12, replace=False):
        for column, added in columns_by_model(listed[number], system):
            # the stand and the head are made linear: what is beyond grows with the square of an angle
            atol = max(2e-4 * float(np.max(np.abs(added))), 1e-18)  # V: rounding of a column of zeros
            np.testing.assert_allclose(column, added, rtol=1e-7, atol=atol)


@pytest.mark.slow
def test_a_form_of_the_bench_is_found_in_several_blocks_at_once(system):
    found = diagnose(system.readings, MODEL, STAND, None, OneThreshold())
    (term,) = found.form.terms
    assert term.family == "a wave, 0.5 per turn, in the bias"
    _, sine = (size for size in values_of((term.applied,)) if size.u is not None)
    assert (sine.channel, sine.unit) == ("y", "ug")
    # a bias in g of the mean of the two scale factors, which are 2 % apart
    expected = HALF_WAVE_V / system.block.K[1, 1] / (1.0 + SCALE[1, 1]) * 2.0 * 1e6
    assert abs(sine.value - expected) < 4 * sine.u < 40
    assert found.form.predicts
    assert found.form.gap.closed > 0.8
