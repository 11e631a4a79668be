"""The composition root: every driver meets its simulation on a wire, in one world; the supply feeds the block."""

import inspect
import json
import math
import os
import socket

import numpy as np
import pytest
import yaml

from bench.config.bench_file.file import load_bench
from bench.config.devices.chambers import EspecSection, ThermotronSection, WatlowF4TSection
from bench.config.devices.device import bus_place
from bench.config.devices.heads import AcutrolSection, ZaberSection
from bench.config.devices.voltmeters import Keysight34970ASection
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.instruments import on_terminals, power_of
from bench.run.assembly.served import dry_bench, served_bench
from drivers.instruments.acutrol import AcutrolHead
from drivers.instruments.espec import EspecChamber
from drivers.instruments.keysight_34970a import Keysight34970A
from drivers.instruments.thermotron import ThermotronChamber
from drivers.instruments.watlow_f4t import WatlowF4TChamber
from drivers.instruments.zaber import ZaberHead
from drivers.interfaces import InstrumentRefused, LimitExceeded, OutputSettings
from drivers.motion import Travel
from drivers.person import Prompt, PromptKind
from drivers.wire.prologix import parse
from drivers.wire.pyvisa_connection import WireError
from sim.wires.server import TERMINALS
from tests.support.composed_bench import composing, edited, read
from tests.support.fed_bench import write_fed
from tests.support.patience import PATIENCE_S

RIGHT_ANGLE_RAD = math.pi / 2


@pytest.fixture
def composed(tmp_path):
    with composing(tmp_path) as compose:
        yield compose


# --- sections -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "driver", "names"),
    [
        (Keysight34970ASection, Keysight34970A, {"channel_delay": "channel_delay_s"}),
        (ZaberSection, Travel, {"backoff": "backoff_rad", "settle": "settle_s"}),
        (
            ZaberSection,
            ZaberHead,
            {n: n for n in ("resolution", "device", "axis", "identity", "allow_homing", "checksums")},
        ),
        (AcutrolSection, AcutrolHead, {"axis": "axis", "still_rate": "still_rad_s"}),
        (EspecSection, EspecChamber, {"identity": "identity"}),
        (
            WatlowF4TSection,
            WatlowF4TChamber,
            {"identity": "identity", "loop": "loop", "output": "output", "safe": "safe_c"},
        ),
        (ThermotronSection, ThermotronChamber, {"identity": "identity"}),
    ],
)
def test_what_a_section_leaves_out_is_as_its_driver_has_it(section, driver, names):
    parameters = inspect.signature(driver).parameters
    for ours, theirs in names.items():
        assert section.model_fields[ours].default == pytest.approx(parameters[theirs].default), ours


@pytest.mark.parametrize(
    "resource",
    [
        "prologix://192.0.2.10:1234/22",
        "prologix://192.0.2.10/0",
        "prologix:///dev/ttyUSB0/30",
        "prologix://COM3/22",
        "prologix://192.0.2.10/31",
        "prologix://192.0.2.10",
        "prologix:/192.0.2.10/22",
        "GPIB0::22::INSTR",
    ],
)
def test_places_behind_an_adapter_are_those_that_the_driver_understands(resource):
    try:
        _, address = parse(resource)
    except WireError:
        assert bus_place(resource) is None
    else:
        assert bus_place(resource).address == address


# --- drivers and simulations ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "identities"),
    [
        ("bench-rs232", (("parity: none", "parity: even"),), ["34401A"] * 3),
        (
            "bench-multiplexer",
            (("interface: gpib", "interface: lan"), ("x: 101, y: 102", "x: 301, y: 220")),
            ["34972A"],
        ),
        (
            "bench-multiplexer",
            (
                ('"GPIB0::9::INSTR"', '"ASRL/dev/ttyUSB0::INSTR"'),
                ("interface: gpib", "interface: rs232\n      serial: {baud_rate: 115200}"),
            ),
            ["34970A"],
        ),
        (
            "bench-multiplexer",
            (('"GPIB0::9::INSTR"', '"prologix:///dev/ttyUSB0/9"'),),
            ["34970A"],
        ),
        (
            "bench-motorised",
            (
                ("device: 1\n    axis: 1\n", "device: 2\n    axis: 3\n    identity: '50081'\n"),
                ("resolution: 64", "resolution: 128\n    checksums: yes"),
                ("driver: espec\n", "driver: espec\n    identity: SCP-220\n"),
                ("minimum: -40 degC\n    maximum: 85", "minimum: -75 degC\n    maximum: 180"),
            ),
            [*["34461A"] * 3, "50081", "SCP-220"],
        ),
        (
            "bench-rate-table",
            (("loop: 1\n    output: 1", "loop: 2\n    output: 4"), ("axis: 1", "axis: 2")),
            [*["34461A"] * 3, "ACUTROL", "F4T"],
        ),
    ],
)
def test_drivers_meet_their_simulations_otherwise_set_up_than_shipped(composed, name, changes, identities):
    bench, assembly = composed(name, *changes)
    told = {name: str(identity) for name, identity in assembly.instruments.open().items()}
    wired = [text for text in told.values() if not text.startswith("manual")]
    assert [part for part, text in zip(identities, wired, strict=True) if part not in text.split()] == []
    before = read(assembly.instruments)
    head = bench.instruments.head
    position = assembly.instruments.head.move(RIGHT_ANGLE_RAD, 1, "1/turn")
    assert abs(position.angle_rad - RIGHT_ANGLE_RAD) <= head.tolerance
    turned = np.abs(read(assembly.instruments) - before)
    assert turned[0] > 2.0  # x and z are turned by the head, y lies along the shaft
    assert turned[1] < 0.1
    assert turned[2] > 2.0
    chamber = assembly.instruments.chamber
    if chamber is not None:
        chamber.set_temperature(60.0, "2/temperature")
        assembly.clock.sleep(4 * 3600.0)
        assert chamber.temperature("3/read") == pytest.approx(60.0, abs=0.3)


def test_a_motorised_head_asks_nobody(composed):
    _, assembly = composed("bench-motorised")
    assembly.instruments.open()
    asked = []
    assembly.person.ask = asked.append
    for angle_rad, direction in ((0.3, 1), (0.0, -1)):
        assert assembly.instruments.head.move(angle_rad, direction, "1/turn").direction == direction
    with pytest.raises(LimitExceeded, match=r"outside its limits, -5°00′00″ to 365°00′00″"):
        assembly.instruments.head.move(math.radians(366.0), 1, "2/turn")
    assert asked == []


def test_a_stage_that_is_not_homed_is_homed_where_that_is_allowed(composed):
    not_homed = ("homed: yes", "homed: no")
    _, assembly = composed("bench-motorised", not_homed)
    assembly.instruments.open()
    with pytest.raises(InstrumentRefused, match="was not homed since it was switched on"):
        assembly.instruments.head.move(1.0, 1, "1/turn")
    _, assembly = composed("bench-motorised", not_homed, ("allow_homing: no", "allow_homing: yes"))
    assembly.instruments.open()
    assert assembly.instruments.head.move(1.0, 1, "1/turn").angle_rad == pytest.approx(1.0, abs=1e-4)


def test_a_chamber_takes_the_time_that_the_bench_file_says(composed):
    slow = ("{rate: 4 K/min, lag: 2 min, off_lag: 1 h, sensor_noise: 0.05 K}", "{rate: 1 K/min, lag: 10 s}")
    _, assembly = composed("bench-motorised", slow)
    assembly.instruments.open()
    chamber = assembly.instruments.chamber
    chamber.set_temperature(63.0, "1/temperature")
    assembly.clock.sleep(20 * 60.0)
    assert chamber.temperature("2/read") == pytest.approx(43.0, abs=0.3)


def test_serial_ports_with_eight_data_bits_are_pseudo_terminals(tmp_path):
    assert on_terminals(load_bench(find_bench("bench-rs232"))) == (
        "voltmeter.x",
        "voltmeter.y",
        "voltmeter.z",
    )
    assert on_terminals(edited(tmp_path, "bench-rs232", ("parity: none", "parity: odd"))) == ()
    assert on_terminals(load_bench(find_bench("bench-motorised"))) == ("head",)
    assert on_terminals(load_bench(find_bench("bench-gpib"))) == ()


@pytest.mark.skipif(not TERMINALS, reason="this system has no pseudo-terminals")
def test_a_dry_run_over_serial_ports_goes_over_them(composed, monkeypatch):
    opened = []
    real_open = os.openpty
    monkeypatch.setattr(os, "openpty", lambda: opened.append(1) or real_open())
    _, assembly = composed("bench-rs232")
    assembly.instruments.open()
    assert len(opened) == 3
    monkeypatch.setattr("bench.run.assembly.served.TERMINALS", False)  # as on Windows
    _, assembly = composed("bench-rs232")
    assembly.instruments.open()
    assert len(opened) == 3


# --- inputs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["bench-gpib", "bench-prologix", "bench-multiplexer"])
def test_the_operator_shorts_and_feeds_all_inputs(composed, name):
    _, assembly = composed(name)
    assembly.instruments.open()

    def switch(source, reference_v=None):
        action = {"do": "select_input", "source": source, "reference_v": reference_v}
        prompt = Prompt(f"1/input#{source}", PromptKind.CONFIRM, "Switch", default="yes", action=action)
        assert assembly.person.ask(prompt).text == "yes"

    signals = read(assembly.instruments)
    assert np.abs(signals).max() > 2.0
    # ΔU_M is at most 0.3 mV at each reading; the noise at 1 PLC is some 10 µV.
    switch("short")
    assert np.abs(read(assembly.instruments)).max() < 4e-4
    switch("reference", -2.5)
    assert np.abs(read(assembly.instruments) + 2.5).max() < 4e-4
    switch("signal")
    assert np.abs(read(assembly.instruments) - signals).max() < 8e-4


def test_shorted_and_reference_readings_stand_in_the_record(bench, tmp_path):
    procedure = """\
procedure: p
reading: {samples: 3, nplc: 10, settle: 1 s}
steps:
  - installation:
      label: 1
      steps:
        - input: {source: short}
        - input: {source: reference, voltage: 2 V}
        - turn: {angles: [90 deg]}
"""
    (tmp_path / "p.yaml").write_text(procedure)
    status, _, err = bench("run", "p.yaml", "--dry-run", "--bench", "bench-prologix", "--name", "run")
    assert (status, err) == (0, "")
    bench("export", "run", "--csv", "readings.csv")
    header, *rows = (line.split(",") for line in (tmp_path / "readings.csv").read_text().splitlines())
    told = [dict(zip(header, row, strict=True)) for row in rows]
    assert [row["installation"] for row in told] == ["S", "R", "1"]
    for row, volts in zip(told, (0.0, 2.0), strict=False):
        assert [float(row[f"u{c}_v"]) for c in "xyz"] == pytest.approx([volts] * 3, abs=4e-4)
        assert row["angle_deg"] == ""
    assert abs(float(told[2]["ux_v"])) > 2.0


# --- served to other programs -----------------------------------------------------------------------


def ask(address, *lines):
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as connection:
        connection.sendall("".join(f"{line}\n" for line in lines).encode())
        with connection.makefile("r", encoding="utf-8") as replies:
            return replies.readline().strip()


def test_an_adapter_is_served_with_its_meters_and_where_they_are():
    bench = load_bench(find_bench("bench-prologix"))
    model = ForwardModel(bench.installation_models())
    with served_bench(bench, model, 1, speed=1e4, with_terminals=False) as serving:
        told = {served["name"]: served for served in serving.instruments}
        assert list(told) == ["adapter", "voltmeter.x", "voltmeter.y", "voltmeter.z"]
        assert {served["tcp"] for served in told.values()} == {told["adapter"]["tcp"]}
        assert [told[f"voltmeter.{c}"]["gpib"] for c in "xyz"] == ["22", "23", "24"]
        assert "gpib" not in told["adapter"]
        reply = ask(told["adapter"]["tcp"], "++auto 0", "++addr 23", "*IDN?", "++read eoi")
        assert reply == "HEWLETT-PACKARD,34401A,0,11-5-2"
        state = json.loads(ask(serving.control, "power-cycle voltmeter.y"))
        assert state["ok"]
        assert ask(told["adapter"]["tcp"], "++auto 0", "++addr 23", "*ESR?", "++read eoi") == "+128"


def test_head_and_chamber_are_served_on_the_same_world():
    bench = load_bench(find_bench("bench-rate-table"))
    model = ForwardModel(bench.installation_models())
    with served_bench(bench, model, 1, speed=1e4, with_terminals=False) as serving:
        told = {served["name"]: served["tcp"] for served in serving.instruments}
        assert list(told) == ["voltmeter.x", "voltmeter.y", "voltmeter.z", "head", "chamber"]
        json.loads(ask(serving.control, "turn 30 deg"))
        assert ask(told["head"], ":r:p 1").split(">")[1].strip() == "30.000000"
        json.loads(ask(serving.control, "chamber 50 degC"))
        assert ask(told["chamber"], ":SOURCE:CLOOP1:PVALUE?") == "50.00"


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
