"""What every instrument there is must do, plug-ins too: is declared, proves who it is, survives a bad wire.

A user runs it for his own: `BENCH_DEVICES=DIR python -m pytest tests/conformance`.
"""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.devices.registry import devices
from bench.config.devices.sections import (
    ChamberTruth,
    HeadTruth,
    LevelTruth,
    SupplyTruth,
    ThermometerTruth,
    VoltmeterTruth,
)
from bench.model import ForwardModel
from bench.run.assembly.instruments import PROTOCOLS
from bench.run.assembly.served import served_bench
from bench.run.folder import Run
from drivers.interfaces import (
    BadReading,
    BenchError,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    SelfTesting,
)
from tests.support.instrument_stand import Mute, answering, bench_data, known, standing, written_bench
from tests.support.procedure_texts import HEAD

TRUTHS = {
    "voltmeter": VoltmeterTruth,
    "head": HeadTruth,
    "chamber": ChamberTruth,
    "level": LevelTruth,
    "thermometer": ThermometerTruth,
    "power_supply": SupplyTruth,
}
STEPS = """\
  - installation: {label: 1, steps: [turn: {angles: [0 deg, 90 deg]}]}
  - installation: {label: 1T180, steps: [turn: {angles: [0 deg, 90 deg]}]}
"""
"""They do not make a calibration together, so that none is made."""
SHORT, LONG = "0.05 s", "60 s"
"""Timeouts in real time: of one that never answers, and of one that always does, however slow the machine."""

every = pytest.mark.parametrize("device", known(wired=False), ids=lambda device: device.name)
wired = pytest.mark.parametrize("device", known(), ids=lambda device: device.name)


def test_all_devices_were_loaded():
    assert devices().troubles == []
    assert devices().doubled == {}
    assert {device.role for device in known(wired=False)} == set(PROTOCOLS)


@every
def test_its_declaration_holds(device, tmp_path):
    assert get_args(device.section.model_fields["driver"].annotation) == (device.name,)
    assert set(device.simulated) <= set(TRUTHS[device.role].model_fields)
    assert (device.simulation is None) == device.section.by_hand
    assert load_bench(written_bench(device, tmp_path))
    path = written_bench(device, tmp_path, colour="blue")
    with pytest.raises(FileMistakes, match=r"unknown key 'colour'; .*known: .*driver"):
        load_bench(path)


@pytest.mark.slow
@every
def test_a_bench_with_it_runs_dry(bench, tmp_path, device):
    path = written_bench(device, tmp_path)
    Path("p.yaml").write_text(HEAD + STEPS, encoding="utf-8")
    status, out, err = bench("run", "p.yaml", "--dry-run", "--bench", path, "--name", "run")
    assert (status, err) == (0, ""), out
    signal = Run(Path("runs/run")).readings().signal
    assert signal.shape == (4, 3)
    assert np.isfinite(signal).all()


@pytest.mark.slow
@wired
def test_the_simulation_is_served_and_looked_at_live(bench, tmp_path, device):
    # the driver's time is the real one: a mean of ten measurements would take it eleven seconds
    quick = {"averages": 1} if "averages" in device.section.model_fields else {}
    data = bench_data(device, **quick)
    file = load_bench(written_bench(device, tmp_path, **quick))
    with served_bench(
        file, ForwardModel(file.installation_models()), 1, speed=1e4, with_terminals=False
    ) as serving:
        places = {s["name"]: s["tcp"] for s in serving.instruments}
        for section, name in (
            *zip(
                data["instruments"]["voltmeters"], [m.name for m in file.instruments.voltmeters], strict=True
            ),
            *((data["instruments"][s.role], s.name) for s in file.instruments.all() if s.role != "voltmeter"),
        ):
            if name in places:
                host, _, port = places[name].rpartition(":")
                section["resource"] = f"TCPIP0::{host}::{port}::SOCKET"
        path = tmp_path / "live.yaml"
        path.write_text(yaml.safe_dump(data), encoding="utf-8")
        try:
            load_bench(path)
        except FileMistakes:
            pytest.skip("it cannot be reached over a socket")
        status, out, err = bench("instruments", "--bench", path, "--json", "-")
    assert (status, err) == (0, ""), out
    rows = [row for row in json.loads(out)["instruments"] if row["address"] != "by hand"]
    assert {row["name"] for row in rows} == set(places)
    assert all(row["identity"] and row["value"] is not None and not row["failures"] for row in rows)


@wired
def test_it_says_who_it_is_and_keeps_its_protocol(device, tmp_path):
    with standing(device, tmp_path) as stand:
        assert isinstance(stand.driver, PROTOCOLS[device.role])
        identity = stand.driver.open()
        assert isinstance(identity, Identity)
        assert identity.maker
        assert identity.model
        if isinstance(stand.driver, SelfTesting):
            assert stand.driver.self_test() == ""
        stand.driver.close()
        stand.driver.close()


@wired
@pytest.mark.parametrize("reply", [b"ACME,COFFEE-MAKER,0,1.0", b"42"])
def test_another_instrument_is_refused(device, tmp_path, reply):
    with standing(device, tmp_path, answering(reply), timeout=LONG) as stand:
        with pytest.raises((InstrumentRefused, BadReading)) as refusal:
            stand.driver.open()
        assert refusal.value.instrument == stand.driver.name
        assert any(part in refusal.value.cause for part in reply.decode().split(","))
        assert refusal.value.remedy
        stand.driver.close()


@wired
def test_one_that_is_silent_is_lost_and_never_hangs(device, tmp_path):
    with standing(device, tmp_path, Mute, timeout=SHORT) as stand:
        began_s = stand.world.clock.now_s()
        with pytest.raises(BenchError) as loss:
            stand.driver.open()
        assert isinstance(loss.value, InstrumentLost | InstrumentRefused)
        assert loss.value.instrument == stand.driver.name
        assert stand.world.clock.now_s() - began_s < 120.0
        stand.driver.close()


@pytest.mark.slow
@wired
def test_one_that_falls_silent_later_is_lost_and_let_go(device, tmp_path):
    silent = False

    class FallsSilent(Mute):
        def handle(self, message, interrupted):
            return None if silent else self._dialect.handle(message, interrupted)

    with standing(device, tmp_path, FallsSilent, timeout=LONG) as stand:
        stand.driver.open()
        silent = True
        driver = stand.driver
        ask = {
            "voltmeter": lambda: driver.configure(stand.settings()),
            "head": lambda: driver.move(0.5, 1, "1/turn"),
            "chamber": lambda: driver.temperature("1/read"),
            "thermometer": lambda: driver.block_c("1/read"),
            "level": lambda: driver.inclination("1/level", turned=False),
            "power_supply": lambda: driver.state("1/read"),
        }
        with stand.expecting_nothing():
            with pytest.raises(BenchError):
                ask[device.role]()
            driver.close()
