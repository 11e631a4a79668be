"""The simulated 34401A measuring: trigger system, memory, time, range, noise, accuracy, math."""

import numpy as np
import pytest

from sim.agilent_34401a.meter import Agilent34401A
from sim.world.chance import keyed_generator
from sim.world.clock import VirtualClock


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


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def meter(bench: Bench) -> Agilent34401A:
    return Agilent34401A(bench, bench.clock, noise=False)


def say(meter: Agilent34401A, message: str) -> str | None:
    reply = meter.handle(message.encode())
    return None if reply is None else reply.decode()


def ask(meter: Agilent34401A, message: str) -> str:
    reply = say(meter, message)
    assert reply is not None, f"no reply to {message}"
    return reply


def error(meter: Agilent34401A) -> str:
    return ask(meter, "SYST:ERR?")


NO_ERROR = '+0,"No error"'


# --- triggering and memory --------------------------------------------------------------------------


def test_initiate_stores_and_fetch_hands_over_as_often_as_asked(meter: Agilent34401A, bench: Bench) -> None:
    say(meter, "CONF:VOLT:DC 10;:SAMP:COUN 2;:TRIG:COUN 3;:INIT")
    first = ask(meter, "FETC?")
    assert first.count(",") == 5
    assert ask(meter, "FETC?") == first
    assert ask(meter, "DATA:POIN?") == "+6"
    assert bench.readings == 1


def test_read_does_not_store(meter: Agilent34401A) -> None:
    ask(meter, "READ?")
    assert say(meter, "FETC?") is None
    assert error(meter) == '-230,"Data stale"'


def test_fetch_with_memory_switched_off_is_stale(meter: Agilent34401A) -> None:
    say(meter, 'DATA:FEED RDG_STORE,"";:INIT')
    assert say(meter, "FETC?") is None
    assert error(meter) == '-230,"Data stale"'


def test_bus_trigger(meter: Agilent34401A) -> None:
    say(meter, "TRIG:SOUR BUS;COUN 2;:INIT")
    assert say(meter, "FETC?") is None
    assert error(meter) == '-230,"Data stale"'
    say(meter, "*TRG")
    say(meter, "*TRG")
    assert ask(meter, "DATA:POIN?") == "+2"
    say(meter, "*TRG")
    assert error(meter) == '-211,"Trigger ignored"'


def test_read_with_bus_trigger_is_a_deadlock(meter: Agilent34401A) -> None:
    assert say(meter, "TRIG:SOUR BUS;:READ?") is None
    assert error(meter) == '-214,"Trigger deadlock"'


def test_external_trigger(meter: Agilent34401A) -> None:
    meter.external_trigger()
    assert error(meter) == '-211,"Trigger ignored"'
    say(meter, "TRIG:SOUR EXT;:INIT")
    meter.external_trigger()
    assert ask(meter, "FETC?") == "+1.23456789E+00"


def test_initiate_twice_is_ignored_and_the_first_goes_on(meter: Agilent34401A) -> None:
    say(meter, "INIT")
    say(meter, "INIT")
    assert error(meter) == '-213,"Init ignored"'
    assert ask(meter, "FETC?") == "+1.23456789E+00"
    say(meter, "TRIG:SOUR BUS;:INIT")
    assert say(meter, "READ?") is None
    assert error(meter) == '-213,"Init ignored"'


@pytest.mark.parametrize("counts", ["SAMP:COUN 513", "SAMP:COUN 256;:TRIG:COUN 3", "TRIG:COUN INF"])
def test_initiate_needs_room_for_all_readings(meter: Agilent34401A, counts: str) -> None:
    say(meter, f"{counts};:INIT")
    assert error(meter) == '+531,"Insufficient memory"'
    say(meter, "SAMP:COUN 512;:TRIG:COUN 1;:VOLT:NPLC 0.02;:INIT")
    assert ask(meter, "DATA:POIN?") == "+512"
    assert error(meter) == NO_ERROR


def test_read_may_be_longer_than_the_memory_but_not_endless(meter: Agilent34401A) -> None:
    say(meter, "VOLT:NPLC 0.02;:SAMP:COUN 600")
    assert ask(meter, "READ?").count(",") == 599
    assert say(meter, "TRIG:COUN INF;:READ?") is None
    assert error(meter).startswith("+522")
    say(meter, 'DATA:FEED RDG_STORE,"";:INIT')
    assert error(meter).startswith("+522")


def test_device_clear_ends_waiting_and_keeps_settings(meter: Agilent34401A) -> None:
    say(meter, "VOLT:RANG 1;:TRIG:SOUR BUS;:INIT")
    meter.device_clear()
    say(meter, "*TRG")
    assert error(meter) == '-211,"Trigger ignored"'
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
    say(meter, settings)
    say(meter, "READ?")
    assert bench.clock.now_s() == pytest.approx(duration_s)


def test_line_frequency_decides_the_integration_time(bench: Bench) -> None:
    meter = Agilent34401A(bench, bench.clock, line_hz=60.0)
    say(meter, "VOLT:NPLC 10;:READ?")
    assert bench.clock.now_s() == pytest.approx(20 / 60 + 1.5e-3)


def test_initiate_returns_at_once_and_any_other_command_waits(meter: Agilent34401A, bench: Bench) -> None:
    say(meter, "VOLT:NPLC 10;:SAMP:COUN 5;:INIT")
    assert bench.clock.now_s() == 0.0
    assert ask(meter, "*OPC?") == "1"
    assert bench.clock.now_s() == pytest.approx(5 * 0.4015)
    ask(meter, "FETC?")
    assert bench.clock.now_s() == pytest.approx(5 * 0.4015)


def test_samples_are_taken_at_their_own_times_however_late_they_are_fetched(
    meter: Agilent34401A, bench: Bench
) -> None:
    say(meter, "VOLT:NPLC 10;:VOLT:RANG 10;:SAMP:COUN 3;:INIT")
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
    say(meter, "*CLS;:VOLT:RANG 10")
    assert ask(meter, "READ?") == reply
    overloaded = reply[1:4] == "9.9"
    assert ask(meter, "*ESR?;:STAT:QUES?") == ("+8;+1" if overloaded else "+0;+0")
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
    say(meter, f"CONF:VOLT:DC 10;:VOLT:NPLC {nplc};:SAMP:COUN 50")
    steps = np.array([float(text) / step_v for text in ask(meter, "READ?").split(",")])
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-2)


@pytest.mark.parametrize(("nplc", "sigma_v"), [("1", 8e-6), ("10", 2.5e-6), ("100", 1e-6)])
def test_noise_depends_on_the_integration_time(bench: Bench, nplc: str, sigma_v: float) -> None:
    # 2000 samples: the standard deviation is known to 1.6 %; bound 5 sigma. Rounding to a step adds
    # step²/12, on which the noise rides only in part, hence one step of slack on top.
    meter = Agilent34401A(bench, bench.clock)
    say(meter, f"CONF:VOLT:DC 10;:VOLT:NPLC {nplc};:SAMP:COUN 2000")
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
    say(meter, "VOLT:RANG 10")
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
    say(meter, "VOLT:RANG 10")
    readings = {}
    for temperature_c in (18.0, 23.0, 28.0, 29.0, 30.0, 17.0):
        bench.temperature_c = temperature_c
        readings[temperature_c] = float(ask(meter, "READ?"))
    assert readings[18.0] == readings[23.0] == readings[28.0]
    per_c = readings[29.0] - readings[28.0]
    assert 0.0 < abs(per_c) <= 0.5 * (5e-6 + 1e-6) * 10
    assert readings[30.0] - readings[28.0] == pytest.approx(2 * per_c, abs=2e-7)
    assert readings[17.0] - readings[18.0] == pytest.approx(-per_c, abs=2e-7)


# --- math -------------------------------------------------------------------------------------------


def test_null_takes_the_first_reading_or_a_given_offset(meter: Agilent34401A, bench: Bench) -> None:
    say(meter, "CALC:FUNC NULL;STAT ON")
    assert float(ask(meter, "READ?")) == 0.0
    bench.voltage_v = 1.5
    assert float(ask(meter, "READ?")) == pytest.approx(1.5 - 1.23456789)
    say(meter, "CALC:NULL:OFFS 0.5")
    assert float(ask(meter, "READ?")) == pytest.approx(1.0)
    assert ask(meter, "CALC:NULL:OFFS?") == "+5.00000000E-01"


def test_average_keeps_count_and_extremes(meter: Agilent34401A, bench: Bench) -> None:
    say(meter, "CALC:FUNC AVER;STAT ON")
    for voltage_v in (1.0, 4.0, 2.5):
        bench.voltage_v = voltage_v
        ask(meter, "READ?")
    assert ask(meter, "CALC:AVER:MIN?;MAX?;AVER?;COUN?") == (
        "+1.00000000E+00;+4.00000000E+00;+2.50000000E+00;+3"
    )


def test_dbm_and_db(meter: Agilent34401A, bench: Bench) -> None:
    bench.voltage_v = np.sqrt(0.6)
    say(meter, "CALC:FUNC DBM;STAT ON")
    assert float(ask(meter, "READ?")) == pytest.approx(0.0, abs=1e-8)
    say(meter, "CALC:FUNC DB")
    ask(meter, "READ?")
    bench.voltage_v *= 10.0
    assert float(ask(meter, "READ?")) == pytest.approx(20.0)


def test_limit_test_shows_in_the_questionable_register(meter: Agilent34401A, bench: Bench) -> None:
    say(meter, "CALC:FUNC LIM;STAT ON;LIM:LOW 1;UPP 2")
    ask(meter, "READ?")
    assert ask(meter, "STAT:QUES?") == "+0"
    bench.voltage_v = 0.5
    ask(meter, "READ?")
    assert ask(meter, "STAT:QUES?") == "+2048"
    bench.voltage_v = 2.5
    ask(meter, "READ?")
    assert ask(meter, "STAT:QUES?") == "+4096"


def test_math_that_does_not_fit_the_function_is_a_settings_conflict(meter: Agilent34401A) -> None:
    say(meter, "CALC:FUNC DBM;STAT ON;:FUNC 'RES'")
    assert error(meter) == '-221,"Settings conflict"'
    assert ask(meter, "CALC:STAT?") == "0"
    say(meter, "CALC:STAT ON")
    assert error(meter) == '-221,"Settings conflict"'


def test_overload_cannot_become_the_null_reference(meter: Agilent34401A, bench: Bench) -> None:
    bench.voltage_v = 20.0
    say(meter, "VOLT:RANG 10;:CALC:STAT ON")
    assert ask(meter, "READ?") == "+9.90000000E+37"
    assert error(meter) == '+540,"Cannot use overload as math reference"'
