"""Effects that look back, in the simulated world: what the model says of the whole run, reading by reading."""

import numpy as np
import pytest

from bench.base.arrays import CHANNELS
from bench.model import AppliedEffect, Conditions, Distribution, ForwardModel
from bench.validation.paper_bench import ARCSEC
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings
from tests.support.effect_bench import BLOCK, INSTALLATIONS, effect

STAND = {
    "axis_tilt": Distribution(5 * ARCSEC),
    "mounting_error": Distribution(60 * ARCSEC),
    "setting_error": Distribution(4 * ARCSEC),
}
EFFECTS = {
    "hysteresis step": effect("hysteresis", size=[2e-5, 3e-5, -2e-5]),
    "hysteresis play": effect("hysteresis", size=[2e-5, 3e-5, -2e-5], width_g=0.25),
    "lagged temperature": effect("thermal_bias", b_T=[6e-5, -5e-5, 4e-5], lag=600.0),
    "crosstalk": effect("channel_crosstalk", fraction=1e-4),
    "turn-on shift": effect("turn_on_shift", ("2",), step=[6e-5, -5e-5, 4e-5]),
    "warm-up": effect("warm_up", A=[1.5e-4] * 3, tau=1200.0),
}
TURNS = [(0, 1), (45, 1), (135, 1), (90, -1), (300, -1), (310, 1)]


def run(world: World, read: bool = True) -> tuple[np.ndarray, Conditions, np.ndarray, np.ndarray]:
    """Visit two installations; return the signals, the conditions, stand angles and setting errors."""
    rows, signals, setting = [], [], []
    stand = {}
    for mount in (("1", 1), ("2", 1), ("1", 2)):
        world.clock.sleep(1500.0)
        world.mount(*mount)
        stand[mount] = world.stand_rad
        for angle_deg, direction in TURNS:
            world.set_chamber(22.0 + angle_deg / 90.0)
            world.clock.sleep(120.0)
            world.turn(np.radians(angle_deg), direction)
            world.clock.sleep(30.0)
            if read:
                for channel in CHANNELS:
                    world.new_reading(channel)
            signals.append([world.signal_v(channel) for channel in CHANNELS])
            rows.append((*mount, angle_deg, direction, world.clock.now_s() - world.began_s, world.block_c))
            setting.append(world.true_angle_rad - np.radians(angle_deg))
    label, series, angle_deg, direction, time_s, block_c = (list(c) for c in zip(*rows, strict=True))
    conditions = Conditions.of(
        label, np.radians(angle_deg), series=series, direction=direction, time_s=time_s, temperature_c=block_c
    )
    return np.array(signals), conditions, np.array(list(stand.values())), np.array(setting)


def a_world(*effects: AppliedEffect) -> World:
    model = ForwardModel(INSTALLATIONS, effects)
    return World(WorldSettings(BLOCK, model, STAND, seed=8), VirtualClock(500.0), began_s=500.0)


@pytest.mark.parametrize("names", [[name] for name in EFFECTS] + [list(EFFECTS)], ids=", ".join)
def test_a_run_reads_what_the_model_says_of_it(names: list[str]) -> None:
    world = a_world(*(EFFECTS[name] for name in names))
    signals, conditions, stand, setting = run(world)
    expected = world.settings.model.readings(BLOCK, conditions, stand, setting)
    np.testing.assert_allclose(signals, expected, rtol=0, atol=1e-14)
    plain = ForwardModel(INSTALLATIONS).readings(BLOCK, conditions, stand, setting)
    assert np.max(np.abs(signals - plain)) > 2e-5


def test_only_settings_that_were_read_are_looked_back_to() -> None:
    """A look at the terminals is no reading: the channel read before the first one is then not known."""
    seen, conditions, stand, setting = run(a_world(EFFECTS["crosstalk"]), read=False)
    plain = ForwardModel(INSTALLATIONS).readings(BLOCK, conditions, stand, setting)
    np.testing.assert_allclose(seen[:, 0], plain[:, 0], rtol=0, atol=1e-14)
    assert np.all(np.abs(seen[:, 1] - plain[:, 1]) > 1e-6)


def test_a_short_is_a_reading_that_the_next_one_remembers() -> None:
    world = a_world(EFFECTS["crosstalk"])
    world.turn(0.7, 1)
    for channel in CHANNELS:
        world.new_reading(channel)
    signal_v = [world.signal_v(channel) for channel in CHANNELS]
    world.clock.sleep(10.0)
    world.select_input("short")
    for channel in CHANNELS:
        world.new_reading(channel)
    # the short itself keeps a part of z of the signals, in the channel that is scanned first
    assert [world.signal_v(c) for c in CHANNELS] == pytest.approx([1e-4 * signal_v[2], 0, 0], rel=1e-3)
    world.clock.sleep(10.0)
    world.select_input("signal")
    assert world.signal_v("x") == pytest.approx(signal_v[0] * (1 - 1e-4), abs=1e-9)
    assert world.signal_v("y") == signal_v[1]


def test_a_sample_handed_over_late_is_after_the_settings_of_its_own_time() -> None:
    world = a_world(EFFECTS["hysteresis play"], EFFECTS["crosstalk"])
    now = []
    for angle_deg, direction in TURNS:
        world.turn(np.radians(angle_deg), direction)
        world.clock.sleep(60.0)
        world.new_reading("x")
        now.append((world.clock.now_s(), [world.signal_v(channel) for channel in CHANNELS]))
        world.clock.sleep(60.0)
    world._signals.clear()
    for at_s, signals in now:
        assert [world.signal_v(channel, at_s) for channel in CHANNELS] == signals


def test_a_world_set_up_again_goes_on_where_it_was_told_it_had_been() -> None:
    """Two thirds of a run are recalled from their record; what is then read is what the whole run reads."""
    effects = tuple(EFFECTS.values())
    whole, conditions, _, setting = run(a_world(*effects))
    again = a_world(*effects)
    for i in range(12):
        mount = conditions.mounts[conditions.mount[i]]
        again.recall(
            mount.installation,
            mount.series,
            conditions.angle_rad[i],
            conditions.direction[i],
            conditions.time_s[i],
            block_c=conditions.temperature_c[i],
        )
    again.clock.sleep(conditions.time_s[12])
    again.mount("1", 2)
    again.turn(conditions.angle_rad[12], 1)
    again.clock.sleep(0.0)
    got = np.array([again.signal_v(channel) for channel in CHANNELS])
    # a new turn draws another alpha4, the recalled one had none; a new world stands at the room's temperature
    lag = np.abs(conditions.temperature_c[12] - again.block_c) * 6e-5 * 2.2
    alpha = np.abs(again.true_angle_rad - conditions.angle_rad[12] - setting[12]) * 2.2
    np.testing.assert_allclose(got, whole[12], rtol=0, atol=1.01 * (lag + alpha) + 1e-8)


def test_the_scan_order_is_that_of_the_triggers_where_no_step_tells_it() -> None:
    world, plain = a_world(EFFECTS["crosstalk"]), a_world()
    for one in (world, plain):
        one.turn(0.7, 1)
    x, _, z = (plain.signal_v(channel) for channel in CHANNELS)
    world.new_reading("z")
    assert world.signal_v("z") == z
    world.new_reading("x")
    assert world.signal_v("x") == pytest.approx(x + 1e-4 * (z - x))


def test_the_scan_order_is_that_of_the_step() -> None:
    world = a_world(EFFECTS["crosstalk"])
    world.turn(0.7, 1)
    plain = a_world()
    plain.turn(0.7, 1)
    x, y, z = (plain.signal_v(channel) for channel in CHANNELS)
    part = 1e-4
    assert [world.signal_v(c) for c in CHANNELS] == pytest.approx([x, y + part * (x - y), z + part * (y - z)])
    world.begin_step("5/read", (2, 1, 0))
    for channel in CHANNELS:
        world.new_reading(channel)
    assert [world.signal_v(c) for c in CHANNELS] == pytest.approx([x + part * (y - x), y + part * (z - y), z])
