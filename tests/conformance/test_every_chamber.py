"""What every chamber with a controller must do: °C of the air, limits before the wire, proved, made safe."""

from __future__ import annotations

import math

import pytest

from drivers.interfaces import BenchError, InstrumentRefused, LimitExceeded
from tests.support.instrument_stand import known, standing, taking

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
