"""Positions set by hand, with repeats: they tilt by degrees, and that is no mistake of procedure."""

import numpy as np
import pytest

from bench.diagnosis.mistakes.search import find_mistakes
from bench.readings.table import make_readings
from bench.validation.paper_bench import STAND_U, U0, K, specific_force
from tests.support.mistaken_runs import MODEL, NOMINAL, find, run, with_signal

SIX = [("1", 0), ("1", 90), ("1", 180), ("1", 270), ("2", 0), ("2", 180)]


def hand_set(seed, tilt_deg, *, each_trial, trials=3, scale=K, zero=U0):
    """Six positions, set anew in each trial or held by a fixture that is off alike in all."""
    rng = np.random.default_rng(seed)
    places = SIX * trials
    number = np.repeat(np.arange(1, trials + 1), len(SIX))
    labels, phi = [label for label, _ in places], np.radians([angle for _, angle in places])
    tilt = rng.normal(0, np.radians(tilt_deg), (trials if each_trial else 1, len(SIX), 3))
    tilt = np.broadcast_to(tilt, (trials, len(SIX), 3)).reshape(-1, 3)
    force = specific_force(labels, phi)
    force = force + np.cross(tilt, force)
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    signal = force @ scale.T + zero + rng.normal(0, 15e-6, force.shape)
    return make_readings(labels, number, [1, 2, 3, 4, 1, 2] * trials, phi, signal)


@pytest.mark.slow
@pytest.mark.parametrize("each_trial", [True, False])
@pytest.mark.parametrize("nominal", [NOMINAL, None])
def test_positions_that_tilt_by_up_to_degrees_are_no_mistake(each_trial, nominal):
    for seed, tilt_deg in enumerate([0.5, 3.0]):
        readings = hand_set([71, seed], tilt_deg, each_trial=each_trial)
        found = find_mistakes(readings, MODEL, STAND_U, nominal)
        assert found.mistakes == (), tilt_deg


@pytest.mark.slow
def test_wires_exchanged_among_hand_set_positions_are_still_found():
    readings = hand_set(72, 1.0, each_trial=True)
    mask = readings.installation == "1"
    swapped = with_signal(readings, mask, lambda signal: signal[:, [2, 1, 0]])
    (mistake,) = find(swapped).mistakes
    assert (mistake.name, mistake.channels, mistake.installations) == ("swapped_channels", ("x", "z"), ("1",))


@pytest.mark.slow
def test_rows_that_a_supposition_leaves_out_speak_against_it():
    # a stop too late in a pass of three stops: two thirds of six rows fit anything, and are no evidence
    readings = hand_set(73, 0.5, each_trial=True, trials=1)
    assert find_mistakes(readings, MODEL, STAND_U, None).mistakes == ()


@pytest.mark.slow
def test_one_position_in_each_pass_shifts_nowhere():
    good = run(75)
    few = good.select((good.point == 1) | (good.installation == "V"))
    spoilt = with_signal(few, few.pass_number == 2, lambda signal: signal[:, [1, 0, 2]])
    find(spoilt)  # a single row has no neighbour that it could belong to
