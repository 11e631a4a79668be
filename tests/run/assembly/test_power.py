"""A bench file's supply and rails on the simulated bench: the driver switches, the block lives or is dead."""

import pytest
import yaml

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.instruments import power_of
from bench.run.assembly.served import dry_bench
from drivers.interfaces import OutputSettings
from tests.support.fed_bench import write_fed

SETTINGS = {"P25V": OutputSettings(15.0, 0.15), "N25V": OutputSettings(-15.0, 0.15)}


def fed_file(folder, supply):
    path = write_fed(folder)
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["instruments"]["power_supply"] = supply
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return load_bench(path)


def test_a_bench_that_says_nothing_of_a_supply_feeds_its_block_always():
    assert power_of(load_bench(find_bench("paper-stand"))).rails == ()


def test_the_rails_of_the_block_hang_on_the_outputs(tmp_path):
    settings = power_of(fed_file(tmp_path, {"driver": "keysight-e3631a", "resource": "GPIB0::5::INSTR"}))
    plus, minus = settings.rails
    assert (plus.output, plus.nominal_v, plus.current_a) == ("P25V", 15.0, pytest.approx(0.07))
    assert (minus.working_v, minus.absolute_v, minus.absolute_a) == (
        (-18.0, -12.0),
        (-18.0, 0.5),
        0.2,
    )


def test_the_driver_brings_the_block_to_life(tmp_path):
    for resource, interface in (
        ("prologix://192.0.2.10/5", "gpib"),
        ("ASRL/dev/ttyUSB5::INSTR", "rs232"),
    ):
        section = {"driver": "keysight-e3631a", "resource": resource, "interface": interface}
        file = fed_file(tmp_path, section)
        with dry_bench(file, ForwardModel(file.installation_models()), 1) as assembly:
            supply, world = assembly.instruments.power_supply, assembly.simulated.world
            supply.open()
            assert not world.power.feeds_block(assembly.clock.now_s())
            supply.set_up(SETTINGS, "1/supply")
            supply.switch("P25V", True, "2/on")
            assembly.clock.sleep(5.0)
            states = supply.state("3")
            assert {output for output, state in states.items() if state.on} == {"P6V", "P25V", "N25V"}
            assert states["N25V"].voltage_v < -14.9
            assert 0.06 < states["N25V"].current_a < 0.08
            assert max(abs(world.signal_v(channel)) for channel in "xyz") > 0.5
            assert supply.switch_all_off() == ""
            assert not world.power.feeds_block(assembly.clock.now_s())
            assert world.power.violations == []
            supply.close()
