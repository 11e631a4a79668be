"""What every thermometer with a wire must do: °C of the block, nothing from an open sensor, set up anew."""

from __future__ import annotations

import pytest

from drivers.interfaces import BenchError
from tests.support.instrument_stand import Between, known, standing

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
    class Open(Between):
        def handle(self, message, interrupted):
            reply = super().handle(message, interrupted)
            return b"+9.90000000E+37" if message.upper().startswith(b"FETC") else reply

    with standing(device, tmp_path, Open) as stand:
        stand.driver.open()
        with pytest.raises(BenchError) as refusal:
            stand.driver.block_c("1/read")
        assert refusal.value.remedy
