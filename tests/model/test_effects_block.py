"""Effects of the block against closed forms typed here."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.model import CATALOGUE, Block, Conditions, ForwardModel
from bench.model.effects import Seen
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
        temperature_c=[np.nan, 21, np.nan, 23],
        reference_c=21.0,
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
