"""The world's motorised head and its chamber with a controller: closed forms over time, keyed by step."""

import math

import numpy as np
import pytest

from sim.world.pose import HeadFault
from sim.world.world import Heat, World
from tests.support.simulated_stand import a_world

DEG = math.pi / 180
SPEED = 10 * DEG


def after(world: World, duration_s: float) -> float:
    world.clock.sleep(duration_s)
    return math.degrees(world.scale_angle_rad)


# --- the head ---------------------------------------------------------------------------------------


def test_the_head_turns_at_its_speed_and_then_stands_exactly_at_the_target() -> None:
    world = a_world()
    world.move_head(45 * DEG, SPEED)
    assert after(world, 2.0) == pytest.approx(20.0)
    assert world.head_rate_rad_s == pytest.approx(SPEED)
    assert after(world, 2.5) == 45.0
    assert (world.scale_angle_rad, world.head_rate_rad_s, world.direction) == (45 * DEG, 0.0, 1)
    world.move_head(40 * DEG, SPEED)
    assert after(world, 0.25) == pytest.approx(42.5)
    assert (world.head_rate_rad_s, world.direction) == (pytest.approx(-SPEED), -1)


def test_signals_follow_the_head_on_its_way_and_a_late_question_sees_it_as_it_was() -> None:
    world = a_world()
    standing = a_world()
    world.move_head(90 * DEG, SPEED)
    world.clock.sleep(3.0)
    standing.turn(30 * DEG, 1)
    on_the_way = world.signal_v("x")
    assert on_the_way == pytest.approx(standing.signal_v("x"), abs=1e-12)
    world.clock.sleep(60.0)
    assert world.signal_v("x") != pytest.approx(on_the_way, abs=0.1)
    assert world.signal_v("x", 3.0) == on_the_way


def test_a_new_demand_on_the_way_starts_from_where_the_head_is() -> None:
    world = a_world()
    world.move_head(90 * DEG, SPEED)
    after(world, 3.0)
    world.move_head(0.0, SPEED)
    assert after(world, 1.0) == pytest.approx(20.0)
    world.stop_head()
    assert after(world, 100.0) == pytest.approx(20.0)


def test_mounting_does_not_stop_or_move_the_head() -> None:
    world = a_world()
    world.move_head(90 * DEG, SPEED)
    after(world, 3.0)
    world.mount("1")
    assert after(world, 1.0) == pytest.approx(40.0)


def test_the_setting_error_belongs_to_step_and_target() -> None:
    def error(step: str, *targets_deg: float) -> float:
        world = a_world(setting_error_rad=1e-4)
        world.begin_step(step)
        for target_deg in targets_deg:
            world.move_head(target_deg * DEG, SPEED)
            world.clock.sleep(100.0)
        return world.true_angle_rad - world.scale_angle_rad

    assert error("4/turn", 45.0) == error("4/turn", 46.0, 45.0) != error("5/turn", 45.0)
    assert error("4/turn", 45.0, 45.0) == error("4/turn", 45.0)
    assert error("4/turn", 45.0, 50.0, 45.0) != error("4/turn", 45.0)


def test_a_head_that_sticks_stays_so_until_it_is_stopped() -> None:
    world = a_world()
    world.head_fault = HeadFault(sticks_after_rad=5 * DEG)
    world.move_head(-45 * DEG, SPEED)
    assert not world.head_stuck
    assert after(world, 10.0) == pytest.approx(-5.0)
    assert world.head_stuck
    world.head_fault = HeadFault()
    world.stop_head()
    assert not world.head_stuck
    world.move_head(-45 * DEG, SPEED)
    assert after(world, 10.0) == pytest.approx(-45.0)


def test_a_head_that_does_not_move_at_all_keeps_the_side_it_came_from() -> None:
    world = a_world()
    world.turn(1.0, -1)
    world.head_fault = HeadFault(sticks_after_rad=0.0)
    world.move_head(2.0, SPEED)
    assert (world.scale_angle_rad, world.direction, world.head_stuck) == (1.0, -1, True)


def test_a_head_that_stops_off_target_shows_it_on_its_scale() -> None:
    world = a_world()
    world.head_fault = HeadFault(stops_off_rad=0.01)
    world.move_head(1.0, SPEED)
    world.clock.sleep(60.0)
    assert world.scale_angle_rad == pytest.approx(1.01)
    assert not world.head_stuck


# --- the chamber ------------------------------------------------------------------------------------

RATE_C_S = 4.0 / 60.0
LAG_S = 120.0


def integrated(
    demands: list[tuple[float, float]], end_s: float, block_lag_s: float, step_s: float = 0.25
) -> tuple[float, float]:
    """Integrate air and block from 20 °C in small steps: an independent way to the same temperatures."""
    air = block = ramp = 20.0
    target = 20.0
    for i in range(round(end_s / step_s)):
        for since_s, demand in demands:
            if i * step_s == since_s:
                target, ramp = demand, air
        ramp += float(np.clip(target - ramp, -RATE_C_S * step_s, RATE_C_S * step_s))
        block += (air - block) / block_lag_s * step_s
        air += (ramp - air) / LAG_S * step_s
    return air, block


@pytest.mark.parametrize("block_lag_s", [750.0, LAG_S, 30.0])
def test_air_and_block_are_those_of_a_step_by_step_integration(block_lag_s: float) -> None:
    heat = Heat(0.0, 20.0, block_lag_s)
    heat.ramp_air(0.0, 60.0, RATE_C_S, LAG_S)
    heat.ramp_air(400.0, -10.0, RATE_C_S, LAG_S)
    for time_s in (100.0, 390.0, 500.0, 1500.0, 3000.0):
        air_c, block_c = integrated([(0.0, 60.0), (400.0, -10.0)], time_s, block_lag_s)
        assert heat.air_c(time_s) == pytest.approx(air_c, abs=0.05)
        assert heat.block_c(time_s) == pytest.approx(block_c, abs=0.05)


def test_nothing_jumps_where_one_demand_follows_another() -> None:
    heat = Heat(0.0, 20.0, 750.0)
    heat.ramp_air(0.0, 60.0, RATE_C_S, LAG_S)
    heat.relax_air(700.0, 20.0, 3600.0)
    heat.ramp_air(900.0, 0.0, RATE_C_S, LAG_S)
    for time_s in (600.0, 700.0, 900.0, 1500.0):
        assert heat.air_c(time_s - 1e-6) == pytest.approx(heat.air_c(time_s), abs=1e-5)
        assert heat.block_c(time_s - 1e-6) == pytest.approx(heat.block_c(time_s), abs=1e-5)


def test_switched_off_the_air_drifts_to_the_room() -> None:
    world = a_world()
    world.set_chamber(63.0)
    world.switch_chamber_off()
    world.clock.sleep(world.settings.chamber_off_lag_s)
    assert world.chamber_c == pytest.approx(23.0 + 40.0 * math.exp(-1.0))


def test_a_disturbed_chamber_goes_out_of_band_and_comes_back() -> None:
    world = a_world()
    world.disturb_chamber(3.0)
    assert world.chamber_c == 23.0  # nobody holds it yet
    world.ramp_chamber(40.0)
    world.clock.sleep(3 * 3600.0)
    assert world.chamber_c == pytest.approx(43.0)
    world.disturb_chamber(0.0)
    world.clock.sleep(3600.0)
    assert world.chamber_c == pytest.approx(40.0)
