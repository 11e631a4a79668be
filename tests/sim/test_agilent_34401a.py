"""The simulated 34401A against the manual: replies to the letter, settings, triggers, time, noise, accuracy."""

import re

import numpy as np
import pytest

from sim.agilent_34401a import Agilent34401A
from sim.world.chance import keyed_generator
from sim.world.clock import VirtualClock
from tests.support.simulated_stand import ask, tell

READING = re.compile(r"[+-]\d\.\d{8}E[+-]\d\d")


class Bench:
    """A source whose voltage the test sets, and the clock; it is what the meter is wired to."""

    def __init__(self, signal_v: float = 1.23456789) -> None:
        self.clock = VirtualClock()
        self.voltage_v = signal_v
        self.temperature_c = 23.0
        self.readings = 0
        self.asked_s: list[float] = []

    def signal_v(self, time_s: float | None = None) -> float:
        self.asked_s.append(self.clock.now_s() if time_s is None else time_s)
        return self.voltage_v

    def new_reading(self) -> None:
        self.readings += 1

    def random(self, purpose: str) -> np.random.Generator:
        return keyed_generator(3, purpose, self.readings)

    place = 0

    def fixed_random(self, purpose: str) -> np.random.Generator:
        return keyed_generator(3, purpose)


def a_meter(signal_v: float = 1.23456789, **options: object) -> Agilent34401A:
    bench = Bench(signal_v)
    return Agilent34401A(bench, bench.clock, **options)  # type: ignore[arg-type]


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def meter(bench: Bench) -> Agilent34401A:
    return Agilent34401A(bench, bench.clock, noise=False)


def error(meter: Agilent34401A) -> str:
    return ask(meter, "SYST:ERR?")


NO_ERROR = '+0,"No error"'


# --- formats ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "reply"),
    [
        ("*IDN?", "HEWLETT-PACKARD,34401A,0,11-5-2"),
        ("SYST:VERS?", "1994.0"),
        ("*TST?", "+0"),
        ("*OPC?", "1"),
        ("FUNC?", '"VOLT"'),
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
        ("DATA:POIN?", "+0"),
        ("DISP?", "1"),
        ("DISP:TEXT?", '""'),
        ("SYST:BEEP:STAT?", "1"),
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
        ("DISP:TEXT 'it''s 12 and more'", "DISP:TEXT?", '"it\'s 12 and "'),
        ("DISP:TEXT 'HI';TEXT:CLE", "DISP:TEXT?", '""'),
        ("SYST:BEEP:STAT OFF", "SYST:BEEP:STAT?", "0"),
    ],
)
def test_settings_are_taken_and_read_back(meter: Agilent34401A, sent: str, query: str, reply: str) -> None:
    tell(meter, sent)
    assert ask(meter, query) == reply
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    ("sent", "reply"),
    [
        ("VOLT:NPLC 101", '-222,"Data out of range"'),
        ("VOLT:RANG 1001", '-222,"Data out of range"'),
        ("VOLT:RANG 10;RES 1E-7", '+532,"Cannot achieve requested resolution"'),
        ("CONF:VOLT:DC DEF,0.1", '-221,"Settings conflict"'),
        ("CONF:VOLT:DC 2000", '-222,"Data out of range"'),
        ("SAMP:COUN 0.4", '-222,"Data out of range"'),
        ("TRIG:COUN 50001", '-222,"Data out of range"'),
        ("TRIG:DEL 3601", '-222,"Data out of range"'),
        ("DET:BAND 1", '-222,"Data out of range"'),
        ('FUNC "VOLTS"', '-224,"Illegal parameter value"'),
        ("FUNC VOLT", '-148,"Character data not allowed"'),
        ("TRIG:SOUR NEVER", '-224,"Illegal parameter value"'),
        ("CONF:VOLT:DC 1,1E-3,1", '-108,"Parameter not allowed"'),
        ("CALC:FUNC AVER", '-113,"Undefined header"'),
        ("CONF:RES 100", '-113,"Undefined header"'),
        ("*SRE 32", '-113,"Undefined header"'),
        ("ABOR", '-113,"Undefined header"'),
        ("*WAI", '-113,"Undefined header"'),
    ],
)
def test_refusals(meter: Agilent34401A, sent: str, reply: str) -> None:
    tell(meter, sent)
    assert error(meter) == reply
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    ("notation", "name"),
    [
        ("VOLT:DC", "VOLT"), ("VOLT:DC:RAT", "VOLT:RAT"), ("VOLT:AC", "VOLT:AC"), ("CURR:DC", "CURR"),
        ("CURR:AC", "CURR:AC"), ("RES", "RES"), ("FRES", "FRES"), ("FREQ", "FREQ"), ("PER", "PER"),
        ("CONT", "CONT"), ("DIOD", "DIOD"),
    ],
)  # fmt: skip
def test_every_function_is_selected_and_read(meter: Agilent34401A, notation: str, name: str) -> None:
    tell(meter, f"FUNC '{notation}'")
    assert ask(meter, "FUNC?") == f'"{name}"'
    assert READING.fullmatch(ask(meter, "READ?"))
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize("notation", ["VOLT:DC", "VOLT:AC", "CURR:DC", "CURR:AC", "RES", "FRES"])
def test_measure_configures_and_reads(meter: Agilent34401A, notation: str) -> None:
    assert READING.fullmatch(ask(meter, f"MEAS:{notation}? MAX,MAX"))
    assert ask(meter, f"{notation}:RANG?;RANG:AUTO?") == f"{ask(meter, f'{notation}:RANG? MAX')};0"
    assert READING.fullmatch(ask(meter, f"MEAS:{notation}? DEF, DEF"))
    assert ask(meter, f"{notation}:RANG:AUTO?") == "1"
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize(
    "node", ["VOLT:DC", "VOLT:AC", "CURR:DC", "CURR:AC", "RES", "FRES", "FREQ:VOLT", "PER:VOLT"]
)
def test_every_range_node_is_set_and_read(meter: Agilent34401A, node: str) -> None:
    tell(meter, f"{node}:RANG MAX")
    assert ask(meter, f"{node}:RANG:AUTO?") == "0"
    assert ask(meter, f"{node}:RANG?") == ask(meter, f"{node}:RANG? MAX")
    tell(meter, f"{node}:RANG:AUTO ON")
    assert ask(meter, f"{node}:RANG:AUTO?") == "1"
    assert error(meter) == NO_ERROR


@pytest.mark.parametrize("node", ["FREQ:APER", "PER:APER", "CURR:NPLC", "RES:NPLC", "FRES:NPLC", "CURR:RES"])
def test_every_integration_node_is_set_and_read(meter: Agilent34401A, node: str) -> None:
    tell(meter, f"{node} MIN")
    assert ask(meter, f"{node}?") == ask(meter, f"{node}? MIN")
    tell(meter, f"{node} MAX")
    assert ask(meter, f"{node}?") == ask(meter, f"{node}? MAX")
    assert error(meter) == NO_ERROR


def test_configure_brings_the_presets(meter: Agilent34401A) -> None:
    tell(meter, "INP:IMP:AUTO ON;:ZERO:AUTO OFF;:TRIG:SOUR BUS;COUN 4;DEL 1;:SAMP:COUN 9;:DET:BAND 3")
    tell(meter, "CONF:VOLT:DC 10")
    queries = "INP:IMP:AUTO?;:ZERO:AUTO?;:TRIG:SOUR?;COUN?;DEL:AUTO?;:SAMP:COUN?;:DET:BAND?"
    assert ask(meter, queries) == "0;1;IMM;+1;1;+1;+2.000000E+01"
    assert ask(meter, "VOLT:RANG:AUTO?;:VOLT:RANG?;NPLC?") == "0;+1.000000E+01;+1.000000E+01"


def test_configure_with_a_coarse_resolution_switches_autozero_off(meter: Agilent34401A) -> None:
    tell(meter, "CONF:VOLT:DC 10,1E-3")
    assert ask(meter, "VOLT:NPLC?;:ZERO:AUTO?") == "+2.000000E-02;0"
    tell(meter, "CONF:VOLT:DC DEF")
    assert ask(meter, "VOLT:RANG:AUTO?;:ZERO:AUTO?") == "1;1"


def test_a_refused_configuration_changes_nothing(meter: Agilent34401A) -> None:
    tell(meter, "CONF:VOLT:DC 1;:SAMP:COUN 5")
    tell(meter, "CONF:VOLT:DC 10,1E-9")
    assert error(meter).startswith("+532")
    assert ask(meter, "FUNC?;:VOLT:RANG?;:SAMP:COUN?") == '"VOLT";+1.000000E+00;+5'


def test_reset_restores_settings_but_keeps_errors(meter: Agilent34401A) -> None:
    tell(meter, "NONSENSE")
    tell(meter, "VOLT:RANG 1;:SAMP:COUN 5;:INIT")
    tell(meter, "*RST")
    assert ask(meter, "VOLT:RANG:AUTO?;:SAMP:COUN?;:DATA:POIN?") == "1;+1;+0"
    assert error(meter).startswith("-113")


def test_power_cycle_loses_settings_and_errors_but_not_the_beeper(meter: Agilent34401A) -> None:
    tell(meter, "NONSENSE")
    tell(meter, "VOLT:RANG 1;NPLC 100;:SYST:BEEP:STAT OFF")
    meter.power_cycle()
    assert error(meter) == NO_ERROR
    assert ask(meter, "VOLT:RANG:AUTO?;:VOLT:NPLC?;:SYST:BEEP:STAT?;*ESR?") == "1;+1.000000E+01;0;+128"


# --- interface --------------------------------------------------------------------------------------


def test_rs232_refuses_until_told_to_be_remote() -> None:
    meter = a_meter(interface="rs232")
    assert ask(meter, "*IDN?").startswith("HEWLETT-PACKARD")
    for refused in ("READ?", "VOLT:RANG 1", "FUNC?", "INIT"):
        assert tell(meter, refused) is None
        assert error(meter) == '+550,"Command not allowed in local"'
    tell(meter, "SYST:REM")
    assert READING.fullmatch(ask(meter, "READ?"))
    tell(meter, "SYST:LOC")
    assert tell(meter, "READ?") is None
    assert error(meter).startswith("+550")
    tell(meter, "SYST:RWL")
    assert ask(meter, "FUNC?") == '"VOLT"'
    meter.power_cycle()
    assert tell(meter, "FUNC?") is None


@pytest.mark.parametrize("command", ["SYST:REM", "SYST:LOC", "SYST:RWL"])
def test_gpib_refuses_the_remote_commands_and_lan_takes_them(command: str) -> None:
    gpib = a_meter(interface="gpib")
    tell(gpib, command)
    assert error(gpib) == '+514,"Command allowed only with RS-232"'
    assert READING.fullmatch(ask(gpib, "READ?"))
    lan = a_meter()
    tell(lan, command)
    assert error(lan) == NO_ERROR
    assert READING.fullmatch(ask(lan, "READ?"))


# --- triggering and memory --------------------------------------------------------------------------


def test_initiate_stores_and_fetch_hands_over_as_often_as_asked(meter: Agilent34401A, bench: Bench) -> None:
    tell(meter, "CONF:VOLT:DC 10;:SAMP:COUN 2;:TRIG:COUN 3;:INIT")
    first = ask(meter, "FETC?")
    assert first.count(",") == 5
    assert ask(meter, "FETC?") == first
    assert ask(meter, "DATA:POIN?") == "+6"
    assert bench.readings == 1


def test_what_is_not_stored_cannot_be_fetched(meter: Agilent34401A) -> None:
    tell(meter, "READ?")
    assert tell(meter, "FETC?") is None
    assert error(meter) == '-230,"Data stale"'


def test_no_bus_trigger_comes(meter: Agilent34401A) -> None:
    tell(meter, "TRIG:SOUR BUS;COUN 2;:INIT")
    assert tell(meter, "FETC?") is None
    assert error(meter) == '-230,"Data stale"'
    tell(meter, "*TRG")
    assert error(meter) == '-113,"Undefined header"'


def test_read_with_bus_trigger_is_a_deadlock(meter: Agilent34401A) -> None:
    assert tell(meter, "TRIG:SOUR BUS;:READ?") is None
    assert error(meter) == '-214,"Trigger deadlock"'


def test_initiate_twice_is_ignored_and_the_first_goes_on(meter: Agilent34401A) -> None:
    tell(meter, "INIT")
    tell(meter, "INIT")
    assert error(meter) == '-213,"Init ignored"'
    assert ask(meter, "FETC?") == "+1.23456789E+00"
    tell(meter, "TRIG:SOUR BUS;:INIT")
    assert tell(meter, "READ?") is None
    assert error(meter) == '-213,"Init ignored"'


@pytest.mark.parametrize("counts", ["SAMP:COUN 513", "SAMP:COUN 256;:TRIG:COUN 3", "TRIG:COUN INF"])
def test_initiate_needs_room_for_all_readings(meter: Agilent34401A, counts: str) -> None:
    tell(meter, f"{counts};:INIT")
    assert error(meter) == '+531,"Insufficient memory"'
    tell(meter, "SAMP:COUN 512;:TRIG:COUN 1;:VOLT:NPLC 0.02;:INIT")
    assert ask(meter, "DATA:POIN?") == "+512"
    assert error(meter) == NO_ERROR


def test_read_may_be_longer_than_the_memory_but_not_endless(meter: Agilent34401A) -> None:
    tell(meter, "VOLT:NPLC 0.02;:SAMP:COUN 600")
    assert ask(meter, "READ?").count(",") == 599
    assert tell(meter, "TRIG:COUN INF;:READ?") is None
    assert error(meter).startswith("+522")


def test_device_clear_ends_waiting_and_keeps_settings(meter: Agilent34401A) -> None:
    tell(meter, "VOLT:RANG 1;:TRIG:SOUR BUS;:INIT")
    meter.device_clear()
    tell(meter, "INIT")
    assert error(meter) == NO_ERROR
    assert ask(meter, "VOLT:RANG?;:TRIG:SOUR?") == "+1.000000E+00;BUS"


def test_device_clear_while_a_reading_is_waited_for_gives_it_up(meter: Agilent34401A) -> None:
    assert meter.handle(b"VOLT:NPLC 100;:READ?;*IDN?", interrupted=lambda: True) is None
    meter.device_clear()
    assert ask(meter, "*IDN?").startswith("HEWLETT-PACKARD")


# --- time -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "duration_s"),
    [
        ("VOLT:NPLC 10", 0.4 + 1.5e-3),
        ("VOLT:NPLC 10;:ZERO:AUTO OFF", 0.2 + 1.5e-3),
        ("VOLT:NPLC 100", 4.0 + 1.5e-3),
        ("VOLT:NPLC 1;:ZERO:AUTO OFF;:SAMP:COUN 10", 0.215),
        ("VOLT:NPLC 0.02;:ZERO:AUTO OFF", 400e-6 + 1.0e-3),
        ("VOLT:NPLC 10;:TRIG:DEL 2;:TRIG:COUN 3", 7.2),
        ("FUNC 'VOLT:AC';:DET:BAND 3", 7.003),
    ],
)
def test_a_reading_takes_its_time(
    meter: Agilent34401A, bench: Bench, settings: str, duration_s: float
) -> None:
    tell(meter, settings)
    tell(meter, "READ?")
    assert bench.clock.now_s() == pytest.approx(duration_s)


def test_line_frequency_decides_the_integration_time(bench: Bench) -> None:
    meter = Agilent34401A(bench, bench.clock, line_hz=60.0)
    tell(meter, "VOLT:NPLC 10;:READ?")
    assert bench.clock.now_s() == pytest.approx(20 / 60 + 1.5e-3)


def test_initiate_returns_at_once_and_any_other_command_waits(meter: Agilent34401A, bench: Bench) -> None:
    tell(meter, "VOLT:NPLC 10;:SAMP:COUN 5;:INIT")
    assert bench.clock.now_s() == 0.0
    assert ask(meter, "*OPC?") == "1"
    assert bench.clock.now_s() == pytest.approx(5 * 0.4015)
    ask(meter, "FETC?")
    assert bench.clock.now_s() == pytest.approx(5 * 0.4015)


def test_samples_are_taken_at_their_own_times_however_late_they_are_fetched(
    meter: Agilent34401A, bench: Bench
) -> None:
    tell(meter, "VOLT:NPLC 10;:VOLT:RANG 10;:SAMP:COUN 3;:INIT")
    bench.clock.sleep(100.0)
    ask(meter, "FETC?")
    assert bench.asked_s == pytest.approx([0.1015, 0.503, 0.9045])
    assert bench.clock.now_s() == 100.0


# --- what is read -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signal_v", "reply"),
    [(12.0, "+1.20000000E+01"), (12.01, "+9.90000000E+37"), (-12.01, "-9.90000000E+37")],
)
def test_overload_above_120_percent(signal_v: float, reply: str) -> None:
    bench = Bench(signal_v)
    meter = Agilent34401A(bench, bench.clock, noise=False)
    tell(meter, "*CLS;:VOLT:RANG 10")
    assert ask(meter, "READ?") == reply
    overloaded = reply[1:4] == "9.9"
    assert ask(meter, "*ESR?") == ("+8" if overloaded else "+0")
    assert error(meter) == NO_ERROR


def test_the_thousand_volt_range_has_no_over_range() -> None:
    bench = Bench(1001.0)
    meter = Agilent34401A(bench, bench.clock, noise=False)
    assert ask(meter, "READ?") == "+9.90000000E+37"


@pytest.mark.parametrize(
    ("before_v", "signal_v", "range_v"),
    [(5.0, 1.1, 10), (5.0, 0.99, 1), (5.0, 0.05, 0.1), (0.05, 0.119, 0.1), (0.05, 1.1, 1), (0.05, 900, 1000)],
)
def test_autorange_up_at_120_and_down_at_10_percent(before_v: float, signal_v: float, range_v: float) -> None:
    bench = Bench(before_v)
    meter = Agilent34401A(bench, bench.clock, noise=False)
    ask(meter, "READ?")
    bench.voltage_v = signal_v
    assert float(ask(meter, "READ?")) == pytest.approx(signal_v)
    assert float(ask(meter, "VOLT:RANG?")) == pytest.approx(range_v)


@pytest.mark.parametrize(("nplc", "step_v"), [("100", 3e-6), ("10", 10e-6), ("1", 30e-6), ("0.2", 1e-4)])
def test_noisy_readings_are_multiples_of_the_resolution(bench: Bench, nplc: str, step_v: float) -> None:
    meter = Agilent34401A(bench, bench.clock)
    tell(meter, f"CONF:VOLT:DC 10;:VOLT:NPLC {nplc};:SAMP:COUN 50")
    steps = np.array([float(text) / step_v for text in ask(meter, "READ?").split(",")])
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-2)


@pytest.mark.parametrize(("nplc", "sigma_v"), [("1", 8e-6), ("10", 2.5e-6), ("100", 1e-6)])
def test_noise_depends_on_the_integration_time(bench: Bench, nplc: str, sigma_v: float) -> None:
    # 2000 samples: the standard deviation is known to 1.6 %; bound 5 sigma. Rounding to a step adds
    # step²/12, on which the noise rides only in part, hence one step of slack on top.
    meter = Agilent34401A(bench, bench.clock)
    tell(meter, f"CONF:VOLT:DC 10;:VOLT:NPLC {nplc};:SAMP:COUN 2000")
    values = np.array([float(text) for text in ask(meter, "READ?").split(",")])
    step_v = {"1": 30e-6, "10": 10e-6, "100": 3e-6}[nplc]
    assert 0.5 * sigma_v < np.std(values) < np.hypot(sigma_v, step_v / 2)
    assert np.mean(values) == pytest.approx(1.23456789, abs=step_v / 2 + 5 * sigma_v / np.sqrt(2000))


def test_noise_is_keyed_by_the_reading(bench: Bench) -> None:
    say_all = "CONF:VOLT:DC 10,1E-3;:SAMP:COUN 20;:READ?"
    first = Agilent34401A(bench, bench.clock)
    sequence = [ask(first, say_all), ask(first, "READ?")]
    assert sequence[0] != sequence[1]
    bench.readings = 0
    second = Agilent34401A(bench, bench.clock)
    assert [ask(second, say_all), ask(second, "READ?")] == sequence


def test_accuracy_is_drawn_once_within_half_the_90_day_limits() -> None:
    bench = Bench(10.0)
    meter = Agilent34401A(bench, bench.clock, noise=False, accuracy="90 days")
    tell(meter, "VOLT:RANG 10")
    at_10_v = float(ask(meter, "READ?")) - 10.0
    assert float(ask(meter, "READ?")) - 10.0 == pytest.approx(at_10_v, abs=1e-12)
    bench.voltage_v = 0.0
    offset_v = float(ask(meter, "READ?"))
    bench.voltage_v = 5.0
    assert float(ask(meter, "READ?")) - 5.0 == pytest.approx((at_10_v + offset_v) / 2, abs=1.5e-7)
    assert 0.0 < abs(offset_v) <= 0.5 * 5e-6 * 10
    assert 0.0 < abs(at_10_v - offset_v) <= 0.5 * 20e-6 * 10


def test_temperature_matters_outside_23_plus_minus_5() -> None:
    bench = Bench(10.0)
    meter = Agilent34401A(bench, bench.clock, noise=False, accuracy="90 days")
    tell(meter, "VOLT:RANG 10")
    readings = {}
    for temperature_c in (18.0, 23.0, 28.0, 29.0, 30.0, 17.0):
        bench.temperature_c = temperature_c
        readings[temperature_c] = float(ask(meter, "READ?"))
    assert readings[18.0] == readings[23.0] == readings[28.0]
    per_c = readings[29.0] - readings[28.0]
    assert 0.0 < abs(per_c) <= 0.5 * (5e-6 + 1e-6) * 10
    assert readings[30.0] - readings[28.0] == pytest.approx(2 * per_c, abs=2e-7)
    assert readings[17.0] - readings[18.0] == pytest.approx(-per_c, abs=2e-7)
