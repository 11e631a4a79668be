"""The section of a Keithley 2000: how its line is set, and that it is held against the meter."""

import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.run.assembly.instruments import on_terminals

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
