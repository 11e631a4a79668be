"""What every level with a wire must do: radians of two axes, one zero in both positions, nothing false."""

from __future__ import annotations

import math

import pytest

from bench.base.arrays import ARCSEC
from drivers.interfaces import BenchError, LevelSizes
from tests.support.instrument_stand import known, standing

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
