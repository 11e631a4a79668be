"""Effects of stand, head and voltmeter against closed forms typed here, the geometry of bench.validation."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.model import CATALOGUE, Conditions, ForwardModel
from bench.model.forward import Stages
from bench.validation.paper_bench import ARCSEC, U0, K
from tests.support.effect_bench import (
    ALPHA4,
    BLOCK,
    CONDITIONS,
    DIRECTION,
    INSTALLATIONS,
    PHI,
    SECOND,
    STAND,
    TIME_S,
    added,
    effect,
    force,
    readings,
)

ANGLE = 30 * ARCSEC
COSINE, SINE = 12 * ARCSEC, -7 * ARCSEC
ATOL = 1e-14


def volts(a):
    return a @ K.T + U0


@pytest.mark.parametrize(
    ("name", "turned"),
    [
        ("axis_tilt", {"alpha1": ANGLE}),
        ("zero_offset", {"alpha2": ANGLE}),
        ("mounting_error", {"alpha3": ANGLE}),
        ("mounting_offset", {"alpha2": ANGLE}),
        ("mounting_roll", {"alpha5": ANGLE}),
        ("bracket_tilt", {"alpha1": ANGLE}),
    ],
)
def test_stand_angles_add_up(name, turned):
    np.testing.assert_allclose(readings(effect(name, angle=ANGLE)), volts(force(**turned)), atol=ATOL)
    (key,) = turned
    expected = volts(force(**{key: np.where(SECOND, ANGLE, 0)}))
    np.testing.assert_allclose(readings(effect(name, ("2",), angle=ANGLE)), expected, atol=ATOL)


@pytest.mark.parametrize("harmonic", [1, 2])
def test_axis_wobble(harmonic):
    tilt = COSINE * np.cos(harmonic * PHI) + SINE * np.sin(harmonic * PHI)
    got = readings(effect("axis_wobble", cosine=COSINE, sine=SINE, harmonic=harmonic))
    np.testing.assert_allclose(got, volts(force(alpha1=tilt)), atol=ATOL)


def test_foundation_tilt():
    hours = TIME_S / 3600
    tilt = COSINE * np.cos(hours * 2 * np.pi / 6) + SINE * np.sin(hours * 2 * np.pi / 6)
    got = readings(effect("foundation_tilt", cosine=COSINE, sine=SINE, period=6 * 3600))
    np.testing.assert_allclose(got, volts(force(phi=tilt)), atol=ATOL)


@pytest.mark.parametrize(("name", "n"), [("head_eccentricity", 1), ("head_ellipticity", 2)])
def test_head_circle(name, n):
    got = readings(effect(name, cosine=COSINE, sine=SINE))
    expected = volts(force(phi=COSINE * np.cos(n * PHI) + SINE * np.sin(n * PHI)))
    np.testing.assert_allclose(got, expected, atol=ATOL)


def test_head_graduation():
    """The mark at 0 and 360 is one; 40 lies two thirds from 30 to 45; 222 lies between 210 and 225."""
    got = readings(effect("head_graduation", at_000=5 * ARCSEC, at_045=-6 * ARCSEC, at_225=ANGLE))
    deg = np.round(np.degrees(PHI))
    error = np.select([deg % 360 == 0, deg == 40, deg == 222], [5 * ARCSEC, -4 * ARCSEC, 0.8 * ANGLE], 0.0)
    np.testing.assert_allclose(got, volts(force(phi=error)), atol=ATOL)


def test_backlash():
    got = readings(effect("backlash", play=ANGLE))
    np.testing.assert_allclose(got, volts(force(phi=DIRECTION * ANGLE / 2)), atol=ATOL)
    unknown = Conditions.of(["1"] * 3, [0.0, 1.0, 0.5])
    model = ForwardModel(INSTALLATIONS, (effect("backlash", play=ANGLE),))
    plain = ForwardModel(INSTALLATIONS)
    np.testing.assert_array_equal(
        model.readings(BLOCK, unknown, STAND[:1]), plain.readings(BLOCK, unknown, STAND[:1])
    )


# --- voltmeter and wiring ---------------------------------------------------------------------------

U = volts(force())
HOURS = TIME_S[:, None] / 3600


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("voltmeter_nonlinearity", {"q2": 8e-6, "q3": -5e-6}, 8e-6 * (U / 2.5) ** 2 - 5e-6 * (U / 2.5) ** 3),
        ("voltmeter_drift", {"rate": 15e-6 / 3600}, 15e-6 * HOURS + 0 * U),
        ("voltmeter_warm_up", {"A": 1e-4, "tau": 1200.0}, 1e-4 * np.exp(-3 * HOURS) + 0 * U),
        ("range_offset", {"offset": 40e-6, "gain": 2e-5}, np.where(abs(U) < 1.2, 40e-6 + 2e-5 * U, 0)),
        ("voltmeter_gain", {"gain": 3e-5}, 3e-5 * U),
        ("voltmeter_offset", {"offset": 5e-5}, np.full((36, 3), 5e-5)),
        ("thermal_emf", {"emf": [5e-6, -3e-6, 2e-6]}, np.tile([5e-6, -3e-6, 2e-6], (36, 1))),
        ("wrong_gravity", {"excess": 3e-4}, 3e-4 * (U - U0)),
    ],
)
def test_voltmeter_and_gravity(name, values, expected):
    np.testing.assert_allclose(added(name, **values), expected, rtol=0, atol=ATOL)


def test_low_range_is_used_in_the_run():
    assert 0.2 < np.mean(abs(U) < 1.2) < 0.9


def test_channel_crosstalk():
    """Scanned x, y, z in rising passes and z, y, x in falling ones; before the first stands the row before."""
    expected = np.zeros((36, 3))
    before = None
    for row, direction in enumerate(DIRECTION):
        for channel in (0, 1, 2) if direction > 0 else (2, 1, 0):
            if before is not None:
                expected[row, channel] = 25e-6 * (before - U[row, channel])
            before = U[row, channel]
    np.testing.assert_allclose(added("channel_crosstalk", fraction=25e-6), expected, rtol=0, atol=ATOL)


# --- rows that no installation orients --------------------------------------------------------------


def test_a_shorted_or_reference_input_shows_the_meters_effects_alone():
    effects = (
        effect("voltmeter_offset", offset=5e-5),
        effect("voltmeter_gain", gain=1e-4),
        effect("thermal_emf", emf=[1e-3] * 3),
        effect("quadratic_nonlinearity", K2=[1e-3] * 3),
    )
    conditions = Conditions.of(["S", "R"], [np.nan, np.nan])
    model = ForwardModel(INSTALLATIONS, effects)
    got = model.voltmeter_readings(np.array([[0.0] * 3, [2.0] * 3]), conditions, BLOCK)
    np.testing.assert_allclose(got, np.outer([5e-5, 2.0 + 5e-5 + 2e-4], np.ones(3)), atol=1e-15)


def test_readings_at_given_forces_are_those_of_the_installation_that_gives_them():
    """All effects that do not ask for an angle: the force in, the same volts out."""
    effects = (
        effect("quadratic_nonlinearity", K2=[3e-5] * 3),
        effect("warm_up", A=[1e-4] * 3),
        effect("wrong_gravity", excess=3e-4),
        effect("channel_crosstalk", fraction=1e-4),
    )
    model = ForwardModel(INSTALLATIONS, effects)
    got = model.readings_at(force(), CONDITIONS, BLOCK)
    np.testing.assert_allclose(got, model.readings(BLOCK, CONDITIONS, STAND, ALPHA4), rtol=0, atol=1e-14)


def test_rows_of_all_kinds_in_the_order_of_measurement():
    """A short and a free position between two settings: each channel keeps a part of what was read before it."""
    model = ForwardModel(
        INSTALLATIONS, (effect("channel_crosstalk", fraction=1e-3), effect("voltmeter_offset"))
    )
    plain = ForwardModel(INSTALLATIONS)
    conditions = Conditions.of(["1", "S", "F", "1"], [0.5, np.nan, np.nan, 0.8])
    free = np.array([0.6, 0.0, 0.8])
    nothing = np.full(3, np.nan)
    stages = Stages(
        model,
        BLOCK,
        conditions,
        np.zeros((3, 5)),
        force=np.stack([nothing, nothing, free, nothing]),
        voltage_v=np.stack([nothing, np.zeros(3), nothing, nothing]),
    )
    got = stages.readings
    np.testing.assert_array_equal(stages.of(BLOCK), got)
    settings = plain.readings(BLOCK, Conditions.of(["1"] * 2, [0.5, 0.8]), np.zeros((1, 5)))
    u = np.stack([settings[0], np.zeros(3), K @ free + U0, settings[1]])
    scanned = np.concatenate([[u[0, 0]], u.ravel()])
    np.testing.assert_allclose(got.ravel(), scanned[1:] - 1e-3 * np.diff(scanned), rtol=0, atol=1e-15)


def test_an_unknown_installation_is_refused_or_has_no_reading():
    model, conditions = ForwardModel(INSTALLATIONS), Conditions.of(["1", "7"], [0.0, 0.0])
    with pytest.raises(KeyError, match="7"):
        model.readings(BLOCK, conditions, np.zeros((2, 5)))
    readings = Stages(model, BLOCK, conditions, np.zeros((2, 5))).readings
    assert np.isnan(readings).all(axis=1).tolist() == [False, True]


@pytest.mark.parametrize("wave", [one for one in CATALOGUE.values() if getattr(one, "order", None)])
def test_a_wave_of_the_head_has_as_many_periods_a_turn_as_its_order_says(wave):
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    seen = SimpleNamespace(conditions=SimpleNamespace(angle_rad=turn))
    lines = np.abs(np.fft.rfft(wave.addition({"cosine": 3.0, "sine": 4.0}, seen))) / 12
    np.testing.assert_allclose(lines, 5.0 * (np.arange(13) == wave.order), atol=1e-12)
