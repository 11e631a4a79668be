"""One program at an instrument: a second is refused with who has it, a dead one holds nothing."""

import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import pytest
from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError
from pyvisa.resources import TCPIPInstrument, TCPIPSocket

from drivers.interfaces import InstrumentRefused
from drivers.wire.pyvisa_connection import Connection, probable_cause
from drivers.wire.resources import Holding, normalised
from tests.support.patience import PATIENCE_S

HOLDER = """
import sys
from pathlib import Path
from drivers.wire.resources import Holding
Holding(Path(sys.argv[1])).take("head", sys.argv[2])
print("held", flush=True)
sys.stdin.readline()
"""
METER = "TCPIP0::192.0.2.22::5025::SOCKET"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("TCPIP::192.0.2.22::5025::SOCKET", METER),
        ("TCPIP0::Meter-X.lab::inst0::INSTR", "tcpip::meter-x.LAB"),
        ("TCPIP0::localhost::5025::SOCKET", "TCPIP::127.0.0.1::5025::socket"),
        ("GPIB::22::INSTR", "GPIB0::22::INSTR"),
        ("gpib0::22::instr", "GPIB0::22"),
        ("USB0::0x2A8D::0x1301::MY53200001::INSTR", "USB::10893::4865::MY53200001::0::INSTR"),
        ("prologix://192.0.2.10/22", "prologix://192.0.2.10:1234/23"),
        ("prologix://Adapter/22", "prologix://adapter:1234/22"),
        ("ASRLCOM3::INSTR", "asrlcom3::instr"),
        ("prologix://COM3/5", "ASRLCOM3::INSTR"),
    ],
)
def test_aliases_of_one_resource_have_one_name(one: str, other: str) -> None:
    assert normalised(one) == normalised(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (METER, "TCPIP0::192.0.2.23::5025::SOCKET"),
        (METER, "TCPIP0::192.0.2.22::5024::SOCKET"),
        ("GPIB0::22::INSTR", "GPIB1::22::INSTR"),
        ("USB0::0x2A8D::0x1301::MY53200001::INSTR", "USB0::0x2A8D::0x1301::MY53200002::INSTR"),
        ("prologix://192.0.2.10/22", "prologix://192.0.2.10:1235/22"),
        ("ASRL/dev/ttyUSB0::INSTR", "ASRL/dev/ttyUSB1::INSTR"),
    ],
)
def test_different_resources_have_different_names(one: str, other: str) -> None:
    assert normalised(one) != normalised(other)


def test_a_serial_port_is_known_by_the_device_that_its_link_leads_to(tmp_path: Path) -> None:
    device, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    assert normalised(f"ASRL{link}::INSTR") == normalised(f"ASRL{device}::INSTR")
    assert normalised(f"prologix://{link}/22") == normalised(f"ASRL{device}::INSTR")


@pytest.mark.parametrize("word", ["", "::", "TCPIP0", "x::y::z", "serving 127.0.0.1:5025", "prologix://"])
def test_whatever_is_no_resource_has_a_name_as_well(word: str) -> None:
    assert isinstance(normalised(word), str)


def test_who_holds_it_is_named_and_what_a_killed_program_held_is_free(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(tmp_path), METER]
    process = subprocess.Popen(  # noqa: S603 - our own program
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    ours = Holding(tmp_path)
    with pytest.raises(
        InstrumentRefused, match=rf"is in use by '.*' \(\S+ on \S+, process {process.pid}\) since 2"
    ) as no:
        ours.take("voltmeter.x", "TCPIP::192.0.2.22::5025::SOCKET")
    assert str(no.value).endswith("end that program or wait for it")
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    ours.take("voltmeter.x", METER)
    ours.release(METER)


def test_one_program_holds_what_it_opens_twice_until_it_has_let_go_twice(tmp_path: Path) -> None:
    ours = Holding(tmp_path)
    ours.take("voltmeter.x", "prologix://192.0.2.10/22")
    Holding(tmp_path).take("voltmeter.y", "prologix://192.0.2.10/23")
    ours.release("prologix://192.0.2.10/22")
    assert list(tmp_path.glob("*.json"))
    ours.release("prologix://192.0.2.10/23")
    ours.release("prologix://192.0.2.10/23")
    assert not list(tmp_path.glob("*.json"))


def test_a_folder_that_cannot_be_written_keeps_nobody_from_the_bench(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    Holding(tmp_path / "file" / "held").take("voltmeter.x", METER)


# --- own lock ---------------------------------------------------------------------------------------
# An instrument's own lock, where its interface has one; no such instrument is simulated.


def connection(kind: type[Any], answer: BaseException | None = None) -> Connection:
    made = Connection.__new__(Connection)
    made._visa = create_autospec(kind, instance=True)
    made._visa.lock_excl.side_effect = answer
    return made


def test_a_lan_instrument_is_locked_within_the_timeout() -> None:
    made = connection(TCPIPInstrument)
    made.take_own_lock(1.5)
    made._visa.lock_excl.assert_called_once_with(timeout=1500.0)  # type: ignore[attr-defined]


def test_one_that_somebody_else_has_locked_is_refused_with_the_cause() -> None:
    with pytest.raises(VisaIOError) as locked:
        connection(TCPIPInstrument, VisaIOError(StatusCode.error_resource_locked)).take_own_lock(1.0)
    assert probable_cause(locked.value)[0] == "{0} is locked by another program or computer"


@pytest.mark.parametrize("answer", [VisaIOError(StatusCode.error_nonsupported_operation), KeyError(8)])
def test_one_that_cannot_be_locked_is_opened_all_the_same(answer: Exception) -> None:
    connection(TCPIPInstrument, answer).take_own_lock(1.0)


def test_a_plain_socket_has_no_lock() -> None:
    made = connection(TCPIPSocket)
    made.take_own_lock(1.0)
    made._visa.lock_excl.assert_not_called()  # type: ignore[attr-defined]
