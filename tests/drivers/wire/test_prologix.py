"""GPIB through an adapter: the transport, and a bench of three meters over it."""

import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest

from drivers.instruments.agilent_34401a import Agilent34401A as Driver
from drivers.interfaces import InstrumentLost, VoltmeterSettings
from drivers.wire.prologix import parse
from drivers.wire.pyvisa_connection import WireError
from drivers.wire.visa import MessageSession
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.wires.faults import Fault, FaultKind
from sim.wires.prologix import AdapterSettings, GpibAdapter
from tests.support.gpib_bus import ADDRESSES, IDENTITY, NO_ERROR, Bus, served
from tests.support.patience import PATIENCE_S, together
from tests.support.simulated_stand import a_world


@contextmanager
def session(bench: SimulatedBench, address: int = 22, timeout_s: float = 5.0) -> Iterator[MessageSession]:
    made = MessageSession(f"meter {address}", resource(bench, address), timeout_s=timeout_s)
    try:
        yield made
    finally:
        made.close()


def resource(bench: SimulatedBench, address: int) -> str:
    return f"prologix://{bench.servers['adapter'].address}/{address}"


# --- resource names ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("resource", "link", "address"),
    [
        ("prologix://192.0.2.10:1234/22", "TCPIP0::192.0.2.10::1234::SOCKET", 22),
        ("prologix://gpib-adapter/9", "TCPIP0::gpib-adapter::1234::SOCKET", 9),
        ("prologix:///dev/ttyUSB0/0", "ASRL/dev/ttyUSB0::INSTR", 0),
        ("prologix:///dev/serial/by-id/usb-Prologix/30", "ASRL/dev/serial/by-id/usb-Prologix::INSTR", 30),
        ("prologix://COM3/22", "ASRL3::INSTR", 22),
    ],
)
def test_a_resource_names_adapter_and_address(resource: str, link: str, address: int) -> None:
    assert parse(resource) == (link, address)


@pytest.mark.parametrize(
    "resource",
    ["prologix://host:1234", "prologix://host/31", "prologix://host/x", "prologix:host/22", "prologix:///22"],
)
def test_a_resource_of_another_form_says_how_to_write_it(resource: str) -> None:
    with pytest.raises(WireError, match=r"prologix://192\.0\.2\.10:1234/22"):
        parse(resource)
    with pytest.raises(InstrumentLost, match="not a valid address; write it like"):
        MessageSession("v", resource).open()


# --- a bench of three meters ------------------------------------------------------------------------


def test_three_meters_take_long_readings_together() -> None:
    """64 samples of 100 cycles, twice for autozero, take 256 s; the adapter waits 1 s at a time."""
    bus = Bus()
    with served(bus) as bench, ExitStack() as stack:
        drivers = []
        for channel, address in ADDRESSES.items():
            wire = MessageSession(f"voltmeter.{channel}", resource(bench, address), timeout_s=5.0)
            driver = Driver(wire.name, channel, wire, bus.world.clock, interface="gpib")
            stack.callback(driver.close)
            drivers.append(driver)
        for driver in drivers:
            assert driver.open().model == "34401A"
            driver.configure(VoltmeterSettings(10.0, 100.0, 64))
        assert len(bench.servers["adapter"]._clients) == 1
        for turn in (1, 2):
            bus.world.turn(np.radians(45.0 * turn), 1)
            for driver in drivers:
                driver.start()
            samples = {}
            for driver in drivers:
                samples.update(driver.fetch())
            for channel in ADDRESSES:
                assert samples[channel] == pytest.approx([bus.world.signal_v(channel)] * 64, abs=1e-8)
            assert bus.world.clock.now_s() == pytest.approx(turn * 64 * 4.0015, abs=0.1)
        for meter in bus.meters.values():
            assert meter.handle(b"SYST:ERR?") == NO_ERROR.encode()
        assert bus.adapter.settings.auto == 0
        assert bus.adapter.writes_to_memory == 0


def test_threads_get_the_answers_of_their_own_instruments() -> None:
    bus = Bus()
    wrong: list[str] = []
    with served(bus) as bench, ExitStack() as stack:
        wires = {a: stack.enter_context(session(bench, a)) for a in ADDRESSES.values()}
        for address, wire in wires.items():
            wire.open()
            wire.write(f"SAMP:COUN {address}")

        def ask(address: int) -> None:
            for _ in range(30):
                reply = wires[address].query("SAMP:COUN?")
                if reply != f"+{address}":
                    wrong.append(reply)

        together(*(partial(ask, address) for address in wires))
    assert wrong == []


def test_characters_that_mean_something_to_the_adapter_reach_the_instrument() -> None:
    bus = Bus()
    with served(bus) as bench, session(bench) as wire:
        wire.open()
        wire.write("DISP:TEXT '++A+B'")
        assert wire.query("DISP:TEXT?") == '"++A+B"'


def test_it_works_over_a_serial_port() -> None:
    if not hasattr(os, "openpty"):
        pytest.skip("this system has no pseudo-terminals")
    bus = Bus()
    with SimulatedBench(bus.world, {"adapter": bus.adapter}, with_terminals=True) as bench:
        wire = MessageSession("meter", f"prologix://{bench.terminals['adapter'].path}/23", timeout_s=5.0)
        wire.open()
        assert wire.query("*IDN?") == IDENTITY
        wire.close()


# --- what goes wrong --------------------------------------------------------------------------------


def test_a_reply_that_did_not_come_in_time_is_never_taken_for_another() -> None:
    bus = Bus()
    with served(bus) as bench, session(bench) as wire:
        wire.open()
        wire.write("VOLT:NPLC 100;:SAMP:COUN 100;:INIT")
        with pytest.raises(InstrumentLost, match="did not respond in time, at the command FETC"):
            wire.query("FETC?", timeout_s=0.0)
        assert wire.query("*IDN?") == IDENTITY
        assert wire.query("SAMP:COUN?") == "+100"
        assert wire.query("SYST:ERR?") == NO_ERROR


def test_a_link_that_broke_is_told_to_all_who_may_have_lost_a_command_with_it() -> None:
    bus = Bus()
    with served(bus) as bench, session(bench, 22) as x, session(bench, 23) as y:
        x.open()
        y.open()
        before = y.connection
        bench.servers["adapter"].drop_connections()
        with pytest.raises(InstrumentLost, match="broke the connection"):
            x.query("*IDN?")
        assert x.query("*IDN?") == IDENTITY
        with pytest.raises(InstrumentLost, match="lost the adapter's connection, at the command FETC"):
            y.query("FETC?")
        assert y.query("*IDN?") == IDENTITY
        assert y.connection != before
        assert x.query("*IDN?") == IDENTITY


def test_an_instrument_that_is_silent_costs_the_others_nothing() -> None:
    with served(Bus()) as bench, session(bench, 5, timeout_s=0.05) as silent, session(bench, 23) as y:
        silent.open()
        y.open()
        before = y.connection
        with pytest.raises(InstrumentLost, match=r"/5 did not respond in time, at the command \*IDN"):
            silent.query("*IDN?")
        assert y.query("*IDN?") == IDENTITY
        assert y.connection == before


def test_settings_that_another_power_up_lost_are_made_again() -> None:
    bus = Bus(settings=AdapterSettings(auto=1, eos=3, read_tmo_ms=1))
    with served(bus) as bench, session(bench) as wire:
        wire.open()
        assert wire.query("*IDN?") == IDENTITY
        bus.adapter.power_cycle()
        assert bus.adapter.settings.auto == 1
        bench.servers["adapter"].drop_connections()
        with pytest.raises(InstrumentLost):
            wire.query("*IDN?")
        assert wire.query("*IDN?") == IDENTITY
        assert bus.adapter.settings.auto == 0


def test_what_is_no_adapter_is_refused() -> None:
    bus = Bus()
    meter = Agilent34401A(bus.world.terminals("x"), bus.world.clock)
    with (
        SimulatedBench(bus.world, {"adapter": meter}) as bench,
        session(bench, timeout_s=0.2) as wire,
        pytest.raises(InstrumentLost, match="did not answer as a GPIB adapter; check the adapter"),
    ):
        wire.open()


def test_an_adapter_that_does_not_take_its_settings_is_refused() -> None:
    class Stubborn(GpibAdapter):
        def _command(self, name: str, arguments: list[str]) -> bytes | None:
            return super()._command(name, [] if name == "auto" else arguments)

    world = a_world()
    with (
        SimulatedBench(world, {"adapter": Stubborn(world.clock)}) as bench,
        session(bench) as wire,
        pytest.raises(InstrumentLost, match=r"answers 1 to \+\+auto, not 0"),
    ):
        wire.open()


@pytest.mark.parametrize(
    "version",
    [
        "AR488 GPIB controller, ver. 0.53.03, 08/04/2025",
        "AR488 version 6.102",
        "Prologix AR488 HRK version 6.101",
    ],
)
def test_a_compatible_adapter_is_not_told_to_write_its_memory(version: str) -> None:
    bus = Bus(version=version, settings=AdapterSettings(savecfg=0))
    with served(bus) as bench, session(bench) as wire:
        wire.open()
        assert wire.query("*IDN?") == IDENTITY
        assert bus.adapter.writes_to_memory == 0


def test_a_nul_after_each_reply_is_no_part_of_the_next() -> None:
    bus = Bus(version="Prologix GPIB-USB Controller version 6.107", nul=True)
    with served(bus) as bench, session(bench) as wire:
        wire.open()
        assert [wire.query(q) for q in ("*IDN?", "SYST:ERR?", "*IDN?")] == [IDENTITY, NO_ERROR, IDENTITY]


def test_an_adapter_that_restarts_when_its_port_is_opened_is_asked_again() -> None:
    bus = Bus()
    lost = Fault(FaultKind.SILENCE, at=1, matching="++ver", instrument="adapter")
    with (
        SimulatedBench(bus.world, {"adapter": bus.adapter}, faults=[lost]) as bench,
        session(bench, timeout_s=1.0) as wire,
    ):
        wire.open()
        assert wire.query("*IDN?") == IDENTITY


def test_closing_ends_a_long_wait_of_another_thread() -> None:
    bus = Bus()
    ended: list[BaseException] = []
    with served(bus) as bench, session(bench, 5, timeout_s=0.2) as wire:
        wire.open()
        begun = threading.Event()

        def wait() -> None:
            begun.set()
            try:
                wire.query("*IDN?", timeout_s=3600.0)
            except InstrumentLost as error:
                ended.append(error)

        thread = threading.Thread(target=wait)
        thread.start()
        begun.wait(PATIENCE_S)
        wire.close()
        thread.join(PATIENCE_S)
    assert len(ended) == 1
