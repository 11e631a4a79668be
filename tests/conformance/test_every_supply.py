"""What every power supply with a wire must do: limits first, all is proved, nothing on is changed, off is off."""

from dataclasses import replace

import pytest

from drivers.interfaces import (
    BenchError,
    InstrumentRefused,
    LimitExceeded,
    OutputSettings,
    PowerSupply,
    SetOtherwise,
)
from tests.support.instrument_stand import known, standing, taking

supplies = pytest.mark.parametrize("device", known("power_supply"), ids=lambda device: device.name)

VOLTS, LIMIT_A = 5.0, 4.0


def wanted(stand) -> dict[str, OutputSettings]:
    """Return 5 V for the first output that can, protected at 5.5 V where it has a protection."""
    for name, limits in stand.section.limits.outputs.items():
        if limits.voltage_v[1] >= VOLTS:
            return {name: OutputSettings(VOLTS, LIMIT_A, 5.5 if limits.over_voltage_v else None)}
    raise AssertionError("no output gives 5 V")


@supplies
def test_it_is_set_up_switched_on_read_and_switched_off(device, tmp_path):
    with standing(device, tmp_path) as stand:
        driver: PowerSupply = stand.driver
        driver.open()
        settings = wanted(stand)
        (output,) = settings
        assert set(driver.state("1")) == set(driver.outputs) == set(stand.section.limits.outputs)
        driver.set_up(settings, "2/supply")
        state = driver.state("3")[output]
        assert (state.on, state.voltage_v, state.current_a) == (False, 0.0, 0.0)
        assert state.settings.voltage_v == pytest.approx(VOLTS)
        assert state.settings.current_limit_a == pytest.approx(LIMIT_A)
        driver.switch(output, True, "4/on")
        state = driver.state("5")[output]
        assert (state.on, state.tripped, state.limiting) == (True, False, False)
        assert state.voltage_v == pytest.approx(VOLTS, abs=0.01)
        assert stand.world.power.stage(output, stand.world.clock.now_s()).on
        driver.switch(output, False, "6/off")
        assert not driver.state("7")[output].on
        driver.switch(output, True, "8/on")
        assert driver.switch_all_off() == ""
        assert not any(s.on for s in driver.state("9").values())


@supplies
def test_limits_come_before_the_wire(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        ((output, good),) = wanted(stand).items()
        limits = stand.section.limits.outputs[output]
        beyond = [
            {output: replace(good, voltage_v=limits.voltage_v[1] + 0.1)},
            {output: replace(good, voltage_v=float("nan"))},
            {output: replace(good, current_limit_a=limits.current_a[1] + 0.1)},
            {output: replace(good, over_voltage_v=1000.0)},
            {"nowhere": good},
        ]
        stand.sent.clear()
        for settings in beyond:
            with pytest.raises(LimitExceeded):
                stand.driver.set_up(settings, "1/supply")
        assert stand.sent == []


@supplies
@pytest.mark.parametrize(("number", "instead"), [("5", "6"), ("4", "3")])
def test_a_setting_that_was_not_taken_is_noticed(device, tmp_path, number, instead):
    with standing(device, tmp_path, taking(number, instead)) as stand:
        stand.driver.open()
        ((output, settings),) = wanted(stand).items()
        settings = replace(settings, over_voltage_v=settings.over_voltage_v and 6.5)
        with pytest.raises(InstrumentRefused):
            stand.driver.set_up({output: settings}, "1/supply")
        with pytest.raises(InstrumentRefused, match="not set up"):
            stand.driver.switch(output, True, "2/on")
        assert not stand.driver.state("3")[output].on


@supplies
def test_one_found_on_and_set_otherwise_is_left_as_it_is(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        settings = wanted(stand)
        ((output, good),) = settings.items()
        stand.driver.set_up(settings, "1/supply")
        stand.driver.switch(output, True, "2/on")
        before = stand.driver.state("3")
        stand.driver.set_up(settings, "4/supply")
        with pytest.raises(SetOtherwise, match=f"{VOLTS:g} V"):
            stand.driver.set_up({output: replace(good, voltage_v=4.0)}, "5/supply")
        assert stand.driver.state("6") == before


@supplies
def test_nothing_is_switched_on_that_is_not_set_as_it_was_set_up(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        (output,) = settings = wanted(stand)
        stand.driver.set_up(settings, "1/supply")
        stand.world.power.change(output, stand.world.clock.now_s(), set_v=1.25)
        with pytest.raises(InstrumentRefused, match=r"1\.25"):
            stand.driver.switch(output, True, "2/on")
        assert not stand.driver.state("3")[output].on


@supplies
def test_one_switched_off_by_hand_or_by_its_mains_shows_it(device, tmp_path):
    with standing(device, tmp_path) as stand:
        driver, now_s = stand.driver, stand.world.clock.now_s
        driver.open()
        (output,) = settings = wanted(stand)

        def by_hand():
            for name in driver.outputs:
                stand.world.power.change(name, now_s(), on=False)

        for off in (by_hand, stand.dialect.power_cycle):
            driver.set_up(settings, "1/supply")
            driver.switch(output, True, "2/on")
            off()
            assert not driver.state("3")[output].on


@supplies
def test_a_trip_is_told_and_keeps_it_from_being_switched_on(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        ((output, good),) = wanted(stand).items()
        if good.over_voltage_v is None:
            pytest.skip("it has no protection")
        stand.driver.set_up({output: good}, "1/supply")
        stand.driver.switch(output, True, "2/on")
        stand.world.power.change(output, stand.world.clock.now_s(), offset_v=2.0)
        state = stand.driver.state("3")[output]
        assert (state.on, state.tripped) == (False, True)
        assert stand.driver.state("4")[output].tripped
        with pytest.raises(InstrumentRefused, match="protection"):
            stand.driver.set_up({output: good}, "5/supply")
        with pytest.raises(BenchError):
            stand.driver.switch(output, True, "6/on")
