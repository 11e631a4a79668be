"""`bench instruments`: every instrument at once, all failures together; what interfaces offer; commissioning."""

import json
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bench.cli.app import main
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.served import dry_bench
from bench.services import instruments as command
from drivers.clock import SystemClock
from drivers.interfaces import BenchError, Identity, InstrumentLost, InstrumentRefused
from drivers.wire.resources import SOCKETS, SerialPort, discover
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.wires.faults import Fault, FaultKind
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings
from tests.support.commands import printed, refused
from tests.support.patience import PATIENCE_S
from tests.support.simulated_stand import a_34401a

SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"
METERS = [f"voltmeter.{c}" for c in "xyz"]
Bench = Callable[..., tuple[int, str, str]]


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedBench]:
    """A folder with a bench file whose meters are simulated ones on loopback, and no noise."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_FILE", raising=False)
    bench = load_bench(SHIPPED)
    model = ForwardModel(bench.installation_models())
    world = World(WorldSettings(bench.simulated_block(), model, {}, seed=1), VirtualClock())
    meters = {f"voltmeter.{c}": a_34401a(c, interface="gpib", noise=False) for c in "xyz"}
    with SimulatedBench(world, meters) as simulated:
        write_bench_file(simulated.resources)
        yield simulated


def write_bench_file(resources: dict[str, str]) -> None:
    text = SHIPPED.read_text(encoding="utf-8")
    for address, name in zip((22, 23, 24), METERS, strict=True):
        text = text.replace(f'"GPIB0::{address}::INSTR"', f'"{resources[name]}"')
    text = text.replace("range: 10 V}", "range: 10 V, timeout: 0.3 s}")
    Path("bench.yaml").write_text(text, encoding="utf-8")


@pytest.fixture
def bench(capsys: pytest.CaptureFixture[str]) -> Bench:
    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(["instruments", *map(str, arguments)])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        assert "unexpected" not in err
        return int(str(ended.value.code)), out, err

    return call


def test_a_bench_that_is_well_in_the_table_and_in_json(served: SimulatedBench, bench: Bench) -> None:
    status, out, err = bench("--bench", "bench.yaml", "--json", "result.json")
    assert (status, err) == (0, "")
    assert "5 of 5 instruments respond without a fault" in out
    lines = {line.split()[0]: line for line in out.splitlines()}
    true_v = served.world.signal_v("y")
    for part in (served.resources["voltmeter.y"], "HEWLETT-PACKARD 34401A", "10 V, 1 NPLC", "passed"):
        assert part in lines["voltmeter.y"]
    assert f"y {true_v:+.6f} V" in lines["voltmeter.y"]
    assert "by hand" in lines["head"]
    assert "manual" in lines["chamber"]
    assert "-60 to 100 °C" in lines["chamber"]
    result = json.loads(Path("result.json").read_text(encoding="utf-8"))
    assert result["passed"] is True
    by_name = {row["name"]: row for row in result["instruments"]}
    assert list(by_name) == [*METERS, "head", "chamber"]
    for channel in "xyz":
        row = by_name[f"voltmeter.{channel}"]
        assert row["value"] == {channel: pytest.approx(served.world.signal_v(channel), abs=1e-7)}
        assert row["identity"]["model"] == "34401A"
        assert (row["self_test"], row["failures"]) == ("passed", [])
    assert by_name["head"]["self_test"] == "manual"


def test_all_failures_stand_together_and_the_rest_is_shown(served: SimulatedBench, bench: Bench) -> None:
    served.arm(Fault(FaultKind.HANG, at=1, instrument="voltmeter.x"))
    served.servers["voltmeter.z"].stop()
    status, out, err = bench("--bench", "bench.yaml")
    assert status == 2
    silent, no_connection = err.splitlines()
    assert silent.startswith("bench: voltmeter.x: ")
    assert "did not answer *IDN? within 0.3 s; check its power" in silent
    assert no_connection.startswith("bench: voltmeter.z: ")
    assert "refused the connection" in no_connection
    assert out.count("NOT OPENED") == 2
    assert "3 of 5 instruments respond without a fault" in out
    assert "passed" in out


def test_slow_meters_are_waited_for_side_by_side(served: SimulatedBench, bench: Bench) -> None:
    """Three meters that answer nothing cost one timeout, as they are opened at once."""
    open_now: set[str] = set()
    together: list[int] = []
    for name, wired in served.wired.items():

        def hook(message: bytes, reply: bytes | None, name: str = name) -> None:
            open_now.add(name)
            give_up = time.monotonic() + PATIENCE_S
            while message == b"*IDN?" and len(open_now) < 3 and time.monotonic() < give_up:
                time.sleep(0.005)
            together.append(len(open_now))

        wired.fault = hook
    text = Path("bench.yaml").read_text(encoding="utf-8")
    Path("bench.yaml").write_text(text.replace("timeout: 0.3 s", "timeout: 600 s"), encoding="utf-8")
    assert bench("--bench", "bench.yaml")[0] == 0
    assert min(together) == 3


def test_a_self_test_that_fails_is_not_accepted(
    served: SimulatedBench, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(meter: Agilent34401A) -> int:
        if meter is served.dialects["voltmeter.y"]:
            meter.report(-330 if -330 in meter._error_texts else 521)
            return 1
        return 0

    monkeypatch.setattr(Agilent34401A, "self_test", fail)
    status, out, err = bench("--bench", "bench.yaml")
    assert status == 1
    (line,) = err.splitlines()
    assert line.startswith("bench: voltmeter.y: its self-test failed: *TST? answers +1, error ")
    assert "have it serviced" in line
    assert "4 of 5 instruments respond without a fault" in out
    row = next(line for line in out.splitlines() if line.startswith("voltmeter.y"))
    assert "FAILED" in row
    assert "y " in row  # it is read all the same


def test_an_overload_is_told_and_is_not_an_absent_meter(served: SimulatedBench, bench: Bench) -> None:
    served.arm(Fault(FaultKind.OVERLOAD, matching="FETC", instrument="voltmeter.z"))
    status, out, err = bench("--bench", "bench.yaml")
    assert status == 1
    assert "channel z overloads the 10 V range" in err
    assert "NOT OPENED" not in out


def test_a_drivers_own_mistake_hides_nothing(
    served: SimulatedBench, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = command._read

    def broken(instrument: Any, row: Any, range_v: float) -> None:
        if row.name == "voltmeter.x":
            raise ZeroDivisionError("a mistake")
        original(instrument, row, range_v)

    monkeypatch.setattr(command, "_read", broken)
    status, out, err = bench("--bench", "bench.yaml")
    assert status == 1
    assert "voltmeter.x: the driver failed with ZeroDivisionError" in err
    assert "4 of 5 instruments respond without a fault" in out


class Stuck:
    """A motorised head that answers its identity and then never comes back, until it is closed."""

    name = "head"

    def __init__(self) -> None:
        self.closed = 0
        self._pair = socket.socketpair()

    def open(self) -> Identity:
        return Identity("Maker", "Model")

    def position_rad(self) -> float:
        self._pair[0].recv(1)
        raise InstrumentLost("head", "closed", "open it")

    def close(self) -> None:
        self.closed += 1
        self._pair[1].close()


def test_a_driver_that_never_ends_is_given_up_and_closed() -> None:
    head = Stuck()
    row = command.InstrumentLook("head", "COM1", "")
    clock = VirtualClock()
    times_s = iter([0.0, command._LONGEST_S + 1.0, command._LONGEST_S + 2.0])
    clock.now_s = lambda: next(times_s)  # type: ignore[method-assign]
    command._look_at_all([head], [row], 10.0, clock)
    assert row.failure is not None
    assert head.closed >= 1
    assert row.absent


def test_a_motorised_head_shows_where_it_stands() -> None:
    class Standing(Stuck):
        def position_rad(self) -> float:
            return 0.7853981633974483

    row = command.InstrumentLook("head", "COM1", "")
    command._look_at(Standing(), row, 10.0)
    assert (row.shows, row.self_test, row.failures) == ("45°00′00″", "none", [])


def test_an_instrument_that_was_not_left_safe_is_told() -> None:
    class Turning(Stuck):
        def position_rad(self) -> float:
            return 0.5

        def close(self) -> str:  # type: ignore[override]
            return "press its emergency stop"

    row = command.InstrumentLook("head", "COM1", "")
    command._look_at(Turning(), row, 10.0)
    assert [str(failure) for failure in row.failures] == [
        "head: it could not be made safe; press its emergency stop"
    ]

    class Interrupted(SystemClock):
        def now_s(self) -> float:
            if begun.is_set():
                raise KeyboardInterrupt
            return super().now_s()

    class Busy(Turning):
        def position_rad(self) -> float:
            begun.set()
            return Stuck.position_rad(self)

        def close(self) -> str:  # type: ignore[override]
            Stuck.close(self)
            return super().close()

    begun = threading.Event()
    with pytest.raises(
        BenchError, match="stopped, but not everything could be made safe; head: press its emergency"
    ):
        command._look_at_all([Busy()], [row], 10.0, Interrupted())


def test_a_bench_with_motors_is_looked_at_and_nothing_moves() -> None:
    """A head and a chamber with wires of their own show where they stand and what they have."""
    file = load_bench(find_bench("bench-motorised"))
    with dry_bench(file, ForwardModel(file.installation_models()), 1) as assembly:
        instruments = assembly.instruments.all()
        rows = [command._row(file, instrument) for instrument in instruments]
        command._look_at_all(instruments, rows, file.voltmeter_range_v, SystemClock())
    shown = {row.name: row for row in rows}
    assert [failure for row in rows for failure in row.failures] == []
    assert shown["head"].shows == "0°00′00″"
    assert shown["head"].address == "ASRL/dev/ttyUSB0::INSTR"
    assert shown["chamber"].value == pytest.approx(23.0, abs=0.5)
    assert {row.self_test for row in rows} == {"passed", "none"}


def test_without_a_bench_file_it_says_so(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BENCH_FILE", raising=False)
    refused(bench(), "--bench FILE", "--discover")


def test_the_wire_log_holds_both_directions(served: SimulatedBench, bench: Bench) -> None:
    assert bench("--bench", "bench.yaml", "--wire-log", "wire.log")[0] == 0
    text = Path("wire.log").read_text(encoding="utf-8")
    for name in METERS:
        assert f" {name} > *TST?\n" in text
        assert f" {name} < +0\n" in text


# --- discovery --------------------------------------------------------------------------------------


def test_discovery_lists_resources_and_ports_once() -> None:
    port = SerialPort("ASRL/dev/ttyUSB0::INSTR", "/dev/ttyUSB0", "USB serial")
    offer = discover(
        lambda: (port.resource, "PRLGX-ASRL::/dev/ttyUSB0::INTFC", "TCPIP::10.0.0.7::INSTR"), lambda: (port,)
    )
    assert offer.resources == ("TCPIP::10.0.0.7::INSTR",)
    assert offer.serial_ports == (port,)
    assert offer.notes[-1] == SOCKETS


def test_what_cannot_be_searched_is_a_note() -> None:
    def fail() -> tuple[str, ...]:
        warnings.warn("install psutil to scan all", stacklevel=1)
        raise OSError("the network is down")

    def no_ports() -> tuple[SerialPort, ...]:
        raise ImportError("serial")

    offer = discover(fail, no_ports)
    assert (offer.resources, offer.serial_ports) == ((), ())
    told = "\n".join(offer.notes)
    for part in ("the network is down", "serial ports could not be searched", "install psutil", "raw SCPI"):
        assert part in told


def test_the_command_lists_offers(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    port = SerialPort("ASRL/dev/ttyUSB0::INSTR", "/dev/ttyUSB0", "USB serial")
    found = discover(lambda: ("TCPIP::10.0.0.7::INSTR",), lambda: (port,))
    monkeypatch.setattr("drivers.wire.resources.discover", lambda: found)
    status, out, err = bench("--discover")
    assert (status, err) == (0, "")
    assert "TCPIP::10.0.0.7::INSTR" in out
    assert "/dev/ttyUSB0 USB serial" in out
    assert "raw SCPI sockets" in out
    out = printed(bench("--discover", "--json", "-"))
    assert json.loads(out)["resources"] == ["TCPIP::10.0.0.7::INSTR"]


def test_instruments_that_another_program_holds_are_refused_with_its_name(
    served: SimulatedBench, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def held(self: object, name: str, resource: str) -> None:
        raise InstrumentRefused(
            name, f"{resource} is in use by 'bench run'", "end that program or wait for it"
        )

    monkeypatch.setattr("drivers.wire.resources.Holding.take", held)
    status, out, err = bench("--bench", "bench.yaml")
    assert status == 2
    assert err.count("is in use by 'bench run'; end that program or wait for it") == 3
    assert out.count("NOT OPENED") == 3


def test_without_a_terminal_it_is_refused_before_anything_is_opened(bench, empty_folder):
    refused(bench("--commission", "--bench", "bench-lan"), "start it in a terminal")
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--commission"], "no bench file named"),
        (["--commission", "--discover", "--bench", "bench-lan"], "excludes --discover"),
        (["--commission", "--wire-log", "w", "--bench", "bench-lan"], "excludes --wire-log"),
        (["--dry-run", "--bench", "bench-lan"], "--dry-run needs --commission; add --commission"),
        (["--out", "a", "--bench", "bench-lan"], "--out needs --commission; add --commission"),
    ],
)
def test_options_that_do_not_go_together_are_refused(bench, empty_folder, arguments, said):
    refused(bench(*arguments), said)


def test_a_dry_run_prints_what_it_finds_and_where_the_page_is(bench, empty_folder):
    status, out, err = bench("--commission", "--dry-run", "--bench", "bench-lan")
    assert (status, err) == (0, "")
    assert "voltmeter.x: time of a reading" in out
    (folder,) = Path.cwd().glob("commissioning-*")
    assert f"page: {folder.name}/commissioning.html" in out.replace("\\", "/")


def test_json_alone_goes_to_standard_output_and_a_fault_decides_the_status(bench, empty_folder):
    from bench.config.shipped import find_bench

    text = find_bench("bench-lan").read_text(encoding="utf-8")
    faults = "simulation:\n  faults: [{fault: overload, instrument: voltmeter.y, probability: 1}]\n"
    Path("bench.yaml").write_text(f"{text}\n{faults}", encoding="utf-8")
    asked = "--commission --dry-run --bench bench.yaml --out here --json -"
    status, out, _ = bench(*asked.split())
    result = json.loads(out)
    assert status == result["status"] == 1
    wrong = {one["instrument"] for one in result["findings"] if one["state"] != "works"}
    assert wrong == {"voltmeter.y"}
    assert (Path("here") / "commissioning.html").is_file()
