"""The simulated world: keyed random numbers, geometry, temperature, time."""

import math
from functools import partial

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.model import AppliedEffect, Block, Conditions, Distribution, ForwardModel
from bench.model.effects import CATALOGUE, Effect, Stage
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from sim.world.clock import VirtualClock, wait_until
from sim.world.world import World, WorldSettings
from tests.support.patience import together

BLOCK = Block(
    np.array([[-2.177, 0.011, 0.021], [0.006, -2.142, 0.033], [0.012, 0.024, -2.163]]),
    np.array([0.07, -0.2, -0.41]),
)
STAND = {
    "axis_tilt": Distribution(5 * ARCSEC, k=3),
    "zero_offset": Distribution(5 * ARCSEC, k=3),
    "mounting_error": Distribution(90 * ARCSEC, k=3),
    "setting_error": Distribution(10 * ARCSEC, k=3),
    "voltmeter_error": Distribution(1e-4, k=3),
}


def a_world(
    stand: dict[str, Distribution] | None = None,
    seed: int = 7,
    model: ForwardModel | None = None,
    clock: VirtualClock | None = None,
) -> World:
    model = model or ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
    return World(WorldSettings(BLOCK, model, stand or {}, seed), clock or VirtualClock())


def one_reading(world: World, key: str, scale_rad: float) -> tuple[float, ...]:
    world.begin_step(f"{key}/turn#1")
    world.turn(scale_rad, 1)
    world.begin_step(f"{key}/read#1")
    values = []
    for channel in ("x", "y", "z"):
        world.new_reading(channel)
        values.append(world.signal_v(channel))
    return (*values, float(world.terminals("x").random("noise").normal()))


def test_a_step_draws_the_same_numbers_whatever_happened_before() -> None:
    undisturbed = a_world(STAND)
    undisturbed.mount("1")
    for i in range(5):
        one_reading(undisturbed, f"{i}", i * 0.7)
    undisturbed.mount("2")
    expected = one_reading(undisturbed, "9", 1.1)

    resumed = a_world(STAND)
    resumed.mount("2")
    assert one_reading(resumed, "9", 1.1) == expected


def test_another_step_attempt_or_seed_draws_other_numbers() -> None:
    first = one_reading(a_world(STAND), "9", 1.1)
    for other in (one_reading(a_world(STAND), "10", 1.1), one_reading(a_world(STAND, seed=8), "9", 1.1)):
        assert all(a != b for a, b in zip(first, other, strict=True))
    world = a_world(STAND)
    world.begin_step("9/turn#2")
    world.turn(1.1, 1)
    again = world.true_angle_rad
    world.begin_step("9/turn#1")
    world.turn(1.1, 1)
    assert world.true_angle_rad != again


def test_without_steps_each_turn_and_reading_is_fresh() -> None:
    world = a_world(STAND)
    angles, signals = set(), set()
    for _ in range(5):
        world.turn(0.0, 1)
        angles.add(world.true_angle_rad)
    for _ in range(5):
        world.new_reading("x")
        signals.add(world.signal_v("x"))
    assert len(angles) == len(signals) == 5


def test_mounting_is_keyed_by_series_and_installation_alone() -> None:
    world = a_world(STAND)
    world.mount("1")
    first = world.stand_rad
    world.begin_step("later")
    world.mount("2")
    assert not np.array_equal(world.stand_rad, first)
    world.mount("1", series=2)
    assert not np.array_equal(world.stand_rad, first)
    world.mount("1")
    np.testing.assert_array_equal(world.stand_rad, first)
    assert (world.installation, world.series) == ("1", 1)


def test_voltmeter_error_is_constant_within_a_reading() -> None:
    world = a_world({"voltmeter_error": Distribution(1e-4)})
    world.new_reading("y")
    samples = [world.signal_v("y") for _ in range(4)]
    assert len(set(samples)) == 1
    other = world.signal_v("x")
    world.new_reading("y")
    assert world.signal_v("y") != samples[0]
    assert world.signal_v("x") == other


def test_setting_errors_have_the_stated_size() -> None:
    # 400 draws: the sample standard deviation has a relative sigma of 1/sqrt(800) = 3.5 %; bound 4 sigma.
    world = a_world({"setting_error": Distribution(10 * ARCSEC, k=3)}, seed=2024)
    errors = []
    for i in range(400):
        world.begin_step(str(i))
        world.turn(1.0, 1)
        errors.append(world.true_angle_rad - world.scale_angle_rad)
    assert np.std(errors) == pytest.approx(10 * ARCSEC / 3, rel=0.14)


def test_signal_is_the_forward_models_reading_with_effects() -> None:
    eccentricity = AppliedEffect(
        CATALOGUE["head_eccentricity"], {"cosine": np.array(8 * ARCSEC), "sine": np.array(-5 * ARCSEC)}
    )
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2}, (eccentricity,))
    world = a_world(STAND, model=model)
    world.mount("2", series=3)
    world.turn(2.0, -1)
    expected = model.readings(
        BLOCK,
        Conditions.of(["2"], [2.0], series=[3], direction=[-1]),
        world.stand_rad[np.newaxis, :],
        world.true_angle_rad - 2.0,
    )[0]
    actual = [world.signal_v(channel) for channel in ("x", "y", "z")]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-15)


class _Heating(Effect):
    """A signal that shows temperature and time as they are given."""

    name = "heating"
    stage = Stage.VOLTMETER_READING
    parameters = ()
    sentence = "for the test"
    shown_by = "the test"

    def addition(self, values, seen):  # type: ignore[no-untyped-def]
        """Return temperature above 20 degC on x, time on y."""
        rows = seen.conditions
        return np.stack([rows.warmth_k, rows.time_s, 0.0 * rows.time_s], axis=-1) - seen.signal


def test_effects_see_time_since_the_beginning_and_the_temperature_of_the_block() -> None:
    model = ForwardModel({"1": INSTALLATION_1}, (AppliedEffect(_Heating(), {}),))
    clock = VirtualClock(start_s=1000.0)
    world = World(WorldSettings(BLOCK, model, {}, 1, ambient_c=23.0), clock, began_s=1000.0)
    clock.sleep(250.0)
    assert world.signal_v("x") == pytest.approx(3.0, abs=1e-12)
    assert world.signal_v("y") == pytest.approx(250.0)
    world.set_chamber(63.0)
    clock.sleep(750.0)
    assert world.signal_v("x") == pytest.approx(3.0 + 40.0 * (1 - math.exp(-1)))
    assert world.signal_v("y", 1100.0) == pytest.approx(100.0)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(KeyError, match="no installation '3'"):
        a_world().mount("3")
    with pytest.raises(ValueError, match="not a stand error: level"):
        WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), {"level": Distribution(1.0)}, 1)
    with pytest.raises(ValueError, match="choose from x, y, z"):
        a_world().terminals("w")  # type: ignore[arg-type]


def test_virtual_clock_never_runs_backwards_and_waiters_wait_side_by_side() -> None:
    clock = VirtualClock(5.0)
    clock.sleep(-3.0)
    clock.advance_to(2.0)
    assert clock.now_s() == 5.0
    together(*[partial(wait_until, clock, 9.0, lambda: False)] * 8)
    assert clock.now_s() == 9.0


def test_a_wait_on_another_clock_is_sliced_and_can_be_interrupted() -> None:
    class Counting:
        def __init__(self) -> None:
            self.naps: list[float] = []

        def now_s(self) -> float:
            return sum(self.naps)

        def sleep(self, duration_s: float) -> None:
            self.naps.append(duration_s)

    clock = Counting()
    assert wait_until(clock, 1.0, lambda: False)
    assert clock.now_s() == pytest.approx(1.0)
    assert max(clock.naps) <= 0.05
    assert not wait_until(clock, 60.0, lambda: clock.now_s() > 1.2)
    assert clock.now_s() < 1.3
