"""Instruments from elsewhere: folders, distributions, what is wrong with them, records without them."""

import json
import os
import shutil
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import foreign_drivers, load_bench, load_recorded_bench
from bench.config.devices.registry import _loaded, devices
from bench.config.shipped import find_bench
from bench.run.folder import Run
from drivers.facts import agilent_34401a
from drivers.interfaces import BenchError

METER = """
from typing import ClassVar, Literal
from types import ModuleType

from bench.config.devices.device import Device, WiredForm
from bench.config.devices.sections import HeadForm, OneChannelForm, ThermometerForm, VoltmeterForm
from drivers.facts import agilent_34401a as like_it


class Section(OneChannelForm):
    facts: ClassVar = like_it
    driver: Literal["NAME"]


DEVICE = Device(
    "NAME", Section, driver=".own_driver:Meter", simulation="sim.agilent_34401a:Agilent34401A",
    example={"channels": ["x"], "resource": "GPIB0::5::INSTR"}, simulated=("noise", "accuracy"),
)
"""
DRIVER = """
from drivers.instruments.agilent_34401a import Agilent34401A


class Meter(Agilent34401A):
    called = "my meter"
"""


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "mine"
    made.mkdir()
    (made / "my_meter.py").write_text(METER.replace("NAME", "my-meter"))
    (made / "own_driver.py").write_text(DRIVER)
    return made


@pytest.fixture
def mine(folder, monkeypatch):
    monkeypatch.setenv("BENCH_DEVICES", str(folder))
    return folder


def own_bench(tmp_path, driver="my-meter"):
    data = yaml.safe_load(find_bench("paper-stand").read_text(encoding="utf-8"))
    for number, meter in enumerate(data["instruments"]["voltmeters"]):
        meter |= {"driver": driver, "resource": f"GPIB0::{number}::INSTR"}
        meter.pop("interface", None)
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def test_without_it_the_driver_is_unknown(tmp_path):
    with pytest.raises(FileMistakes) as told:
        load_bench(own_bench(tmp_path))
    assert told.value.mistakes[0].text.startswith("expected agilent-34401a, ")
    assert (
        ", got 'my-meter'; for an instrument of your own, name its folder with --devices"
        in told.value.mistakes[0].text
    )


def test_a_folder_is_named_on_the_command_line_for_that_command_alone(bench, folder, tmp_path):
    path = own_bench(tmp_path)
    assert bench("check", "quick", "--bench", path, "--devices", folder)[0] == 0
    assert "BENCH_DEVICES" not in os.environ
    assert bench("check", "quick", "--bench", path)[0] == 2
    status, _, err = bench("check", "quick", "--devices", tmp_path / "nowhere")
    assert (status, "no such folder; create it or name another" in err) == (2, True)


def test_a_module_that_fails_is_one_sentence_and_stops_nobody_else(mine, bench, tmp_path):
    (mine / "broken.py").write_text("import no_such_thing\n")
    assert bench("check", "quick", "--bench", "paper-stand")[0] == 0
    assert load_bench(own_bench(tmp_path))
    with pytest.raises(FileMistakes) as told:
        load_bench(own_bench(tmp_path, "another"))
    (first, *_) = told.value.mistakes
    assert first.place == "instruments.voltmeters[1].driver"
    assert first.text.startswith("no driver 'another' is known, and ")
    assert (
        f"{mine / 'broken.py'} cannot be loaded (ModuleNotFoundError: No module named 'no_such_thing', broken.py:1)"
        in first.text
    )


def test_a_driver_that_cannot_be_loaded_is_told_of_its_instrument(mine, bench, tmp_path):
    (mine / "own_driver.py").write_text("Metre = None\n")
    status, _, err = bench("run", "quick", "--dry-run", "--bench", own_bench(tmp_path))
    assert status == 2
    assert "voltmeter.x: the driver .own_driver:Meter cannot be loaded (AttributeError" in err


def test_a_driver_that_fails_while_loading_is_told_with_its_line(mine, bench, tmp_path):
    (mine / "own_driver.py").write_text("import math\n\nMeter = math.no_such_thing\n")
    _, _, err = bench("run", "quick", "--dry-run", "--bench", own_bench(tmp_path))
    assert "module 'math' has no attribute 'no_such_thing', own_driver.py:3)" in err


def test_two_of_one_name_are_refused_with_both_places(mine, tmp_path):
    (mine / "second.py").write_text(METER.replace("NAME", "my-meter"))
    (mine / "third.py").write_text(METER.replace("NAME", "zaber"))
    with pytest.raises(FileMistakes) as told:
        load_bench(own_bench(tmp_path))
    text = told.value.mistakes[0].text
    assert str(mine / "my_meter.py") in text
    assert str(mine / "second.py") in text
    with pytest.raises(FileMistakes, match=r"'zaber' is in .*heads\.py and in .*third\.py; remove one"):
        load_bench(find_bench("bench-motorised"))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"NAME"', '"my-meter"', None),
        ('Literal["NAME"]', "str", "does not have driver: Literal['my-meter']"),
        ("facts: ClassVar = like_it", "facts: ClassVar = Literal",
         "lack READ_TERMINATION, WRITE_TERMINATION, RANGES_V"),
        ("class Section(OneChannelForm)", "class Section(VoltmeterForm)", "does not define inputs_used"),
        ("class Section(OneChannelForm)", "class Section(ThermometerForm, WiredForm)",
         "does not define tolerance_k"),
        ("class Section(OneChannelForm)", "class Section(HeadForm, WiredForm)",
         "has a wire, but does not subclass MotorisedHeadForm or ReadOutHeadForm"),
        ("DEVICE = Device(", "DEVICE = dict(name=", "its DEVICE is no bench.config.devices.device.Device"),
    ],
)  # fmt: skip
def test_a_declaration_that_does_not_hold_is_told(mine, old, new, text):
    source = METER.replace(old, new)
    if text and "dict" in new:
        source = source.replace('"NAME", Section, driver', '"NAME", section=Section, driver')
    (mine / "my_meter.py").write_text(source.replace("NAME", "my-meter"))
    assert [text in trouble for trouble in devices().troubles] == ([] if text is None else [True])


def test_the_facts_set_the_serial_port_even_if_the_section_has_no_key_for_it(mine, tmp_path):
    meter = load_bench(own_bench(tmp_path)).instruments.voltmeters[0]
    assert "serial" not in type(meter).model_fields
    assert meter.port().serial == agilent_34401a.SERIAL


def test_an_installed_distribution_brings_an_instrument(folder, tmp_path, monkeypatch):
    site = tmp_path / "site"
    shutil.copytree(folder, site / "my_bench_meters")
    (site / "my_bench_meters" / "__init__.py").touch()
    about = site / "my_bench_meters-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-bench-meters\nVersion: 1.2\n")
    (about / "entry_points.txt").write_text("[triaxial_bench.devices]\nmine = my_bench_meters.my_meter\n")
    monkeypatch.syspath_prepend(str(site))
    _loaded.cache_clear()
    try:
        assert devices().get("my-meter").class_of("driver").called == "my meter"
        bench = load_bench(own_bench(tmp_path))
        assert foreign_drivers(bench) == {"my-meter": "the distribution my-bench-meters 1.2"}
    finally:
        _loaded.cache_clear()
        for name in [n for n in sys.modules if n.startswith("my_bench_meters")]:
            del sys.modules[name]


@pytest.mark.slow
def test_a_recorded_run_is_evaluated_without_it_and_resuming_says_what_is_missing(
    mine, bench, tmp_path, monkeypatch
):
    monkeypatch.setattr("bench.results.page.render_report", lambda *_, **__: "")
    path = own_bench(tmp_path)
    assert bench("run", "quick", "--dry-run", "--bench", path, "--name", "done")[0] == 0
    assert Run(Path("runs/done")).manifest["devices"] == {"my-meter": str(mine / "my_meter.py")}
    with_it = json.loads(Path("runs/done/calibrate.json").read_text())["coefficients"]
    lines = Path("runs/done/events.jsonl").read_bytes().splitlines(keepends=True)
    monkeypatch.delenv("BENCH_DEVICES")
    for command in (
        ("calibrate", "done"),
        ("report", "done"),
        ("show", "done"),
        ("export", "done", "--csv", "readings.csv"),
        ("diagnose", "done"),
    ):
        status, _, err = bench(*command)
        assert status in (0, 1), (command, err)
        assert "unexpected" not in err, err
    assert json.loads(Path("runs/done/calibrate.json").read_text())["coefficients"] == with_it
    recorded = load_recorded_bench(Path("runs/done/bench.yaml"))
    assert [meter.name for meter in recorded.instruments.voltmeters] == [f"voltmeter.{c}" for c in "xyz"]
    with pytest.raises(BenchError, match="'my-meter' is missing, so the accuracy"):
        _ = recorded.instruments.voltmeters[0].kind
    Path("runs/done/events.jsonl").write_bytes(b"".join(lines[: len(lines) // 2]))
    status, _, err = bench("resume", "done")
    assert status == 2
    assert "the driver 'my-meter'" in err
    assert str(mine / "my_meter.py") in err
    assert bench("resume", "done", "--devices", mine)[0] == 0


@pytest.mark.slow
def test_the_commands_that_a_run_suggests_name_the_folder_of_devices(mine, bench, tmp_path, monkeypatch):
    monkeypatch.delenv("BENCH_DEVICES")
    monkeypatch.setattr("bench.results.page.render_report", lambda *_, **__: "")
    path = own_bench(tmp_path)
    with monkeypatch.context() as stop:
        stop.setattr("bench.services.conclusion._evaluated", Mock(side_effect=KeyboardInterrupt))
        stopped = bench("run", "quick", "--dry-run", "--bench", path, "--name", "done", "--devices", mine)
    assert stopped[0] == 2
    assert f"'bench resume done --devices {mine}' computes the results" in stopped[2]
    listed = bench("runs", "--json", "-")[1]
    assert json.loads(listed)["runs"][0]["to_go_on"] == f"bench resume done --devices {mine}"
    with monkeypatch.context() as searched:
        searched.setenv("BENCH_DEVICES", str(mine))
        assert json.loads(bench("runs", "--json", "-")[1])["runs"][0]["to_go_on"] == "bench resume done"
    ended = bench("resume", "done", "--devices", mine)[1].splitlines()[-1]
    assert f"--bench {path} --devices {mine}" in ended
