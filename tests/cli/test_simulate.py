"""`bench simulate`: what it serves, tells, takes through its control, and how it ends."""

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.served import served_bench
from sim.wires.server import TERMINALS
from sim.world.clock import ScaledClock
from tests.support.commands import refused
from tests.support.patience import PATIENCE_S, together


@contextmanager
def serving(name: str = "paper-stand", **options: Any) -> Iterator[Any]:
    bench = load_bench(find_bench(name))
    with served_bench(bench, ForwardModel(bench.installation_models()), 1, speed=1e4, **options) as told:
        yield told


def ask(address: str, *lines: str) -> list[str]:
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as connection:
        connection.sendall("".join(f"{line}\n" for line in lines).encode())
        with connection.makefile("r", encoding="utf-8") as replies:
            return [replies.readline().rstrip("\n") for _ in lines]


def control(told: Any, line: str) -> dict[str, Any]:
    reply: dict[str, Any] = json.loads(ask(told.control, line)[0])
    return reply


# --- the program ------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to end a program with")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_serves_until_a_signal_and_ends_with_0(bench: Any, number: int) -> None:
    ready = Path("ready.json")

    def asked() -> dict[str, Any]:
        """Ask each meter who it is, then end the program; what was told before."""
        give_up = time.monotonic() + PATIENCE_S
        while not ready.exists() and time.monotonic() < give_up:
            time.sleep(0.01)
        try:
            told: dict[str, Any] = json.loads(ready.read_text())
            for instrument in told["instruments"]:
                assert instrument["model"] == "34401A"
                assert ask(instrument["tcp"], "*IDN?") == ["HEWLETT-PACKARD,34401A,0,11-5-2"]
                assert (instrument["pty"] is not None) == TERMINALS
                assert not TERMINALS or Path(instrument["pty"]).exists()
        finally:
            os.kill(os.getpid(), number)
        return told

    with ThreadPoolExecutor(1) as pool:
        answers = pool.submit(asked)
        status, out, err = bench("simulate", "--ready-file", ready, "--speed", "1000")
    told = answers.result()
    assert status == 0, err
    assert [one["name"] for one in told["instruments"]] == ["voltmeter.x", "voltmeter.y", "voltmeter.z"]
    assert all(one["tcp"] in out for one in told["instruments"])
    assert told["control"] in out
    assert list(Path().iterdir()) == []


def test_a_taken_port_is_one_sentence_and_status_2(bench: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        told = bench("simulate", "--port", str(port), "--no-pty")
    refused(told, f"port {port} of 127.0.0.1 cannot be served", "voltmeter.x")


def test_an_address_of_another_computer_is_refused_with_one_that_works(bench: Any) -> None:
    refused(bench("simulate", "--host", "192.0.2.1", "--no-pty"), "listen on an address of this computer")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--speed", "0"], "positive speed"),
        (["--speed", "nan"], "positive speed"),
        (["--port", "70000"], "give a port"),
        (["--bench", "nowhere.yaml"], "no such file"),
        (["turn 45 deg"], "--control HOST:PORT"),
        (["--control", "127.0.0.1:1", "state"], "no simulated bench answers"),
        (["--control", "somewhere", "state"], "expected HOST:PORT"),
        (["--ready-file", "no/such/folder/ready.json", "--no-pty"], "cannot be written"),
    ],
)
def test_mistakes_are_one_sentence(bench: Any, arguments: list[str], says: str) -> None:
    refused(bench("simulate", *arguments), says)


# --- what is served ---------------------------------------------------------------------------------


def three_free_ports() -> int:
    """The first of three free ports in a row, below those that the system gives away by itself."""
    for first in range(21000, 32000, 3):
        try:
            for port in range(first, first + 3):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return first
    pytest.skip("no three ports in a row are free")


def test_ports_follow_each_other_and_no_terminals_are_made_unasked() -> None:
    first = three_free_ports()
    with serving(first_port=first, with_terminals=False) as told:
        addresses = [instrument["tcp"] for instrument in told.instruments]
        assert addresses == [f"127.0.0.1:{port}" for port in range(first, first + 3)]
        assert {instrument["pty"] for instrument in told.instruments} == {None}


def test_a_meter_is_a_lan_one_unless_the_bench_file_says_another() -> None:
    with serving() as told:
        assert ask(told.instruments[0]["tcp"], "SYST:REM;:SYST:ERR?") == ['+0,"No error"']
    with serving("bench-gpib") as told:
        answer = ask(told.instruments[0]["tcp"], "SYST:REM;:SYST:ERR?")
        assert answer == ['+514,"Command allowed only with RS-232"']


def test_one_world_couples_the_meters() -> None:
    with serving() as told:
        meters = [instrument["tcp"] for instrument in told.instruments]
        control(told, "turn 90 deg")
        at_90 = [float(ask(meter, "CONF:VOLT:DC 10;:READ?")[0]) for meter in meters]
        state = control(told, "turn 0")
        at_0 = [float(ask(meter, "READ?")[0]) for meter in meters]
        assert at_0 == pytest.approx(list(state["signals_v"].values()), abs=6e-4)  # ΔU_M: 0.3 mV
        turned = [abs(a - b) for a, b in zip(at_0, at_90, strict=True)]
        assert turned[0] > 1.0
        assert turned[1] < 0.2  # y lies along the shaft
        assert turned[2] > 1.0


# --- the control ------------------------------------------------------------------------------------


def test_the_control_turns_mounts_heats_and_tells() -> None:
    with serving(with_terminals=False) as told:
        state = control(told, "turn 45 deg")
        assert state["ok"]
        assert state["scale_angle_deg"] == pytest.approx(45.0)
        assert state["true_angle_deg"] == pytest.approx(45.0, abs=0.01)
        assert state["true_angle_deg"] != state["scale_angle_deg"]
        assert state["direction"] == 1
        assert control(told, "turn 2700 arcmin falling")["direction"] == -1
        state = control(told, "mount 2 3")
        assert (state["installation"], state["series"]) == ("2", 3)
        assert state["scale_angle_deg"] == pytest.approx(45.0)
        assert control(told, "chamber 50 degC")["chamber_c"] == pytest.approx(50.0)
        later = control(told, "state")
        assert 23.0 < later["block_c"] < 50.0
        assert later["time_s"] > state["time_s"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("trun 45", "no command 'trun'"),
        ("turn", "expected a number"),
        ("turn 45 furlongs", "in deg, arcmin, arcsec or rad"),
        ("turn nan deg", "expected a number"),
        ("mount 7", "no installation '7'"),
        ("mount", "name the installation"),
        ("chamber 300 K", "in degC"),
        ("fault voltmeter.q cut", "no instrument 'voltmeter.q'"),
        ("fault cut probability=2", "between 0 and 1"),
        ("fault", "which fault"),
        ("drop", "name the instrument"),
        ("head sideways", "head stuck"),
        ('turn "45', "quotation"),
    ],
)
def test_the_control_refuses_with_a_sentence(line: str, says: str) -> None:
    with serving(with_terminals=False) as told:
        answer = control(told, line)
        assert answer["ok"] is False
        assert says in answer["error"]
        assert control(told, "state")["ok"]


def test_faults_through_the_control() -> None:
    with serving(with_terminals=False) as told:
        x, y = (instrument["tcp"] for instrument in told.instruments[:2])
        assert control(told, "fault voltmeter.x drop")["faults"] == [
            {"fault": "drop", "at": 1, "instrument": "voltmeter.x"}
        ]
        assert ask(y, "*IDN?") != [""]
        assert ask(x, "*IDN?") == [""]
        assert ask(x, "*IDN?") != [""]
        control(told, "fault garble matching=NPLC?")
        assert not any(c.isdigit() for c in ask(y, "VOLT:NPLC?")[0])
        assert control(told, "clear")["faults"] == []
        assert ask(y, "VOLT:NPLC?") == ["+1.000000E+01"]
        ask(x, "VOLT:NPLC 1;*OPC?")
        control(told, "power-cycle voltmeter.x")
        assert ask(x, "VOLT:NPLC?") == ["+1.000000E+01"]
        control(told, "refuse voltmeter.x")
        with pytest.raises(ConnectionRefusedError):
            ask(x, "*IDN?")
        control(told, "accept voltmeter.x")
        assert ask(x, "*IDN?") != [""]


def test_the_client_command_prints_the_answer_or_fails(bench: Any) -> None:
    with serving(with_terminals=False) as told:
        status, out, err = bench("simulate", "--control", told.control, "turn", "30", "deg")
        assert (status, err) == (0, "")
        assert json.loads(out)["scale_angle_deg"] == pytest.approx(30.0)
        refused(bench("simulate", "--control", told.control, "turn around"), "expected a number")


def test_the_control_takes_several_clients_at_once() -> None:
    with serving(with_terminals=False) as told:
        answers: list[dict[str, Any]] = []
        together(*(lambda a=a: answers.append(control(told, f"turn {a} deg")) for a in range(8)))
        assert len(answers) == 8
        assert all(answer["ok"] for answer in answers)


# --- the clock --------------------------------------------------------------------------------------


def test_a_scaled_clock_runs_faster_and_sleeps_less() -> None:
    class Real:
        time_s = 100.0

        def now_s(self) -> float:
            return self.time_s

        def sleep(self, duration_s: float) -> None:
            self.time_s += duration_s

    real = Real()
    clock = ScaledClock(60.0, real)
    assert clock.now_s() == 0.0
    clock.sleep(120.0)
    assert real.time_s == pytest.approx(102.0)
    assert clock.now_s() == pytest.approx(120.0)
    clock.sleep(-1.0)
    assert real.time_s == pytest.approx(102.0)
    for speed in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="positive speed"):
            ScaledClock(speed)
