"""Faults on demand: as data, when they strike, what they do on the wire and to the instrument."""

import json
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.control import BenchControl
from sim.scpi import never
from sim.wires.faults import Fault, FaultKind, FaultyInstrument
from sim.wires.session import PlainDialect
from sim.world.clock import VirtualClock
from sim.world.power import PowerSettings, Rail
from sim.world.world import World, WorldSettings
from tests.support.patience import PATIENCE_S
from tests.support.scripted_session import Clock
from tests.support.simulated_stand import BLOCK, EndlessClock, a_34401a, a_world

IDENTITY = b"HEWLETT-PACKARD,34401A,0,11-5-2\n"


def a_meter(interface: str = "lan") -> Agilent34401A:
    meter = a_34401a("x", noise=False, interface=interface)  # type: ignore[arg-type]
    return meter.on(a_world())


def faulty(*data: dict[str, object], interface: str = "lan", seed: int = 5) -> FaultyInstrument:
    return FaultyInstrument(a_meter(interface), "v", seed, [Fault.parse(d) for d in data], Clock())


def say(meter: FaultyInstrument, text: str) -> bytes | None:
    return meter.handle(text.encode(), never)


# --- as data ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data",
    [
        {"fault": "cut", "probability": 0.01},
        {"fault": "drop", "at": 17},
        {"fault": "late", "matching": "READ?", "seconds": 2.0, "instrument": "voltmeter.x"},
        {"fault": "error", "at": 1, "error": -113},
        {"fault": "power-cycle", "matching": "FETC", "probability": 0.5},
    ],
)
def test_a_fault_is_data_and_back(data: dict[str, object]) -> None:
    assert Fault.parse(data).told() == data
    as_text = {key: str(value) for key, value in data.items()}
    assert Fault.parse(as_text) == Fault.parse(data)


def test_underscores_do_for_dashes() -> None:
    assert Fault.parse({"fault": "power_cycle", "at": 1}).kind is FaultKind.POWER_CYCLE


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"fault": "explode", "at": 1}, "expected fault to be one of drop, refuse"),
        ({"at": 1}, "expected fault to be one of"),
        ({"fault": "cut"}, "give probability, at or matching"),
        ({"fault": "cut", "probability": 1.5}, "between 0 and 1"),
        ({"fault": "cut", "probability": "often"}, "expected probability to be a number"),
        ({"fault": "cut", "probability": "nan"}, "expected probability to be a number"),
        ({"fault": "cut", "at": 0}, "count exchanges from 1"),
        ({"fault": "cut", "at": 1.5}, "whole number"),
        ({"fault": "cut", "at": 1, "probability": 0.1}, "remove one of the two"),
        ({"fault": "late", "at": 1}, "state 'seconds'"),
        ({"fault": "late", "at": 1, "seconds": -1}, "of 0 or more"),
        ({"fault": "cut", "at": 1, "seconds": 1}, "no duration"),
        ({"fault": "cut", "at": 1, "error": 5}, "leave out error"),
        ({"fault": "cut", "when": 1}, "has no when"),
    ],
)
def test_a_fault_that_makes_no_sense_is_one_sentence(data: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        Fault.parse(data)
    assert "\n" not in str(caught.value)


def test_an_instrument_refuses_what_it_cannot_have() -> None:
    class Bell:
        def handle(self, message: bytes, interrupted: object) -> bytes | None:
            return b"ding"

        def device_clear(self) -> None: ...

        def input_overflow(self) -> None: ...

    bell = FaultyInstrument(Bell(), "bell", 1)
    for kind in ("power-cycle", "local", "error", "overload"):
        with pytest.raises(ValueError, match=r"^bell "):
            bell.add(Fault.parse({"fault": kind, "at": 1}))
    bell.add(Fault.parse({"fault": "cut", "at": 1}))
    with pytest.raises(ValueError, match="no instrument gong"):
        SimulatedBench(a_world(), {"bell": Bell()}, faults=[Fault(FaultKind.DROP, at=1, instrument="gong")])
    with pytest.raises(ValueError, match="no instrument of this bench"):
        SimulatedBench(a_world(), {"bell": Bell()}, faults=[Fault(FaultKind.LOCAL, at=1)])


# --- when they strike -------------------------------------------------------------------------------


def struck(meter: FaultyInstrument, messages: list[str]) -> list[int]:
    """The numbers (1…) of the exchanges on which the wire fails."""
    return [
        number
        for number, text in enumerate(messages, start=1)
        if meter.wire_fault(text.encode(), say(meter, text)) is not None
    ]


def test_at_strikes_once_and_counts_what_matches() -> None:
    assert struck(faulty({"fault": "drop", "at": 3}), ["*IDN?"] * 6) == [3]
    messages = ["*IDN?", "READ?", "*IDN?", "read?", "READ?"]
    assert struck(faulty({"fault": "drop", "at": 2, "matching": "READ?"}), messages) == [4]
    assert struck(faulty({"fault": "drop", "matching": "READ?"}), messages) == [2, 4, 5]


def test_a_fault_of_the_reply_waits_for_one() -> None:
    messages = ["*CLS", "*CLS", "*CLS", "*IDN?", "*IDN?"]
    assert struck(faulty({"fault": "cut", "at": 2}), messages) == [4]
    assert struck(faulty({"fault": "drop", "at": 2}), messages) == [2]


def test_probability_is_seeded_and_true() -> None:
    messages = ["*IDN?"] * 2000
    once = struck(faulty({"fault": "drop", "probability": 0.1}, seed=1), messages)
    again = struck(faulty({"fault": "drop", "probability": 0.1}, seed=1), messages)
    other = struck(faulty({"fault": "drop", "probability": 0.1}, seed=2), messages)
    assert once == again != other
    assert 150 < len(once) < 250  # 200 expected, sigma 13; seed 1
    assert struck(faulty({"fault": "drop", "probability": 0.0}), messages) == []
    assert struck(faulty({"fault": "drop", "probability": 1.0}), ["*IDN?"] * 3) == [1, 2, 3]


# --- what they do to the instrument -----------------------------------------------------------------


def test_power_cycle_forgets_settings_and_not_the_world() -> None:
    meter = faulty({"fault": "power-cycle", "at": 4})
    say(meter, "VOLT:RANG 10;NPLC 100")
    say(meter, "*ESR?")
    before = say(meter, "READ?")
    assert say(meter, "VOLT:NPLC?;RANG:AUTO?") == b"+1.000000E+01;1"
    assert say(meter, "*ESR?") == b"+128"
    assert say(meter, "READ?") == before


def test_overload_lasts_for_one_exchange_and_shows_in_the_registers() -> None:
    meter = faulty({"fault": "overload", "at": 3, "matching": "?"})
    say(meter, "CONF:VOLT:DC 10")
    assert say(meter, "*ESR?") == b"+128"
    reading = say(meter, "READ?")
    assert say(meter, "READ?") == b"+9.90000000E+37"
    assert say(meter, "*ESR?;:SYST:ERR?") == b'+8;+0,"No error"'
    assert say(meter, "READ?") == reading


def test_the_local_key_needs_remote_again_over_rs232_unless_locked() -> None:
    meter = faulty({"fault": "local", "at": 1, "matching": "NPLC?"}, interface="rs232")
    say(meter, "SYST:REM")
    assert say(meter, "VOLT:NPLC?") is None
    assert say(meter, "SYST:ERR?") == b'+550,"Command not allowed in local"'
    say(meter, "SYST:REM")
    assert say(meter, "VOLT:NPLC?") is not None
    say(meter, "SYST:RWL")
    meter.press_local()
    assert say(meter, "VOLT:NPLC?") is not None


def test_an_error_comes_into_the_queue() -> None:
    meter = faulty({"fault": "error", "at": 2}, {"fault": "error", "at": 2, "error": -113})
    assert say(meter, "*ESR?") == b"+128"
    assert say(meter, "*ESR?") == b"+32"
    meter = faulty({"fault": "error", "at": 1})
    assert say(meter, "SYST:ERR?") == b'-222,"Data out of range"'


def test_hanging_ends_with_its_time_a_device_clear_or_a_power_cycle() -> None:
    for end in ("time", "clear", "power"):
        clock = Clock()
        hang = Fault(FaultKind.HANG, at=2, seconds=3.0 if end == "time" else 0.0)
        meter = FaultyInstrument(a_meter(), "v", 5, [hang], clock)
        assert say(meter, "*IDN?") is not None
        assert say(meter, "VOLT:NPLC 1") is None
        clock.sleep(2.9)
        assert say(meter, "*IDN?") is None
        if end == "time":
            clock.sleep(0.2)
        elif end == "clear":
            clock.sleep(1e6)
            assert say(meter, "*IDN?") is None
            meter.device_clear()
        else:
            meter.power_cycle()
        assert say(meter, "VOLT:NPLC?") == b"+1.000000E+01"


# --- on the wire ------------------------------------------------------------------------------------


@contextmanager
def wired(*data: dict[str, object]) -> Iterator[tuple[SimulatedBench, socket.socket]]:
    faults = [Fault.parse(d) for d in data]
    meters = {"v": a_34401a("x", noise=False)}
    with (
        SimulatedBench(a_world(), meters, faults=faults) as bench,
        socket.create_connection(("127.0.0.1", bench.servers["v"].port), timeout=PATIENCE_S) as client,
    ):
        yield bench, client


def ask(client: socket.socket, message: bytes = b"*IDN?\n") -> bytes:
    client.sendall(message)
    data = b""
    while not data.endswith(b"\n") and (chunk := client.recv(4096)):
        data += chunk
    return data


def test_twice() -> None:
    with wired({"fault": "twice", "at": 1}) as (_, client):
        client.sendall(b"*IDN?\n")
        with client.makefile("rb") as lines:
            assert [lines.readline(), lines.readline()] == [IDENTITY] * 2
        assert ask(client) == IDENTITY


def test_late_by_real_time() -> None:
    with wired({"fault": "late", "at": 1, "seconds": 0.2}) as (_, client):
        begun_s = time.monotonic()
        assert ask(client) == IDENTITY
        assert time.monotonic() - begun_s >= 0.2


def test_others_go_on_while_a_reply_is_late() -> None:
    with wired({"fault": "late", "at": 1, "seconds": 3600}) as (bench, client):
        client.sendall(b"*IDN?\n")
        assert not select.select([client], [], [], 0.1)[0]
        with socket.create_connection(("127.0.0.1", bench.servers["v"].port), timeout=PATIENCE_S) as other:
            assert ask(other) == IDENTITY
            assert not select.select([client], [], [], 0.0)[0]


def test_a_late_reply_is_void_after_a_device_clear() -> None:
    with wired({"fault": "late", "at": 1, "seconds": 60}) as (bench, client):
        client.sendall(b"READ?\n")
        for _ in range(1000):
            threading.Event().wait(0.01)
            if bench.world.clock.now_s() > 0.0:  # the reading was taken: its reply is what is late
                break
        threading.Event().wait(0.05)
        assert ask(client, b"\x03*IDN?\n") == IDENTITY


def test_cut_keeps_some_and_never_the_end() -> None:
    with wired({"fault": "cut", "probability": 1.0}) as (_, client):
        for _ in range(5):
            client.sendall(b"*IDN?\n")
            assert select.select([client], [], [], 5.0)[0]
            part = client.recv(4096)
            assert 0 < len(part) < len(IDENTITY) - 1
            assert IDENTITY.startswith(part)


def test_refusal_for_a_time() -> None:
    with wired({"fault": "refuse", "at": 1, "seconds": 0.1}) as (bench, client):
        address = ("127.0.0.1", bench.servers["v"].port)
        assert ask(client) == b""
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address)
        for _ in range(500):
            try:
                with socket.create_connection(address, timeout=PATIENCE_S) as again:
                    assert ask(again) == IDENTITY
                return
            except ConnectionRefusedError:
                threading.Event().wait(0.01)
        pytest.fail("the port stays closed")


def test_a_device_clear_of_another_client_ends_a_long_reading() -> None:
    clock = EndlessClock()
    world = World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), {}, 5), clock)
    with SimulatedBench(world, {"v": a_34401a("x")}) as bench:
        address = ("127.0.0.1", bench.servers["v"].port)
        with (
            socket.create_connection(address) as a,
            socket.create_connection(address, timeout=PATIENCE_S) as b,
        ):
            a.sendall(b"SAMP:COUN 7;:READ?\n")
            assert clock.entered.wait(PATIENCE_S)
            b.sendall(b"\x03")
            assert ask(b) == IDENTITY
            assert ask(b, b"SAMP:COUN?\n") == b"+7\n"


# --- control rails ----------------------------------------------------------------------------------
# What feeds the block is disturbed from outside.


def control(*rails: Rail) -> tuple[World, BenchControl]:
    block = Block(np.diag([-2.2, -2.1, -2.15]), np.zeros(3))
    settings = WorldSettings(
        block, ForwardModel({"1": INSTALLATION_1}), {}, 5, power=PowerSettings(rails, in_rush=1.0)
    )
    world = World(settings, VirtualClock())
    return world, BenchControl(SimulatedBench(world, {}))


def told(of: BenchControl, command: str) -> dict[str, object]:
    return json.loads(of.handle(command.encode(), lambda: False) or b"{}")


def test_a_rail_sags_for_a_while():
    world, of = control(Rail("p15", "+", 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2))
    world.power.change("+", 0.0, set_v=15.0, limit_a=0.2, on=True)
    assert told(of, "rail sag + size=0.5 seconds=20")["ok"]
    world.clock.sleep(10.0)
    assert world.power.rail_v("p15", 10.0) == 7.5
    world.clock.sleep(20.0)
    assert world.power.rail_v("p15", 30.0) == 15.0


def test_mistakes_are_told():
    _, of = control(Rail("p15", "+", 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2))
    assert "sag" in str(told(of, "rail")["error"])
    assert "no rail" in str(told(of, "rail off P25V")["error"])
    assert "no supply" in str(told(control()[1], "rail off")["error"])


@pytest.mark.parametrize("reply", ["+1.0", 1.0, {}])
def test_a_simulations_own_mistake_names_its_instrument_and_the_message(reply: object) -> None:
    class Mistaken(PlainDialect):
        def handle(self, message: bytes, interrupted: object) -> object:
            return reply or {}["no such key"]

    with pytest.raises((TypeError, KeyError)) as mistake:
        FaultyInstrument(Mistaken(), "bell", 1).handle(b"RING?", never)  # type: ignore[arg-type]
    assert mistake.value.__notes__ == ["the simulation of bell failed at b'RING?': correct it"]
