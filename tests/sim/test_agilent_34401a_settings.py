"""The simulated 34401A against the manual's text: replies to the letter, settings, presets, interfaces."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.agilent_34401a.meter import Agilent34401A
from sim.world.chance import keyed_generator
from sim.world.clock import VirtualClock

READING = re.compile(r"[+-]\d\.\d{8}E[+-]\d\d")
NO_ERROR = '+0,"No error"'


class Steady:
    """A source whose voltage does not change."""

    temperature_c = 23.0

    def __init__(self, signal_v: float) -> None:
        self._signal_v = signal_v

    def signal_v(self, _time_s: float | None = None) -> float:
        return self._signal_v

    def new_reading(self) -> None:
        pass

    def random(self, purpose: str) -> np.random.Generator:
        return keyed_generator(3, purpose)

    fixed_random = random


def a_meter(signal_v: float = 1.23456789, **options: object) -> Agilent34401A:
    return Agilent34401A(Steady(signal_v), VirtualClock(), **options)  # type: ignore[arg-type]


@pytest.fixture
def meter() -> Agilent34401A:
    return a_meter(noise=False)


def say(meter: Agilent34401A, message: str) -> str | None:
    reply = meter.handle(message.encode())
    return None if reply is None else reply.decode()


def ask(meter: Agilent34401A, message: str) -> str:
    reply = say(meter, message)
    assert reply is not None, f"no reply to {message}"
    return reply


def error(meter: Agilent34401A) -> str:
    return ask(meter, "SYST:ERR?")


# --- formats ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "reply"),
    [
        ("*IDN?", "HEWLETT-PACKARD,34401A,0,11-5-2"),
        ("SYST:VERS?", "1994.0"),
        ("*TST?", "+0"),
        ("*OPC?", "1"),
        ("FUNC?", '"VOLT"'),
        ("CONF?", '"VOLT +1.000000E+01,+1.000000E-05"'),
        ("VOLT:DC:RANG?", "+1.000000E+01"),
        ("VOLT:RANG? MIN", "+1.000000E-01"),
        ("VOLT:RANG? MAX", "+1.000000E+03"),
        ("VOLT:DC:RANG:AUTO?", "1"),
        ("VOLT:DC:NPLC?", "+1.000000E+01"),
        ("VOLT:NPLC? MIN", "+2.000000E-02"),
        ("VOLT:DC:RES?", "+1.000000E-05"),
        ("VOLT:RES? MIN", "+3.000000E-06"),
        ("DET:BAND?", "+2.000000E+01"),
        ("ZERO:AUTO?", "1"),
        ("INP:IMP:AUTO?", "0"),
        ("ROUT:TERM?", "FRON"),
        ("TRIG:SOUR?", "IMM"),
        ("TRIG:DEL?", "+1.500000E-03"),
        ("TRIG:DEL:AUTO?", "1"),
        ("TRIG:COUN?", "+1"),
        ("TRIG:COUN? MAX", "+50000"),
        ("SAMP:COUN?", "+1"),
        ("CALC:FUNC?", "NULL"),
        ("CALC:STAT?", "0"),
        ("CALC:AVER:COUN?", "+0"),
        ("CALC:DBM:REF?", "+6.00000000E+02"),
        ("DATA:FEED?", '"CALC"'),
        ("DATA:POIN?", "+0"),
        ("DISP?", "1"),
        ("DISP:TEXT?", '""'),
        ("SYST:BEEP:STAT?", "1"),
        ("CAL:SEC:STAT?", "1"),
        ("CAL:COUN?", "+12"),
        ("*PSC?", "1"),
    ],
)
def test_replies_after_power_on_to_the_letter(meter: Agilent34401A, message: str, reply: str) -> None:
    assert ask(meter, message) == reply
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    ("signal_v", "reply"),
    [
        (2.34567891, "+2.34567891E+00"),
        (-0.00012, "-1.20000000E-04"),
        (0.0, "+0.00000000E+00"),
        (-11.5, "-1.15000000E+01"),
    ],
)
def test_a_noise_free_reading_carries_eight_decimals(signal_v: float, reply: str) -> None:
    meter = a_meter(signal_v, noise=False)
    assert ask(meter, "MEAS:VOLT:DC? 10") == reply


def test_several_readings_are_separated_by_commas(meter: Agilent34401A) -> None:
    assert ask(meter, "SAMP:COUN 3;:READ?") == ",".join(["+1.23456789E+00"] * 3)


def test_a_rounded_zero_keeps_the_exponent_of_its_step() -> None:
    meter = a_meter(0.0)
    assert ask(meter, "MEAS:VOLT:DC? 10,1E-3") in ("+0.00000000E-03", "+1.00000000E-03", "-1.00000000E-03")
    replies = {ask(meter, "READ?") for _ in range(20)}
    assert "+0.00000000E-03" in replies


# --- settings ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "query", "reply"),
    [
        ("VOLT:DC:NPLC 5", "VOLT:DC:NPLC?", "+1.000000E+01"),
        ("VOLT:NPLC 0.02", "VOLT:NPLC?", "+2.000000E-02"),
        ("VOLT:NPLC MAX", "VOLT:NPLC?", "+1.000000E+02"),
        ("VOLT:NPLC 10.000000", "VOLT:NPLC?", "+1.000000E+01"),
        ("SENS:VOLT:DC:RANG 5", "VOLT:RANG?", "+1.000000E+01"),
        ("VOLT:RANG 100 mV", "VOLT:RANG?", "+1.000000E-01"),
        ("VOLT:RANG MIN", "VOLT:RANG:AUTO?", "0"),
        ("VOLT:RANG 1;RES 1E-4", "VOLT:NPLC?", "+2.000000E-02"),
        ("VOLT:RANG 10;RES 20E-6", "VOLT:RES?", "+1.000000E-05"),
        ("VOLT:RANG 10;RES MIN", "VOLT:NPLC?", "+1.000000E+02"),
        ("DET:BAND 30", "DET:BAND?", "+2.000000E+01"),
        ("DET:BAND MIN", "DET:BAND?", "+3.000000E+00"),
        ("ZERO:AUTO ONCE", "ZERO:AUTO?", "0"),
        ("INP:IMP:AUTO ON", "INP:IMP:AUTO?", "1"),
        ("TRIG:SOUR EXTERNAL", "TRIG:SOUR?", "EXT"),
        ("TRIG:DEL 2.5", "TRIG:DEL?", "+2.500000E+00"),
        ("TRIG:DEL 2.5", "TRIG:DEL:AUTO?", "0"),
        ("TRIG:DEL 2.5;DEL:AUTO ON", "TRIG:DEL?", "+1.500000E-03"),
        ("TRIG:COUN INF", "TRIG:COUN?", "9.90000000E+37"),
        ("TRIG:SEQ:COUN 7", "TRIG:COUN?", "+7"),
        ("SAMP:COUN 0.5", "SAMP:COUN?", "+1"),
        ("SAMP:COUN 512", "SAMP:COUN?", "+512"),
        ("SAMP:COUN MAX", "SAMP:COUN?", "+50000"),
        ("DISP OFF", "DISP?", "0"),
        ("DISP:WIND:TEXT:DATA 'Hello, bench world'", "DISP:TEXT?", '"Hello, bench"'),
        ("DISP:TEXT 'HI';TEXT:CLE", "DISP:TEXT?", '""'),
        ("SYST:BEEP:STAT OFF", "SYST:BEEP:STAT?", "0"),
        ('DATA:FEED RDG_STORE,""', "DATA:FEED?", '""'),
        ("CALC:FUNC AVERAGE", "CALC:FUNC?", "AVER"),
        ("CALC:DBM:REF 90", "CALC:DBM:REF?", "+9.30000000E+01"),
        ("CALC:LIM:UPP 3", "CALC:LIM:UPP?", "+3.00000000E+00"),
        ("CAL:SEC:STAT OFF,HP034401", "CAL:SEC:STAT?", "0"),
    ],
)
def test_settings_are_taken_and_read_back(meter: Agilent34401A, sent: str, query: str, reply: str) -> None:
    say(meter, sent)
    assert ask(meter, query) == reply
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    ("sent", "reply"),
    [
        ("VOLT:NPLC 101", '-222,"Data out of range"'),
        ("VOLT:RANG 1001", '-222,"Data out of range"'),
        ("VOLT:RANG 10;RES 1E-7", '+532,"Cannot achieve requested resolution"'),
        ("SAMP:COUN 0.4", '-222,"Data out of range"'),
        ("TRIG:COUN 50001", '-222,"Data out of range"'),
        ("TRIG:DEL 3601", '-222,"Data out of range"'),
        ("DET:BAND 1", '-222,"Data out of range"'),
        ('FUNC "VOLTS"', '-224,"Illegal parameter value"'),
        ("FUNC VOLT", '-148,"Character data not allowed"'),
        ("TRIG:SOUR NEVER", '-224,"Illegal parameter value"'),
        ("CALC:NULL:OFFS 1", '-221,"Settings conflict"'),
        ("CAL:SEC:STAT OFF,GUESS", '+703,"Invalid secure code"'),
        ("CAL?", '+702,"Cal secured"'),
        ("CONF:CONT 1", '-108,"Parameter not allowed"'),
        ("ABOR", '-113,"Undefined header"'),
        ("*WAI", '-113,"Undefined header"'),
    ],
)
def test_refusals(meter: Agilent34401A, sent: str, reply: str) -> None:
    say(meter, sent)
    assert error(meter) == reply
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    ("notation", "name", "maximum"),
    [
        ("VOLT:DC", "VOLT", "1.000000E+03"),
        ("VOLT:DC:RAT", "VOLT:RAT", "1.000000E+03"),
        ("VOLT:AC", "VOLT:AC", "7.500000E+02"),
        ("CURR:DC", "CURR", "3.000000E+00"),
        ("CURR:AC", "CURR:AC", "3.000000E+00"),
        ("RES", "RES", "1.000000E+08"),
        ("FRES", "FRES", "1.000000E+08"),
        ("FREQ", "FREQ", "3.000000E+05"),
        ("PER", "PER", "3.333333E-01"),
    ],
)
def test_every_function_with_a_range_is_configured_measured_and_selected(
    meter: Agilent34401A, notation: str, name: str, maximum: str
) -> None:
    say(meter, f"CONF:{notation} MAX,MAX")
    assert ask(meter, "CONF?").startswith(f'"{name} +{maximum},')
    assert READING.fullmatch(ask(meter, f"MEAS:{notation}? DEF, DEF"))
    say(meter, "*RST")
    say(meter, f"FUNC '{notation}'")
    assert ask(meter, "FUNC?") == f'"{name}"'
    assert READING.fullmatch(ask(meter, "READ?"))
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize("name", ["CONT", "DIOD"])
def test_functions_without_a_range(meter: Agilent34401A, name: str) -> None:
    assert ask(meter, f"MEAS:{name}?") == "+9.90000000E+37"
    assert ask(meter, "CONF?;:FUNC?") == f'"{name}";"{name}"'
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    "node", ["VOLT:DC", "VOLT:AC", "CURR:DC", "CURR:AC", "RES", "FRES", "FREQ:VOLT", "PER:VOLT"]
)
def test_every_range_node_is_set_and_read(meter: Agilent34401A, node: str) -> None:
    say(meter, f"{node}:RANG MAX")
    assert ask(meter, f"{node}:RANG:AUTO?") == "0"
    assert ask(meter, f"{node}:RANG?") == ask(meter, f"{node}:RANG? MAX")
    say(meter, f"{node}:RANG:AUTO ON")
    assert ask(meter, f"{node}:RANG:AUTO?") == "1"
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize("node", ["FREQ:APER", "PER:APER", "CURR:NPLC", "RES:NPLC", "FRES:NPLC", "CURR:RES"])
def test_every_integration_node_is_set_and_read(meter: Agilent34401A, node: str) -> None:
    say(meter, f"{node} MIN")
    assert ask(meter, f"{node}?") == ask(meter, f"{node}? MIN")
    say(meter, f"{node} MAX")
    assert ask(meter, f"{node}?") == ask(meter, f"{node}? MAX")
    assert error(meter) == NO_ERROR


def test_configure_brings_the_presets(meter: Agilent34401A) -> None:
    say(meter, "INP:IMP:AUTO ON;:ZERO:AUTO OFF;:TRIG:SOUR BUS;COUN 4;DEL 1;:SAMP:COUN 9;:DET:BAND 3")
    say(meter, "CALC:FUNC LIM;STAT ON")
    say(meter, "CONF:VOLT:DC 10")
    queries = "INP:IMP:AUTO?;:ZERO:AUTO?;:TRIG:SOUR?;COUN?;DEL:AUTO?;:SAMP:COUN?;:DET:BAND?;:CALC:STAT?"
    assert ask(meter, queries) == "0;1;IMM;+1;1;+1;+2.000000E+01;0"
    assert ask(meter, "VOLT:RANG:AUTO?;:VOLT:RANG?;NPLC?") == "0;+1.000000E+01;+1.000000E+01"


def test_configure_with_a_coarse_resolution_switches_autozero_off(meter: Agilent34401A) -> None:
    say(meter, "CONF:VOLT:DC 10,1E-3")
    assert ask(meter, "VOLT:NPLC?;:ZERO:AUTO?") == "+2.000000E-02;0"
    say(meter, "CONF:VOLT:DC DEF")
    assert ask(meter, "VOLT:RANG:AUTO?;:ZERO:AUTO?") == "1;1"


def test_a_refused_configuration_changes_nothing(meter: Agilent34401A) -> None:
    say(meter, "CONF:VOLT:DC 1;:SAMP:COUN 5")
    say(meter, "CONF:CURR:DC 1,1E-9")
    assert error(meter).startswith("+532")
    assert ask(meter, "FUNC?;:VOLT:RANG?;:SAMP:COUN?") == '"VOLT";+1.000000E+00;+5'


def test_reset_restores_settings_but_not_masks_and_errors(meter: Agilent34401A) -> None:
    say(meter, "NONSENSE")
    say(meter, "*ESE 8;:VOLT:RANG 1;:SAMP:COUN 5;:INIT")
    say(meter, "*RST")
    assert ask(meter, "*ESE?;:VOLT:RANG:AUTO?;:SAMP:COUN?;:DATA:POIN?") == "+8;1;+1;+0"
    assert error(meter).startswith("-113")


def test_power_cycle_loses_settings_and_errors_but_not_the_beeper(meter: Agilent34401A) -> None:
    say(meter, "NONSENSE")
    say(meter, "VOLT:RANG 1;NPLC 100;:SYST:BEEP:STAT OFF;:CALC:DBM:REF 50")
    meter.power_cycle()
    assert error(meter) == NO_ERROR
    assert ask(meter, "VOLT:RANG:AUTO?;:VOLT:NPLC?;:SYST:BEEP:STAT?;:CALC:DBM:REF?;*ESR?") == (
        "1;+1.000000E+01;0;+5.00000000E+01;+128"
    )


# --- interface --------------------------------------------------------------------------------------


def test_rs232_refuses_until_told_to_be_remote() -> None:
    meter = a_meter(interface="rs232")
    assert ask(meter, "*IDN?").startswith("HEWLETT-PACKARD")
    for refused in ("READ?", "VOLT:RANG 1", "FUNC?", "INIT"):
        assert say(meter, refused) is None
        assert error(meter) == '+550,"Command not allowed in local"'
    say(meter, "SYST:REM")
    assert READING.fullmatch(ask(meter, "READ?"))
    say(meter, "SYST:LOC")
    assert say(meter, "READ?") is None
    assert error(meter).startswith("+550")
    say(meter, "SYST:RWL")
    assert ask(meter, "FUNC?") == '"VOLT"'
    meter.power_cycle()
    assert say(meter, "FUNC?") is None


@pytest.mark.parametrize("command", ["SYST:REM", "SYST:LOC", "SYST:RWL"])
def test_gpib_refuses_the_remote_commands_and_lan_takes_them(command: str) -> None:
    gpib = a_meter(interface="gpib")
    say(gpib, command)
    assert error(gpib) == '+514,"Command allowed only with RS-232"'
    assert READING.fullmatch(ask(gpib, "READ?"))
    lan = a_meter()
    say(lan, command)
    assert error(lan) == NO_ERROR
    assert READING.fullmatch(ask(lan, "READ?"))


def test_input_overflow_has_the_meters_own_number(meter: Agilent34401A) -> None:
    meter.input_overflow()
    assert error(meter) == '+521,"Input buffer overflow"'


_FRAGMENTS = st.sampled_from(
    ["CONF", "VOLT", ":", ";", "?", " ", ",", "DC", "RANG", "NPLC", "AUTO", "SAMP:COUN", "TRIG:SOUR", "BUS",
     "INIT", "READ?", "FETC?", "*TRG", "*RST", "10", "-1E", "0.02", "1E400", "MIN", "INF", "'", '"', "#H"]
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    st.one_of(
        st.binary(max_size=40), st.lists(_FRAGMENTS, max_size=12).map(lambda parts: "".join(parts).encode())
    )
)
def test_no_message_whatever_breaks_the_meter(message: bytes) -> None:
    meter = a_meter()
    reply = meter.handle(message)
    assert reply is None or b"\n" not in reply
    meter.device_clear()
    assert ask(meter, "*IDN?").startswith("HEWLETT-PACKARD")
