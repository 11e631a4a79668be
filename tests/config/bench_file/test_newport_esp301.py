"""A Newport ESP301 in a bench file: the wires that it has, how fast its port is, what its driver is told."""

from pathlib import Path
from typing import Any

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.devices.registry import devices
from tests.support.instrument_stand import written_bench


def section(folder: Path, **changes: Any) -> Any:
    device = devices().get("newport-esp301")
    assert device is not None
    return load_bench(written_bench(device, folder, **changes)).instruments.head


def test_its_port_is_as_the_manual_has_it(tmp_path: Path) -> None:
    port = section(tmp_path).port()
    assert (port.write_termination, port.read_termination) == ("\r", "\r\n")
    assert port.serial == {
        "baud_rate": 19200, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "rts_cts",
        "device_clear": b"",
    }  # fmt: skip
    assert section(tmp_path, serial={"baud_rate": 921600}).port().serial["baud_rate"] == 921600


@pytest.mark.parametrize("resource", ["GPIB0::1::INSTR", "ASRL3::INSTR", "TCPIP0::192.0.2.41::4001::SOCKET"])
def test_wires_that_it_has(tmp_path: Path, resource: str) -> None:
    head = section(tmp_path, resource=resource, axis=2, allow_homing=True)
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
        section(tmp_path, **changes)
