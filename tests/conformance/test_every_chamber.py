"""What every chamber with a controller must do: °C of the air, limits before the wire, proved, made safe."""

import math

import pytest

from bench.base.arrays import ARCSEC
from drivers.interfaces import BenchError, InstrumentRefused, LevelSizes, LimitExceeded
from tests.support.instrument_stand import Between, known, skip_if_own, standing, taking

chambers = pytest.mark.parametrize("device", known("chamber"), ids=lambda device: device.name)

HOUR_S = 3600.0


@chambers
@pytest.mark.parametrize("target_c", [40.0, -20.0])
def test_it_brings_the_air_to_the_temperature(device, tmp_path, target_c):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        stand.driver.set_temperature(target_c, "1/temperature")
        stand.world.clock.sleep(4 * HOUR_S)
        assert stand.world.chamber_c == pytest.approx(target_c, abs=0.1)
        assert stand.driver.temperature("2/read") == pytest.approx(stand.world.chamber_c, abs=0.1)


@chambers
def test_temperatures_outside_its_limits_are_refused_before_anything_is_sent(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        stand.sent.clear()
        for target_c in (stand.section.maximum + 1.0, stand.section.minimum - 1.0, math.nan):
            with pytest.raises(LimitExceeded):
                stand.driver.set_temperature(target_c, "1/temperature")
        assert stand.sent == []


@chambers
def test_a_demand_that_was_not_taken_is_noticed(device, tmp_path):
    with standing(device, tmp_path, taking("40", "41")) as stand:
        stand.driver.open()
        with pytest.raises(InstrumentRefused):
            stand.driver.set_temperature(40.0, "1/temperature")


@chambers
def test_air_outside_the_band_is_told_but_while_it_settles(device, tmp_path):
    with standing(device, tmp_path, band="0.5 K") as stand:
        stand.driver.open()
        stand.driver.set_temperature(60.0, "1/temperature")
        assert stand.driver.temperature("2/settle", settling=True) < 59.0
        with pytest.raises(BenchError, match="60"):
            stand.driver.temperature("3/read")
        stand.world.clock.sleep(4 * HOUR_S)
        assert stand.driver.temperature("4/read") == pytest.approx(60.0, abs=0.5)


@chambers
def test_it_is_made_safe(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        stand.driver.set_temperature(60.0, "1/temperature")
        stand.world.clock.sleep(4 * HOUR_S)
        assert stand.driver.make_safe() == ""
        stand.world.clock.sleep(48 * HOUR_S)
        assert stand.world.chamber_c == pytest.approx(23.0, abs=1.0)
        assert isinstance(stand.driver.temperature("2/read"), float)


@chambers
def test_a_controller_that_was_switched_off_never_shows_that_it_holds(device, tmp_path):
    with standing(device, tmp_path, band="0.5 K") as stand:
        stand.driver.open()
        stand.driver.set_temperature(60.0, "1/temperature")
        stand.world.clock.sleep(4 * HOUR_S)
        stand.dialect.power_cycle()
        stand.world.clock.sleep(12 * HOUR_S)
        with pytest.raises(BenchError):
            stand.driver.temperature("2/read")


# --- every thermometer ------------------------------------------------------------------------------
# What every thermometer with a wire must do: °C of the block, nothing from an open sensor, set up anew.

thermometers = pytest.mark.parametrize("device", known("thermometer"), ids=lambda device: device.name)


@thermometers
@pytest.mark.parametrize("target_c", [55.0, -20.0])
def test_it_tells_the_temperature_of_the_block_and_not_of_the_air(device, tmp_path, target_c):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        stand.world.set_chamber(target_c)
        stand.world.clock.sleep(600.0)
        block_c = stand.world.block_c
        assert abs(block_c - target_c) > 5.0
        assert stand.driver.block_c("1/read") == pytest.approx(block_c, abs=0.2)
        assert stand.driver.sensor


@thermometers
def test_one_that_was_switched_off_is_set_anew(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        before_c = stand.driver.block_c("1/read")
        stand.dialect.power_cycle()
        try:
            after_c = stand.driver.block_c("2/read")
        except BenchError:
            after_c = stand.driver.block_c("2/read@2")
        assert after_c == pytest.approx(before_c, abs=0.2)


@thermometers
def test_a_sensor_that_came_off_tells_nothing(device, tmp_path):
    came_off = False
    asked = []

    class Open(Between):
        def handle(self, message, interrupted):
            reply = super().handle(message, interrupted)
            if not message.upper().startswith((b"FETC", b"TEMP?")):
                return reply
            asked.append(message)
            return b"+9.90000000E+37" if came_off else reply

    with standing(device, tmp_path, Open) as stand:
        stand.driver.open()
        stand.driver.block_c("1/read")
        if not asked:
            skip_if_own(device, "its open sensor is not simulated")
        came_off = True
        with pytest.raises(BenchError) as refusal:
            stand.driver.block_c("2/read")
        assert refusal.value.remedy


# --- every level ------------------------------------------------------------------------------------
# What every level with a wire must do: radians of two axes, one zero in both positions, nothing false.

levels = pytest.mark.parametrize("device", known("level"), ids=lambda device: device.name)


def quiet(stand):
    """Take the noise of the level away, and level the platform."""
    object.__setattr__(stand.world.settings.level, "noise_rad", 0.0)
    stand.world.level_platform("1", 1)


def shown(stand, *, turned):
    stand.world.place_level(turned=turned)
    return stand.driver.inclination("1/level", turned=turned)


@levels
def test_half_a_turn_takes_its_zero_away(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        quiet(stand)
        first, second = shown(stand, turned=False), shown(stand, turned=True)
        tilt_rad, offset_rad = stand.world.stand_rad[:2]
        assert (first.along_rad - second.along_rad) / 2 == pytest.approx(tilt_rad, abs=0.3 * ARCSEC)
        assert (first.across_rad - second.across_rad) / 2 == pytest.approx(offset_rad, abs=0.3 * ARCSEC)
        level = stand.world.settings.level
        assert (first.along_rad + second.along_rad) / 2 == pytest.approx(
            level.zero_along_rad, abs=0.3 * ARCSEC
        )
        assert (first.across_rad + second.across_rad) / 2 == pytest.approx(
            level.zero_across_rad, abs=0.3 * ARCSEC
        )


@levels
def test_it_says_how_exact_it_is(device, tmp_path):
    with standing(device, tmp_path) as stand:
        sizes = stand.driver.sizes
        assert isinstance(sizes, LevelSizes)
        assert 0.0 < sizes.reading_rad < math.radians(0.1)
        assert 0.0 < sizes.scale < 0.5
        assert 0.0 < sizes.cross < 0.5


@levels
def test_a_platform_that_is_far_from_level_is_no_inclination(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        quiet(stand)
        stand.world.turn(math.radians(30.0), 1)
        with pytest.raises(BenchError) as refusal:
            shown(stand, turned=False)
        assert refusal.value.remedy


@levels
def test_one_that_was_switched_off_never_shows_a_false_inclination(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        quiet(stand)
        before = shown(stand, turned=False)
        stand.dialect.power_cycle()
        try:
            after = shown(stand, turned=False)
        except BenchError:
            return  # it is told: nothing is levelled by it
        assert after.along_rad == pytest.approx(before.along_rad, abs=0.3 * ARCSEC)
