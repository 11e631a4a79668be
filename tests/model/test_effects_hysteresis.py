"""Hysteresis against a play operator driven in small steps, and against signs that one can see at once."""

from itertools import pairwise

import numpy as np
import pytest

from bench.model import Conditions, ForwardModel, Installation
from bench.model.conditions import PAST_RAD
from bench.model.effects.block import state
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from tests.support.effect_bench import BLOCK, KII, effect
from tests.support.paper_bench import ARCSEC, specific_force

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
SIZE = np.array([20e-6, -30e-6, 40e-6])


def states(labels, angle_deg, direction=None, width_g=0.0, shift_rad=0.0):
    """The state of the loop, taken from the readings, (n, 3)."""
    conditions = Conditions.of(labels, np.radians(angle_deg) + shift_rad, direction=direction)
    stand = np.zeros((len(conditions.mounts), 5))
    loop = effect("hysteresis", size=SIZE, width_g=width_g)
    with_loop = ForwardModel(MODEL.installations, (loop,)).readings(BLOCK, conditions, stand)
    return (with_loop - MODEL.readings(BLOCK, conditions, stand)) / (KII * SIZE)


def test_step_has_the_sign_of_the_change():
    """Rising, x = sin rises to 90 and z = cos falls to 180; at their extremes neither has a side; y never moves."""
    angles = np.arange(0, 361, 45)
    x = [1, 1, 0, -1, -1, -1, 0, 1, 1]
    z = [0, -1, -1, -1, 0, 1, 1, 1, 0]
    rising = states(["1"] * 9, angles, [1] * 9)
    np.testing.assert_allclose(rising, np.stack([x, np.zeros(9), z], 1), atol=1e-8)
    falling = states(["1"] * 9, angles[::-1], [-1] * 9)
    np.testing.assert_allclose(falling, -rising[::-1], atol=1e-8)
    second = states(["2"] * 9, angles, [1] * 9)
    np.testing.assert_allclose(second, np.stack([np.negative(x), z, np.zeros(9)], 1), atol=1e-8)


def test_an_unknown_direction_is_that_of_the_turn_and_stays_without_one():
    angles = [0, 45, 135, 45, 45, 360 - 45, 315]
    told = states(["1"] * 7, angles, [0, 1, 1, -1, -1, -1, -1])
    untold = states(["1"] * 7, angles)
    np.testing.assert_allclose(untold[1:], told[1:], atol=1e-9)
    np.testing.assert_array_equal(untold[0], np.zeros(3))


@pytest.mark.parametrize("width_g", [0.0, 0.25])
def test_errors_within_the_limits_do_not_flip_a_branch(width_g):
    """5 arcsec on the scale, as an operator leaves it, next to a size of one; 360 is not quite 0."""
    rng = np.random.default_rng(3)
    angles = np.tile(np.arange(0, 361, 45), 3)
    labels, direction = ["1"] * 27, [1] * 27
    shift = rng.normal(0, 5 * ARCSEC, 27)
    moved = states(labels, angles, direction, width_g, shift)
    # |da| is 1 g/rad at most; tanh has the slope 1/0.05 per g/rad, the play 1/width per g: 4 sigma
    bound = 4 * 5 * ARCSEC * 2 / (width_g or 0.05)
    np.testing.assert_allclose(moved, states(labels, angles, direction, width_g), atol=bound)


def test_stand_angles_leave_the_state_alone():
    conditions = Conditions.of(["1"] * 9, np.radians(np.arange(0, 361, 45)), direction=[1] * 9)
    loop = ForwardModel(MODEL.installations, (effect("hysteresis", size=SIZE),))
    differences = [
        loop.readings(BLOCK, conditions, stand) - MODEL.readings(BLOCK, conditions, stand)
        for stand in (np.zeros((1, 5)), np.full((1, 5), 90 * ARCSEC))
    ]
    np.testing.assert_allclose(differences[0], differences[1], rtol=0, atol=1e-15)


def walked(labels, angle, direction, width_g, psi):
    """A play operator driven along the head's way in steps of 0.02 deg, at the forces of support/paper_bench.py."""
    result = []
    for i, end in enumerate(angle):
        if i == 0 or labels[i] != labels[i - 1]:
            stops = [end - direction[i] * PAST_RAD, end]
            slack = specific_force([labels[i]], np.array(stops[:1]), psi=psi)[0]
        else:
            turn = (end - angle[i - 1] + np.pi) % (2 * np.pi) - np.pi
            stops = [end - turn, end]
            if np.sign(turn) != direction[i]:
                stops.insert(1, end - direction[i] * PAST_RAD)
        for a, b in pairwise(stops):
            way = np.linspace(a, b, max(2, int(abs(b - a) / np.radians(0.02))))
            for now in specific_force([labels[i]] * len(way), way, psi=psi):
                slack = np.clip(slack, now - width_g, now + width_g)
        result.append((now - slack) / width_g)
    return np.array(result)


@pytest.mark.slow
@pytest.mark.parametrize("width_g", [0.1, 0.5])
def test_play_is_that_of_an_operator_driven_in_small_steps(width_g):
    """Random settings and directions, seed 11; all axes feel gravity; a step changes the force by 0.00035 g."""
    rng = np.random.default_rng(11)
    labels = ["1"] * 12 + ["2"] * 8
    angle = np.radians(rng.uniform(0, 360, 20))
    direction = rng.choice([-1, 1], 20)
    installations = {
        "1": Installation.from_axes("1", ("x", "y", "z"), 0.6),
        "2": Installation.from_axes("2", ("-x", "z", "y"), 0.6),
    }
    conditions = Conditions.of(labels, angle, direction=direction.tolist())
    size = effect("hysteresis", size=np.ones(3), width_g=width_g)
    stand = np.zeros((2, 5))
    loop = ForwardModel(installations, (size,)).readings(BLOCK, conditions, stand)
    got = (loop - ForwardModel(installations).readings(BLOCK, conditions, stand)) / KII
    np.testing.assert_allclose(got, walked(labels, angle, direction, width_g, 0.6), atol=4e-4 / width_g)
    assert got.min() < -0.99
    assert got.max() > 0.99


def test_rows_that_no_angle_or_installation_orients_are_passed_over():
    angles = np.radians([0.0, 45.0, np.nan, 90.0])
    got = states(["1", "1", "1", "1"], [0, 45, 90, 90], [1] * 4, 0.25)
    conditions = Conditions.of(["1", "1", "S", "1"], angles, direction=[1, 1, 0, 1])
    loop = ForwardModel(MODEL.installations, (effect("hysteresis", size=SIZE, width_g=0.25),))
    plain = MODEL.output(np.zeros((4, 3)), conditions, BLOCK)
    passed = (loop.output(np.zeros((4, 3)), conditions, BLOCK) - plain) / (KII * SIZE)
    np.testing.assert_allclose(passed[[0, 1, 3]], got[[0, 1, 2]], atol=1e-9)
    np.testing.assert_array_equal(passed[2], np.zeros(3))


def test_it_does_not_guess_how_the_block_sits():
    with pytest.raises(ValueError, match="turns"):
        state(Conditions.of(["1"], [0.0]), 0.25)
