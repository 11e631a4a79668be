"""Bench files: the section of each driver, faults of the simulation, what the check of a plan must know."""

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.devices.registry import devices
from bench.config.shipped import find_bench
from bench.run.assembly.instruments import on_terminals
from tests.support.instrument_stand import written_bench


@pytest.fixture
def shipped_text():
    return lambda name: find_bench(name).read_text(encoding="utf-8")


def listings():
    """How the drivers there are stand in a sentence: one more in the tree stands in it, too."""
    *voltmeters, last = (device.name for device in devices().of("voltmeter"))
    return {
        "voltmeters": f"{', '.join(voltmeters)} or {last}",
        "simulated_heads": " or ".join(d.name for d in devices().of("head") if d.simulated),
        "simulated_chambers": " or ".join(d.name for d in devices().of("chamber") if d.simulated),
    }


@pytest.mark.parametrize(
    ("bench", "old", "new", "line", "text"),
    [
        (
            "bench-lan",
            "driver: keysight-34461a, channels: [y]",
            "driver: keysight-34416a, channels: [y]",
            "channels: [y]",
            "instruments.voltmeters[2].driver: expected {voltmeters}, got 'keysight-34416a'; did you mean "
            "'keysight-34461a'?",
        ),
        ("bench-motorised", "    driver: zaber\n", "", "  head:", "instruments.head: 'driver' is missing"),
        (
            "bench-motorised",
            "tolerance: 5 arcsec ",
            "tolerence: 5 arcsec ",
            "tolerance: 5 arcsec ",
            "unknown key 'tolerence'; did you mean 'tolerance'? known: allow_homing, axis, backoff, "
            "certificate, checksums, device, driver, identity, maximum, minimum, name, resolution, resource, "
            "serial, settle, speed, steps_per_degree, timeout, tolerance",
        ),
        ("bench-lan", "channels: [x], ", "channels: [x], serial: {baud_rate: 9600}, ", "channels: [x], ",
         "instruments.voltmeters[1].serial: unknown key 'serial'"),
        ("bench-rs232", '/dev/ttyUSB2::INSTR"\n      interface: rs232\n      serial: {baud_rate: 9600',
         '/dev/ttyUSB2::INSTR"\n      interface: rs232\n      serial: {baud_rate: 115200', "",
         "voltmeters[3].serial: baud_rate: expected one of 300, 600, 1200, 2400, 4800, 9600, got '115200'"),
        ("bench-multiplexer", "x: 101, y: 102", "x: 121, y: 102", "inputs:",
         "a 34901A has no channel 121; choose from 101 to 120, 201 to 220, 301 to 320"),
        ("bench-multiplexer", "y: 102", "y: 101", "inputs:", "two signals share one channel"),
        ("bench-multiplexer", ", z: 103", "", "voltmeters:", "no voltmeter reads channel z"),
        ("bench-multiplexer", "channel_delay: 0.1 s", "channel_delay: 61 s", "channel_delay:",
         "state a channel delay of 0 to 60 s in steps of 1 ms, not 61 s"),
        ("bench-prologix", '192.0.2.10/23"', '192.0.2.10:1234/22"', "channels: [y]",
         "voltmeters[2].resource: 'prologix://192.0.2.10:1234/22' is voltmeter 1 already"),
        ("bench-prologix", '192.0.2.10/23"', '192.0.2.10/31"', "channels: [y]",
         "expected a VISA resource such as 'GPIB0::22::INSTR'"),
        ("bench-motorised", 'ASRL/dev/ttyUSB0::INSTR"  ', 'GPIB0::5::INSTR"  ', 'resource: "ASRL/dev/ttyUSB0',
         "head.resource: expected a VISA resource such as 'ASRL/dev/ttyUSB0::INSTR' or 'TCPIP0"),
        ("bench-motorised", "192.0.2.50::10001", "192.0.2.24::5025", "192.0.2.50",
         "chamber.resource: 'TCPIP0::192.0.2.24::5025::SOCKET' is voltmeter 3 already"),
        ("bench-motorised", "speed: 10 deg/s", "speed: 10 deg", "speed:",
         "a speed of turning such as '10 deg/s'"),
        ("bench-motorised", "speed: 10 deg/s", "speed: 0 deg/s", "speed:", "state a value above 0"),
        ("bench-motorised", "maximum: 365 deg\n", "maximum: -4 deg\n", "  head:",
         "between the minimum -5° and the maximum -4° no angle can be approached from both sides"),
        ("bench-motorised", "backoff: 1 deg", "backoff: 4 arcsec", "  head:",
         "the back-off is not above the tolerance"),
        ("bench-motorised", "steps_per_degree: 4266.6667", "steps_per_degree: 10", "  head:",
         "a step of the head is coarser than its tolerance"),
        ("bench-motorised", "steps_per_degree: 4266.6667", "steps_per_degree: 1e7", "  head:",
         "exceed the controller's range of steps"),
        ("bench-motorised", "    axis: 1\n", "    axis: 1\n    identity: (\n", "",
         "head.identity: expected a pattern (a regular expression), got '('"),
        ("bench-rate-table", "tolerance: 5 arcsec ", "tolerance: 1 arcsec ", "tolerance: 5 arcsec",
         "rounds a demand by up to 0.0005° (1.8 arcsec)"),
        ("bench-rate-table", "    output: 1\n    safe: 23 degC\n", "    safe: 90 degC\n", "  chamber:",
         "the safe setting of 90 °C is outside the chamber's -40 to 85 °C"),
        ("bench-gpib", "safe: 23 degC", "safe: 99 degC", "  chamber:", "the safe setting of 99 °C is outside"),
        ("bench-motorised", "    driver: espec\n", "    driver: espec\n    name: head\n", "instruments:\n",
         "two instruments are called 'head'"),
        ("bench-motorised", "rate: 4 K/min", "rate: 0 K/min", "rate: 4 K/min",
         "every chamber takes time"),
        ("bench-rate-table", "verification:\n", "simulation: {chamber: {sensor_noise: 0.1 K}}\nverification:\n",
         "verification:\n", "the simulated watlow-f4t has a sensor without noise"),
        ("bench-rate-table", "verification:\n", "simulation: {head: {homed: no}}\nverification:\n",
         "verification:\n",
         "only a head of the driver {simulated_heads} has this, and this bench has acutrol; leave it out"),
        ("bench-lan", "verification:\n", "simulation: {chamber: {lag: 1 min}}\nverification:\n",
         "verification:\n",
         "only a chamber of the driver {simulated_chambers} has this, and this bench has none"),
    ],
)  # fmt: skip
def test_each_mistake_in_a_drivers_section_is_one_sentence(
    mistakes, shipped_text, bench, old, new, line, text
):
    before = shipped_text(bench)
    assert before.count(old) == 1
    for listed, names in listings().items():
        text = text.replace(f"{{{listed}}}", names)
    told = mistakes(before.replace(old, new))
    assert len(told) == 1, told
    assert text in told[0]
    if line:
        number = before[: before.index(line)].count("\n") + 1
        assert told[0].startswith(f"{number} "), told


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("{fault: cutt, at: 1}", "got 'cutt'; did you mean 'cut'?"),
        ("{fault: cut, at: 0}", "expected 1 or more, got '0'"),
        ("{fault: hang, at: 1, error: -113}", "'hang' puts no error into the queue"),
        ("{fault: cut, at: 1, instrument: voltmeter.q}", "unknown instrument 'voltmeter.q'; did you mean"),
        ("{fault: drop, at: 1, instrument: head}", "unknown instrument 'head'; known: voltmeter.x"),
    ],
)
def test_each_mistake_in_a_fault_is_one_sentence(mistakes, shipped_text, fault, text):
    paper_text = shipped_text("paper-stand")
    line = paper_text.count("\n") + 1
    (told,) = mistakes(f"{paper_text}  faults: [{fault}]\n")
    assert text in told
    assert told.startswith(f"{line} simulation.faults[1]")


def test_what_the_check_of_a_plan_needs_to_know(tmp_path, shipped_text):
    degree = math.pi / 180.0
    motorised = load_bench(find_bench("bench-motorised"))
    assert motorised.head_limits_rad == pytest.approx((-5 * degree, 365 * degree))
    assert motorised.head_backoff_rad == pytest.approx(degree)
    assert motorised.most_samples == 10_000
    by_hand = load_bench(find_bench("bench-lan"))
    assert (by_hand.head_limits_rad, by_hand.head_backoff_rad) == (None, 0.0)
    multiplexer = load_bench(find_bench("bench-multiplexer"))
    assert multiplexer.most_samples == 16_666
    assert multiplexer.nplc_supported == (0.02, 0.2, 1.0, 2.0, 10.0, 20.0, 100.0, 200.0)
    assert multiplexer.instruments.voltmeters[0].name == "voltmeter.xyz"
    path = tmp_path / "b.yaml"
    third = "- {driver: keysight-34970a, inputs: {z: 201}, resource: 'GPIB0::9::INSTR'}"
    lines = shipped_text("bench-lan").splitlines()
    path.write_text("\n".join(f"    {third}" if "channels: [z]" in line else line for line in lines))
    mixed = load_bench(path)
    assert mixed.nplc_supported == (0.02, 0.2, 1.0, 10.0, 100.0)
    assert mixed.most_samples == 10_000


def test_signals_of_a_multiplexer_stand_in_the_order_of_its_scan(tmp_path, shipped_text):
    path = tmp_path / "b.yaml"
    path.write_text(
        shipped_text("bench-multiplexer").replace("x: 101, y: 102, z: 103", "x: 203, y: 102, z: 201")
    )
    (meter,) = load_bench(path).instruments.voltmeters
    assert meter.channels == ("y", "z", "x")
    assert meter.name == "voltmeter.yzx"


BENCH = find_bench("bench-encoder")


def section(tmp_path, name, **changes):
    return load_bench(written_bench(devices().get(name), tmp_path, **changes)).instruments.head


def test_the_shipped_bench_is_read_hands_free():
    head = load_bench(BENCH).instruments.head
    assert (head.driver, head.model, head.hands_free, head.typed) == (
        "heidenhain-nd28x", "ND-287", True, False,
    )  # fmt: skip
    assert head.turned_by_hand
    assert not head.by_hand


def test_with_seven_bits_no_pseudo_terminal_stands_for_its_port():
    assert "head" not in on_terminals(load_bench(BENCH))


@pytest.mark.parametrize(
    ("name", "changes", "why"),
    [
        ("heidenhain-nd28x", {"hands_free": "yes", "typed": "yes"}, "typing needs a hand"),
        ("heidenhain-nd28x", {"backoff": "30 arcsec"}, "the back-off is not above the tolerance"),
        ("heidenhain-nd28x", {"settle": "0 s"}, "'settle' is 0 s"),
        ("heidenhain-nd28x", {"rest": "0 arcsec"}, "no encoder stands still"),
        ("heidenhain-nd28x", {"model": "ND-780"}, "ND-281B"),
        ("mitutoyo-mux10", {"channel": 5}, "channel"),
        ("encoder-line", {"pattern": r"POS=([+-]\d+)"}, "must have exactly one named group, 'angle'"),
        ("encoder-line", {"pattern": r"POS=(?P<angle>[+-]\d+"}, "expected a pattern"),
        ("encoder-line", {"example": "POS=45"}, "does not match the example"),
        (
            "encoder-line",
            {"pattern": "(?P<angle>.*)", "example": "POS=45", "errors": {}},
            "correct the pattern: the angle in the example is not a number, but 'POS=45'",
        ),
        ("encoder-line", {"errors": {"POS=+999.99999": "none"}}, r"matches the error 'POS=\+999.99999'"),
        ("encoder-line", {"unit": "counts"}, "the unit 'counts' has no 'counts_per_turn'; add it"),
        (
            "encoder-line",
            {"counts_per_turn": 4096},
            "the unit 'degrees' takes no 'counts_per_turn'; remove it",
        ),
        ("encoder-line", {"request": "POS\r"}, "line ends are stated by"),
    ],
)
def test_what_cannot_be_is_a_mistake_of_the_file(tmp_path, name, changes, why):
    with pytest.raises(FileMistakes, match=why):
        section(tmp_path, name, **changes)


def test_a_line_has_the_ends_and_the_unit_that_are_stated(tmp_path):
    head = section(
        tmp_path,
        "encoder-line",
        request_end="CR",
        reply_end="LF",
        unit="counts",
        counts_per_turn=2**20,
        pattern=r"(?P<angle>-?\d{1,8})",
        example="0",
        errors={"?": "no signal"},
    )
    port = head.port()
    assert (port.write_termination, port.read_termination) == ("\r", "\n")
    assert head.driver_options()["per_turn"] == 2**20
    assert math.isclose(section(tmp_path, "encoder-line", unit="arcsec").per_turn, 1296000.0)


SERIAL = {"resource": "ASRL/dev/ttyUSB0::INSTR", "interface": "rs232"}


def with_one(tmp_path, **x):
    data = yaml.safe_load(find_bench("paper-stand").read_text(encoding="utf-8"))
    data["instruments"]["voltmeters"] = [
        {"driver": "keithley-2000", "channels": ["x"], **x},
        {"driver": "keithley-2000", "channels": ["y"], "resource": "GPIB0::16::INSTR"},
        {"driver": "keithley-2000", "channels": ["z"], "resource": "prologix://192.0.2.10/17"},
    ]
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("terminator", "end"), [(None, "\n"), ("lf", "\n"), ("cr", "\r"), ("crlf", "\r\n"), ("lfcr", "\n\r")]
)
def test_over_rs232_lines_end_as_the_meter_is_set(tmp_path, terminator, end):
    stated = {} if terminator is None else {"serial": {"terminator": terminator}}
    bench = load_bench(with_one(tmp_path, **SERIAL, **stated))
    x, y, z = (meter.port() for meter in bench.instruments.voltmeters)
    assert (x.read_termination, x.write_termination) == (end, end)
    assert (x.serial["baud_rate"], x.serial["stop_bits"], x.serial["parity"]) == (4800, 1, "none")
    assert {y.read_termination, z.write_termination} == {"\n"}
    assert on_terminals(bench) == ("voltmeter.x",)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"serial": {"baud_rate": 38400}}, "expected one of 300, 600, 1200, 2400, 4800, 9600, 19200"),
        ({"serial": {"terminator": "nl"}}, "expected lf, cr, crlf or lfcr"),
        ({"serial": {"parity": "even"}}, "unknown key 'parity'; known: baud_rate, terminator"),
        ({"interface": "lan"}, "expected gpib or rs232"),
        ({"interface": "gpib"}, "state 'interface: rs232'"),
        (
            {"range": "3 V"},
            "the keithley-2000 has no range of 3 V; choose from 0.1 V, 1 V, 10 V, 100 V, 1000 V",
        ),
    ],
)
def test_what_the_meter_has_not_is_refused(tmp_path, wrong, told):
    with pytest.raises(FileMistakes, match=told):
        load_bench(with_one(tmp_path, **{**SERIAL, **wrong}))


def esp301(folder: Path, **changes: Any) -> Any:
    device = devices().get("newport-esp301")
    assert device is not None
    return load_bench(written_bench(device, folder, **changes)).instruments.head


def test_its_port_is_as_the_manual_has_it(tmp_path: Path) -> None:
    port = esp301(tmp_path).port()
    assert (port.write_termination, port.read_termination) == ("\r", "\r\n")
    assert port.serial == {
        "baud_rate": 19200, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "rts_cts",
        "device_clear": b"",
    }  # fmt: skip
    assert esp301(tmp_path, serial={"baud_rate": 921600}).port().serial["baud_rate"] == 921600


@pytest.mark.parametrize("resource", ["GPIB0::1::INSTR", "ASRL3::INSTR", "TCPIP0::192.0.2.41::4001::SOCKET"])
def test_wires_that_it_has(tmp_path: Path, resource: str) -> None:
    head = esp301(tmp_path, resource=resource, axis=2, allow_homing=True)
    assert head.resource == resource
    assert head.driver_options() == {"axis": 2, "identity": "ESP30[01]", "allow_homing": True}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"resource": "USB0::0x104D::0x3006::1::INSTR"}, "expected a VISA resource such as 'ASRL"),
        ({"resource": "prologix://192.0.2.10/1"}, "expected a VISA resource such as 'ASRL"),
        ({"resource": "ASRL"}, "expected a VISA resource such as"),
        ({"serial": {"baud_rate": 9600}}, "expected one of 19200, 921600, got '9600'"),
        ({"axis": 4}, "axis"),
    ],
)
def test_what_it_has_not_is_a_mistake(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    with pytest.raises(FileMistakes, match=told):
        esp301(tmp_path, **changes)
