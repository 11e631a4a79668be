"""The simulated GPIB adapter against its manual, and under another library."""

import pytest
import pyvisa

from drivers.interfaces import Channel
from sim.wires.prologix import UNRECOGNIZED, AdapterSettings
from tests.support.gpib_bus import IDENTITY, NO_ERROR, Bus, served


def tell(bus: Bus, *lines: str | bytes) -> list[bytes]:
    replies = [bus.adapter.handle(line.encode() if isinstance(line, str) else line) for line in lines]
    return [reply for reply in replies if reply is not None]


def quiet_bus() -> Bus:
    bus = Bus(settings=AdapterSettings(addr=22, auto=0, eos=2))
    for meter in bus.meters.values():
        meter.events.take()
    return bus


def errors(bus: Bus, channel: Channel = "x") -> str:
    reply = bus.meters[channel].handle(b"SYST:ERR?")
    assert reply is not None
    return reply.decode()


def test_settings_are_set_asked_and_bounded() -> None:
    bus = quiet_bus()
    assert tell(bus, "++read_tmo_ms 3000", "++read_tmo_ms", "++eos", "++mode") == [b"3000\r", b"2\r", b"1\r"]
    wrong = ["++read_tmo_ms 3001", "++addr 31", "++eoi x", "++nothing", "++spoll"]
    assert tell(bus, *wrong) == [UNRECOGNIZED] * 5
    assert tell(bus, "++ver")[0].startswith(b"Prologix GPIB-ETHERNET")


def test_a_read_gives_up_after_its_timeout_and_the_reply_comes_with_a_later_one() -> None:
    bus = quiet_bus()
    tell(bus, "++read_tmo_ms 3000", "VOLT:NPLC 100", "INIT", "FETC?")
    clock = bus.world.clock
    assert clock.now_s() == 0.0
    assert tell(bus, "++read eoi") == []
    assert clock.now_s() == 3.0
    (reply,) = tell(bus, "++read eoi")
    assert float(reply) == pytest.approx(bus.world.signal_v("x"), abs=1e-8)
    assert clock.now_s() == pytest.approx(4.0015)
    assert errors(bus) == NO_ERROR


def test_read_after_write_addresses_an_instrument_that_has_nothing_to_say() -> None:
    bus = quiet_bus()
    assert tell(bus, "++auto 1", "*IDN?", "*CLS") == [IDENTITY.encode()]
    assert errors(bus) == '-420,"Query UNTERMINATED"'


def test_a_command_before_the_reply_was_read_interrupts_it() -> None:
    bus = quiet_bus()
    assert tell(bus, "*IDN?", "FUNC?", "++read eoi") == [b'"VOLT"']
    assert errors(bus) == '-410,"Query INTERRUPTED"'


def test_device_clear_reaches_the_addressed_instrument_alone() -> None:
    bus = quiet_bus()
    tell(bus, "VOLT:NPLC 100", "READ?", "++addr 23", "*IDN?", "++addr 22", "++clr")
    assert tell(bus, "*IDN?", "++read eoi") == [IDENTITY.encode()]
    assert bus.world.clock.now_s() == 0.0
    assert tell(bus, "++addr 23", "++read eoi") == [IDENTITY.encode()]


def test_without_terminator_and_eoi_a_message_goes_on_in_the_next_line() -> None:
    bus = quiet_bus()
    tell(bus, "++eos 3", "++eoi 0", "SAMP:COUN", " 5", "++eos 2", "", "0")
    assert tell(bus, "SAMP:COUN?", "++read eoi") == [b"+50"]


def test_escaped_characters_are_data() -> None:
    bus = quiet_bus()
    tell(bus, b"SAMP:COUN \x1b+3\x1b", b"\x1b\x1b")
    assert errors(bus).startswith("-101")
    assert tell(bus, "SAMP:COUN?", "++read eoi") == [b"+3"]
    assert tell(bus, b"\x1b+\x1b+addr 5", "++addr") == [b"22\r"]


def test_the_end_of_a_message_is_marked_when_asked_for() -> None:
    bus = quiet_bus()
    assert tell(bus, "++eot_enable 1", "*IDN?", "++read eoi") == [IDENTITY.encode() + b"\n"]


def test_settings_are_saved_while_savecfg_is_on() -> None:
    bus = quiet_bus()
    tell(bus, "++read_tmo_ms 500", "++savecfg 0", "++read_tmo_ms 900")
    assert bus.adapter.writes_to_memory == 1
    bus.adapter.power_cycle()
    assert tell(bus, "++read_tmo_ms") == [b"500\r"]


def test_an_address_is_one_instruments() -> None:
    bus = quiet_bus()
    with pytest.raises(ValueError, match="taken"):
        bus.adapter.attach(22, bus._meter("x"))


def test_the_library_s_own_adapter_support_works_on_it() -> None:
    bus = Bus()
    manager = pyvisa.ResourceManager("@py")
    with served(bus) as bench:
        port = bench.servers["adapter"].port
        board = manager.open_resource(f"PRLGX-TCPIP::127.0.0.1::{port}::INTFC")
        try:
            meter = manager.open_resource("GPIB0::23::INSTR")
            assert meter.query("*IDN?").strip() == IDENTITY  # type: ignore[attr-defined]
            meter.close()
        finally:
            board.close()
