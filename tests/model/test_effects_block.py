"""Effects of the block against closed forms typed here."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.model import CATALOGUE, Block, Conditions, ForwardModel, Installation
from bench.model.conditions import PAST_RAD
from bench.model.effects import Seen
from bench.model.effects.block import state
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import ARCSEC, specific_force
from tests.support.effect_bench import (
    BLOCK,
    CONDITIONS,
    INSTALLATIONS,
    KII,
    LABELS,
    PHI,
    SECOND,
    TIME_S,
    WARMTH_K,
    added,
    effect,
    force,
)

C = np.array([10e-6, -20e-6, 30e-6])
D = np.array([-7e-6, 9e-6, 4e-6])
E = np.array([5e-6, 3e-6, -8e-6])
HOURS = TIME_S[:, None] / 3600
IN_MOUNTING_H = (TIME_S - np.where(SECOND, TIME_S[18], TIME_S[0]))[:, None] / 3600
KELVIN = WARMTH_K[:, None]
A = force()
AX, AY, AZ = A.T
ATOL = 2e-15


def columns(x, y, z):
    return np.stack([x, y, z], axis=1)


CASES = {
    "quadratic_nonlinearity": ({"K2": C}, KII * C * A * A),
    "cubic_nonlinearity": ({"K3": C}, KII * C * A * A * A),
    "odd_quadratic_nonlinearity": ({"Koq": C}, KII * C * np.where(A > 0, A * A, -A * A)),
    "scale_asymmetry": ({"Kabs": C}, KII * C * np.where(A > 0, A, -A)),
    "cross_coupling": (
        {"Kip": C, "Kio": D, "Kpo": E},
        columns(
            KII[0] * (10e-6 * AX * AY - 7e-6 * AX * AZ + 5e-6 * AY * AZ),
            KII[1] * (-20e-6 * AY * AZ + 9e-6 * AY * AX + 3e-6 * AZ * AX),
            KII[2] * (30e-6 * AZ * AX + 4e-6 * AZ * AY - 8e-6 * AX * AY),
        ),
    ),
    "cross_quadratic": (
        {"Kpp": C, "Koo": D},
        columns(
            KII[0] * (10e-6 * AY**2 - 7e-6 * AZ**2),
            KII[1] * (-20e-6 * AZ**2 + 9e-6 * AX**2),
            KII[2] * (30e-6 * AX**2 + 4e-6 * AY**2),
        ),
    ),
    "bias_asymmetry": ({"K0p": C}, KII * C / 2 * (1 - 2 / (1 + np.exp(200 * A)))),
    "thermal_nonlinearity": ({"K2_T": C, "K3_T": D}, KII * (C * A * A + D * A * A * A) * KELVIN),
    "thermal_misalignment": (
        {"m_j": C, "m_k": D},
        columns(
            KII[0] * (10e-6 * AY - 7e-6 * AZ),
            KII[1] * (-20e-6 * AZ + 9e-6 * AX),
            KII[2] * (30e-6 * AX + 4e-6 * AY),
        )
        * KELVIN,
    ),
    "thermal_bias": ({"b_T": C}, KII * C * KELVIN),
    "thermal_scale": ({"k_T": C}, KII * A * C * KELVIN),
    "warm_up": ({"A": C, "tau": 1800.0}, KII * C * np.exp(-HOURS / 0.5)),
    "supply_sensitivity": (
        {"b_S": C, "k_S": D, "rail": 2.0},
        KII * (C + D * A) * (-0.1 + 0.05 * np.sin(TIME_S / 700.0))[:, None],
    ),
    "bias_drift": ({"rate": C / 3600}, KII * C * HOURS),
    "scale_drift": ({"rate": C / 3600}, KII * A * C * HOURS),
    "turn_on_shift": ({"step": C}, np.tile(KII * C, (36, 1))),
    "scale_step": ({"step": C}, KII * A * C),
    "thermal_settling": ({"A": C, "tau": 2400.0}, KII * C * np.exp(-IN_MOUNTING_H * 1.5)),
}


@pytest.mark.parametrize("name", CASES)
def test_closed_form(name):
    values, expected = CASES[name]
    np.testing.assert_allclose(added(name, **values), expected, rtol=0, atol=ATOL)


def test_a_shape_left_out_has_its_default():
    np.testing.assert_allclose(added("warm_up", A=C), KII * C * np.exp(-HOURS / (1 / 3)), rtol=0, atol=ATOL)


def test_lagged_temperature_is_the_solution_of_its_equation():
    """lag T' = T_sensor - T, from equilibrium, the sensor running straight from reading to reading."""
    lag = 600.0
    solved = solve_ivp(
        lambda t, y: (np.interp(t, TIME_S, WARMTH_K) - y) / lag,
        (TIME_S[0], TIME_S[-1]),
        WARMTH_K[:1],
        t_eval=TIME_S,
        max_step=30.0,
        rtol=1e-10,
        atol=1e-12,
    )
    got = added("thermal_bias", b_T=np.full(3, 1.0), lag=lag) / KII
    np.testing.assert_allclose(got, np.tile(solved.y.T, (1, 3)), rtol=0, atol=1e-8)


def test_a_run_that_begins_again_is_in_equilibrium_again():
    """Time that goes back is another run; time that stands still leaves the lagging temperature where it is."""
    conditions = Conditions.of(
        ["1"] * 5, np.zeros(5), time_s=[0, 600, 0, 600, 600], temperature_c=[20, 21, 25, 25, 30]
    )
    values = {"b_T": np.ones(3), "lag": np.array(600.0)}
    seen = Seen(np.zeros((5, 3)), conditions, Block(np.eye(3), np.zeros(3)))
    got = CATALOGUE["thermal_bias"].addition(values, seen)
    np.testing.assert_allclose(got[:, 0], [0, np.exp(-1), 5, 5, 5], atol=1e-14)


def test_a_turn_on_shift_lasts_from_its_mounting_on():
    conditions = Conditions.of(["1", "2", "1"], np.zeros(3), series=[1, 1, 2])
    stand = np.zeros((3, 5))
    plain = ForwardModel(INSTALLATIONS).readings(BLOCK, conditions, stand)

    def shift(*mounts):
        model = ForwardModel(INSTALLATIONS, (effect("turn_on_shift", mounts, step=C),))
        return (model.readings(BLOCK, conditions, stand) - plain) / (KII * C)

    np.testing.assert_allclose(shift("2"), np.outer([0, 1, 1], np.ones(3)), atol=1e-9)
    np.testing.assert_allclose(shift("1/2"), np.outer([0, 0, 1], np.ones(3)), atol=1e-9)
    np.testing.assert_array_equal(shift("4"), np.zeros((3, 3)))


def test_any_other_effect_is_of_its_mountings_alone():
    got = added("bias_drift", ("1",), rate=C / 3600)
    np.testing.assert_allclose(got, np.where(SECOND[:, None], 0, KII * C * HOURS), rtol=0, atol=ATOL)


def test_without_temperatures_there_is_no_thermal_effect():
    conditions = Conditions.of(LABELS, PHI, time_s=TIME_S)
    np.testing.assert_array_equal(added("thermal_bias", conditions=conditions, b_T=C, lag=300.0), 0)
    np.testing.assert_array_equal(added("thermal_scale", conditions=conditions, k_T=C), 0)


def test_a_temperature_between_others_is_on_the_line():
    conditions = Conditions.of(
        ["1"] * 4,
        np.zeros(4),
        time_s=[0, 100, 200, 300],
        temperature_c=[np.nan, 20, np.nan, 22],
    )
    np.testing.assert_allclose(conditions.warmth_k, [0, 0, 1, 2])


def test_without_times_a_run_goes_at_the_usual_pace():
    """2 min a setting, 20 min more at a remount; where some rows have a time, the others keep that pace."""
    mounts = ["1", "1", "2", "2"]
    nothing_known = Conditions.of(mounts, np.zeros(4))
    np.testing.assert_allclose(nothing_known.elapsed_s, [0, 120, 1440, 1560])
    some = Conditions.of(mounts, np.zeros(4), time_s=[np.nan, 1000, np.nan, np.nan])
    np.testing.assert_allclose(some.elapsed_s, [880, 1000, 2320, 2440])
    assert CONDITIONS.elapsed_s.tolist() == TIME_S.tolist()


# --- effects hysteresis -----------------------------------------------------------------------------
# Hysteresis against a play operator driven in small steps, and against signs that one can see at once.

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
    """A play operator driven along the head's way in steps of 0.02 deg, at the forces of bench.validation."""
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
            for now in specific_force([labels[i]] * len(way), way, psi=psi).tolist():
                slack = [min(max(s, n - width_g), n + width_g) for s, n in zip(slack, now, strict=True)]
        result.append((np.array(now) - slack) / width_g)
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
