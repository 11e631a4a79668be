"""The simulated 34970A: channel lists, scanning in time, memory, reading formats."""

import numpy as np
import pytest

from sim.keysight_34970a import Keysight34970A
from sim.world.chance import keyed_generator
from sim.world.clock import VirtualClock
from tests.support.simulated_stand import ask, tell

NO_ERROR = '+0,"No error"'
XYZ = "(@101:103)"


class Ramp:
    """A voltage that shows when it was sampled: `offset_v` and 1 mV for each second."""

    temperature_c = 23.0

    def __init__(self, clock: VirtualClock, offset_v: float) -> None:
        self.clock = clock
        self.offset_v = offset_v
        self.readings = 0

    def signal_v(self, time_s: float | None = None) -> float:
        return self.offset_v + 1e-3 * (self.clock.now_s() if time_s is None else time_s)

    def new_reading(self) -> None:
        self.readings += 1

    def random(self, purpose: str) -> np.random.Generator:
        return keyed_generator(3, purpose, self.offset_v, self.readings)

    place = 0

    def fixed_random(self, purpose: str) -> np.random.Generator:
        return keyed_generator(3, purpose, self.offset_v)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def meter(clock: VirtualClock) -> Keysight34970A:
    return a_meter(clock)


def a_meter(clock: VirtualClock, noise: bool = False, **options: object) -> Keysight34970A:
    wiring = {101: Ramp(clock, 1.0), 102: Ramp(clock, 2.0), 103: Ramp(clock, 3.0)}
    return Keysight34970A(wiring, clock, noise=noise, **options)  # type: ignore[arg-type]


def volts(meter: Keysight34970A, message: str) -> list[float]:
    return [float(text) for text in ask(meter, message).split(",")]


# --- settings ---------------------------------------------------------------------------------------


def test_configure_presets_its_channels_and_makes_them_the_scan_list(meter: Keysight34970A) -> None:
    tell(meter, f"CONF:VOLT:DC 10,{XYZ};:VOLT:NPLC 100,{XYZ};:INP:IMP:AUTO ON,{XYZ};:ROUT:CHAN:DEL 1,{XYZ}")
    tell(meter, "FORM:READ:TIME ON;:TRIG:COUN 4")
    tell(meter, "CONF:VOLT:DC 1,(@102,101)")
    assert ask(meter, "ROUT:SCAN?") == "#210(@101,102)"
    assert ask(meter, f"VOLT:DC:RANG? {XYZ}") == "+1.00000000E+00,+1.00000000E+00,+1.00000000E+01"
    assert ask(meter, f"VOLT:DC:NPLC? {XYZ}") == "+1.00000000E+00,+1.00000000E+00,+1.00000000E+02"
    assert ask(meter, f"INP:IMP:AUTO? {XYZ}") == "0,0,1"
    assert ask(meter, f"ROUT:CHAN:DEL? {XYZ}") == "+2.00000000E-03,+2.00000000E-03,+1.00000000E+00"
    assert ask(meter, "FORM:READ:TIME?;:TRIG:COUN?") == "0;+1.00000000E+00"
    assert ask(meter, "SYST:ERR?") == NO_ERROR


def test_the_scan_list_is_scanned_in_rising_order_each_channel_once(meter: Keysight34970A) -> None:
    tell(meter, "ROUT:SCAN (@103,101,102,101)")
    assert ask(meter, "ROUT:SCAN?") == "#214(@101,102,103)"
    tell(meter, "ROUT:SCAN (@)")
    assert ask(meter, "ROUT:SCAN?") == "#13(@)"


def test_settings_without_a_list_are_those_of_the_scan_list(meter: Keysight34970A) -> None:
    tell(meter, "ROUT:SCAN (@101,102);:VOLT:DC:NPLC 20")
    assert ask(meter, f"VOLT:DC:NPLC? {XYZ}") == "+2.00000000E+01,+2.00000000E+01,+1.00000000E+00"


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("ROUT:SCAN (@201)", '+302,"No module was detected in this slot"'),
        ("ROUT:SCAN (@123)", '+304,"Does not exist"'),
        ("ROUT:SCAN (@101:140)", '+304,"Does not exist"'),
        ("ROUT:SCAN 101", '+309,"Incorrectly formatted channel list"'),
        ("ROUT:SCAN (@1x1)", '+309,"Incorrectly formatted channel list"'),
        ("CONF:VOLT:DC 10", '-109,"Missing parameter"'),
        (f"CONF:VOLT:DC 301,{XYZ}", '-222,"Data out of range"'),
        (f"CONF:VOLT:DC 10,1E-9,{XYZ}", '+532,"Cannot achieve requested resolution"'),
        (f"ROUT:CHAN:DEL 61,{XYZ}", '-222,"Data out of range"'),
        ("VOLT:DC:NPLC 1", '+305,"Not able to perform requested operation"'),
        ("INIT", '+305,"Not able to perform requested operation"'),
        ("FETC?", '-230,"Data stale"'),
        ("SYST:CTYP? 400", '-222,"Data out of range"'),
        ("ROUT:CLOS (@101)", '-113,"Undefined header"'),
        ("READ?", '-113,"Undefined header"'),
    ],
)
def test_mistakes(meter: Keysight34970A, command: str, error: str) -> None:
    assert tell(meter, command) is None
    assert ask(meter, "SYST:ERR?") == error


def test_cards(clock: VirtualClock) -> None:
    meter = a_meter(clock, cards={100: "34901A", 300: "34901A"})
    assert ask(meter, "SYST:CTYP? 100") == "HEWLETT-PACKARD,34901A,0,2.3"
    assert ask(meter, "SYST:CTYP? 200") == "HEWLETT-PACKARD,0,0,0"
    with pytest.raises(ValueError, match="not all on cards in the slots 100"):
        Keysight34970A({201: Ramp(clock, 0.0)}, clock)


# --- scanning ---------------------------------------------------------------------------------------


def test_channels_are_sampled_one_after_another(meter: Keysight34970A, clock: VirtualClock) -> None:
    """Relay 4 ms, delay 100 ms, 10 cycles at 50 Hz read in their middle, then as long again for the zero."""
    tell(meter, f"CONF:VOLT:DC 10,{XYZ};:VOLT:DC:NPLC 10,{XYZ};:ROUT:CHAN:DEL 0.1,{XYZ};:TRIG:COUN 2")
    tell(meter, "INIT")
    assert clock.now_s() == 0.0
    readings = volts(meter, "FETC?")
    times_s = [(v - offset) * 1e3 for v, offset in zip(readings, [1, 2, 3, 1, 2, 3], strict=True)]
    assert times_s == pytest.approx([0.204 + i * 0.504 for i in range(6)], abs=2e-5)
    assert clock.now_s() == pytest.approx(6 * 0.504)


def test_an_open_input_reads_zero(meter: Keysight34970A) -> None:
    assert volts(meter, "CONF:VOLT:DC 10,(@104);:INIT;:FETC?") == [0.0]


def test_readings_carry_what_the_format_asks_for(meter: Keysight34970A) -> None:
    tell(meter, "CONF:VOLT:DC 10,(@103);:FORM:READ:UNIT ON;TIME ON;CHAN ON;ALAR ON")
    assert ask(meter, "INIT;:FETC?") == "+3.00001600E+00 VDC,000000000.016,103,0"


def test_a_scan_under_way_is_not_started_again_and_a_device_clear_ends_it(
    meter: Keysight34970A, clock: VirtualClock
) -> None:
    tell(meter, f"CONF:VOLT:DC 10,{XYZ};:INIT;:INIT")
    meter.device_clear()
    assert clock.now_s() == 0.0
    assert ask(meter, "SYST:ERR?") == '-213,"Init ignored"'
    assert tell(meter, "FETC?") is None


def test_overload(meter: Keysight34970A) -> None:
    tell(meter, f"CONF:VOLT:DC 1,{XYZ}")
    assert volts(meter, "INIT;:FETC?")[1:] == [9.9e37, 9.9e37]
    assert ask(meter, "SYST:ERR?") == NO_ERROR


def test_gain_and_offset_are_the_meters_and_noise_is_each_readings(clock: VirtualClock) -> None:
    same = Ramp(clock, 5.0)
    wiring = {101: same, 102: same}
    exact = Keysight34970A(wiring, clock, noise=False, accuracy="90 days")
    errors_v = [
        v - 5.0 - 1e-3 * 0.0 for v in volts(exact, "CONF:VOLT:DC 10,(@101,102);:VOLT:NPLC 0.02;:INIT;:FETC?")
    ]
    assert errors_v[0] == pytest.approx(errors_v[1], abs=2e-5)
    assert 1e-6 < abs(errors_v[0]) < 2e-4
    noisy = a_meter(clock, noise=True)
    tell(noisy, "CONF:VOLT:DC 10,(@101);:VOLT:NPLC 1;:TRIG:COUN 200")
    assert 5e-6 < np.std(np.diff(volts(noisy, "INIT;:FETC?")) - 1e-3 * 0.046) < 5e-5
