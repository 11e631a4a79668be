"""What real benches add: a loaded input, mains, drift, 1/f noise, a real serial port, air that rings."""

import math
import re
import socket

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drivers.facts import agilent_34401a as facts
from sim.agilent_34401a import Agilent34401A
from sim.voltmeters import Converter
from sim.wires.server import TcpServer
from sim.wires.session import ServedInstrument
from sim.world.world import Heat
from tests.support.simulated_stand import a_world, ask, tell


def a_meter(world=None, **options):
    world = world or a_world()
    return Agilent34401A(world.terminals("x"), world.clock, noise=False, **options)


def read(meter, *settings):
    return float(ask(meter, "READ?") if not settings else (tell(meter, *settings), ask(meter, "READ?"))[1])


# --- the input --------------------------------------------------------------------------------------


def test_a_source_of_2_kilohm_is_loaded_by_10_megohm_and_not_by_the_high_impedance():
    truth = read(a_meter(), "CONF:VOLT:DC 10")
    loaded = a_meter(flaws={"source_ohm": 2000.0})
    assert read(loaded, "CONF:VOLT:DC 10") == pytest.approx(truth / (1 + 2e3 / 10e6), rel=1e-8)
    assert read(loaded, "INP:IMP:AUTO ON") == pytest.approx(truth, rel=3e-7)
    assert read(loaded, "CONF:VOLT:DC 100", "INP:IMP:AUTO ON") == pytest.approx(truth / 1.0002, rel=1e-8)


@pytest.mark.parametrize("nplc", [0.02, 0.2, 1.0, 10.0])
def test_the_mains_average_out_over_whole_cycles_alone(nplc):
    world = a_world()
    world.clock.sleep(0.0123)
    clean, mains = a_meter(world), a_meter(world, flaws={"mains_v": 3e-3})
    settings = ("CONF:VOLT:DC 10", f"VOLT:DC:NPLC {nplc}")
    differences = []
    for _ in range(20):
        world.clock.sleep(0.0071)
        begun_s = world.clock.now_s()
        value = read(mains, *settings)
        world.clock.return_to(begun_s)
        differences.append(value - read(clean, *settings))
    if nplc >= 1.0:
        assert np.max(np.abs(differences)) == 0.0
    else:
        aperture = {0.02: 400e-6, 0.2: 3e-3}[nplc]
        most = 3e-3 * np.sinc(50.0 * aperture)  # the mean of a sine over the aperture
        assert 0.7 * most < np.max(np.abs(differences)) <= most * (1 + 1e-4)


def test_the_zero_drifts_with_autozero_off():
    meter = a_meter(world := a_world(), flaws={"zero_drift_v_s": 1e-6})
    tell(meter, "CONF:VOLT:DC 10", "ZERO:AUTO OFF")
    first = read(meter)
    world.clock.sleep(100.0)
    assert read(meter) - first == pytest.approx(1e-4, abs=2e-6)
    tell(meter, "ZERO:AUTO ON")
    assert read(meter) == pytest.approx(read(a_meter(world), "CONF:VOLT:DC 10"), abs=1e-8)


def test_the_1_f_noise_has_the_stated_power_in_each_decade():
    """Four sines of random frequency in each of five decades: variance 5 · deviation² within the seen time."""
    converter = Converter(a_world().terminals("x"), facts, noise=False, accuracy=None, line_hz=50.0)
    seen = [converter._flicker("voltmeter flicker", 1e-6, t) for t in np.linspace(0.0, 3e6, 4001)]
    assert np.var(seen) == pytest.approx(5e-12, rel=0.1)  # 20 sines, 4001 unequal phases


def test_noise_of_the_reference_is_a_fraction_of_the_signal():
    """The fraction depends on meter and time alone: a reading of half the voltage changes by the same fraction."""
    world = a_world()
    clean, noisy = a_meter(world), a_meter(world, flaws={"reference_flicker": 1e-3})
    half = a_meter(world, flaws={"reference_flicker": 1e-3, "source_ohm": 10e6})
    for meter in (clean, noisy, half):
        tell(meter, "CONF:VOLT:DC 10")
    parts = []
    for _ in range(2):
        world.clock.sleep(500.0)
        begun_s, values = world.clock.now_s(), []
        for meter in (clean, noisy, half):
            world.clock.return_to(begun_s)
            values.append(read(meter))
        parts.append(values[1] / values[0] - 1.0)
        assert 2.0 * values[2] == pytest.approx(values[1], abs=4e-8)
    assert abs(parts[0] - parts[1]) > 1e-4
    assert np.max(np.abs(parts)) < 20 * math.sqrt(0.5) * 1e-3


# --- port and firmware ------------------------------------------------------------------------------


@pytest.mark.parametrize(("firmware", "end"), [("11-5-2", ""), ("3-1-1", ",")])
def test_an_early_version_prints_a_comma_after_the_last_reading(firmware, end):
    meter = a_meter(firmware=firmware)
    assert ask(meter, "*IDN?") == f"HEWLETT-PACKARD,34401A,0,{firmware}"
    assert re.fullmatch(facts.READING + end, ask(meter, "READ?"))
    tell(meter, "SAMP:COUN 3", "INIT")
    assert ask(meter, "FETC?").count(",") == 2 + len(end)


def test_errors_of_an_adapter_stand_in_the_queue_after_each_switch_on():
    meter = a_meter(errors_at_start=(-113, -420))
    for _ in range(2):
        assert [int(ask(meter, "SYST:ERR?").split(",")[0]) for _ in range(3)] == [-113, -420, 0]
        meter.power_cycle()


def test_a_real_serial_port_is_silent_after_ten_idle_minutes():
    meter = a_meter(world := a_world(), interface="rs232", real_port=True)
    assert ask(meter, "*IDN?")
    world.clock.sleep(601.0)
    assert tell(meter, "*IDN?") is None
    assert tell(meter, "SYST:REM", "*IDN?") is not None


def test_a_real_serial_port_loses_what_comes_before_the_reply_and_long_lines():
    with TcpServer(ServedInstrument(a_meter(interface="rs232", real_port=True))) as server:
        host, port = server.address.split(":")
        with socket.create_connection((host, int(port)), 5.0) as wire, wire.makefile("rb") as replies:
            wire.sendall(b"SYST:REM\n*IDN?\nSAMP:COUNT 7\nSAMP:COUN?\n")
            assert b"34401A" in replies.readline()
            wire.sendall(b"\nSYST:ERR?\n")
            while b"+521" not in (line := replies.readline()):
                assert line
            wire.sendall(b"SAMP:COUN?\n")
            assert replies.readline() == b"+1\n"
            wire.sendall(b"*CLS\n")
            wire.sendall(b"DISP:TEXT '" + b"A" * 110 + b"'\n")
            wire.sendall(b"SYST:ERR?\n")
            assert b"+521" in replies.readline()


# --- the chamber ------------------------------------------------------------------------------------


def test_the_air_overshoots_and_rings_and_the_block_follows_as_its_equation_says():
    """Air against a damped cosine that continues value and rate; block against a numerical integration."""
    lag_s, ringing_s, rate = 240.0, 720.0, 4.0 / 60.0
    heat = Heat(0.0, 20.0, 750.0)
    heat.ramp_air(0.0, 60.0, rate, lag_s, ringing_s)
    end_s = 40.0 / rate
    before, after = heat.air_c(end_s - 1e-3), heat.air_c(end_s + 1e-3)
    assert after - before == pytest.approx(2e-3 * rate * (1 - math.exp(-end_s / lag_s)), rel=0.01)
    times_s = np.arange(0.0, 3.0 * 3600.0, 5.0)
    air_c = np.array([heat.air_c(t) for t in times_s])
    assert 61.0 < air_c.max() < 68.0
    beyond = np.flatnonzero(np.diff(air_c[times_s > end_s] > 60.0))
    assert np.diff(times_s[times_s > end_s][beyond])[:3] == pytest.approx(ringing_s / 2.0, abs=10.0)

    solved = solve_ivp(
        lambda t, c: (heat.air_c(t) - c) / 750.0, (0.0, times_s[-1]), [20.0], t_eval=times_s, max_step=20.0,
        rtol=1e-9, atol=1e-9,
    )  # fmt: skip
    assert np.abs([heat.block_c(t) for t in times_s] - solved.y[0]).max() < 1e-3
