"""The simulated chambers, as (sent, answered) against their manuals' text."""

import pytest

from sim.chambers import EspecP300, Thermotron8800, WatlowF4T
from sim.world.world import World
from tests.support.simulated_stand import a_world, tell

# --- Espec P300 -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        ("TEMP?", "23.0,23.0,140.0,-50.0"),
        ("MON?", "23.0,,STANDBY,0"),
        ("MODE?", "STANDBY"),
        ("ALARM?", "0"),
        ("TYPE?", "T,T,P300,140.0"),
        ("TEMP, S25.0", "OK:TEMP,S25.0"),
        ("TEMP,S25.0", "OK:TEMP,S25.0"),
        ("TEMP, S25.0 H90.0 L-45.0", "OK:TEMP,S25.0 H90.0 L-45.0"),
        ("TEMP, S150.0", "NA:DATA OUT OF RANGE"),
        ("TEMP, L30.0", "NA:DATA OUT OF RANGE"),
        ("TEMP, X25.0", "NA:PARA ERR"),
        ("MODE,CONSTANT", "OK:MODE,CONSTANT"),
        ("MODE,SLEEP", "NA:PARA ERR"),
        ("POWER,ON", "OK:POWER,ON"),
        ("KEYPROTECT,ON", "OK:KEYPROTECT,ON"),
        ("*IDN?", "NA:CMD ERR"),
        ("", "NA:CMD ERR"),
    ],
)
def test_espec_answers_as_the_manual_prints(sent: str, answered: str) -> None:
    assert tell(EspecP300(a_world()), sent) == answered


def test_espec_acts_on_its_set_point_in_constant_operation_only() -> None:
    world = a_world()
    chamber = EspecP300(world)
    tell(chamber, "TEMP, S60.0")
    world.clock.sleep(3600.0)
    assert world.chamber_c == 23.0
    tell(chamber, "MODE,CONSTANT")
    world.clock.sleep(7200.0)
    assert tell(chamber, "MON?") == "60.0,,CONSTANT,0"
    tell(chamber, "TEMP, S40.0")
    world.clock.sleep(7200.0)
    assert tell(chamber, "TEMP?") == "40.0,40.0,140.0,-50.0"
    tell(chamber, "MODE,RUN3")
    assert (tell(chamber, "MODE?"), tell(chamber, "MON?")) == ("RUN", "40.0,,RUN,0")
    tell(chamber, "POWER,OFF")
    world.clock.sleep(24 * 3600.0)
    assert tell(chamber, "MON?") == "23.0,,OFF,0"


def test_espec_lists_its_alarms() -> None:
    chamber = EspecP300(a_world())
    chamber.alarms = (3, 21)
    assert (tell(chamber, "ALARM?"), tell(chamber, "MON?")) == ("2,3,21", "23.0,,STANDBY,2")


# --- Watlow F4T -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        ((":SOURCE:CLOOP1:PVALUE?",), "23.00"),
        ((":SOURCE:CLOOP1:SPOINT 25.0", ":SOURCE:CLOOP1:SPOINT?"), "25.00"),
        ((":SOURCE:CLOOP1:SPOINT 999", ":SOURCE:CLOOP1:SPOINT?"), "23.00"),
        ((":SOURCE:CLOOP1:ERROR?",), "NONE"),
        ((":SOURCE:CLOOP1:RACTION SETPOINT", ":SOURCE:CLOOP1:RACTION?"), "SETPOINT"),
        ((":SOURCE:CLOOP1:RRATE 3.0", ":SOURCE:CLOOP1:RRATE?"), "3"),
        ((":SOURCE:CLOOP1:RSCALE HOURS", ":SOURCE:CLOOP1:RSCALE?"), "HOURS"),
        ((":OUTPUT1:STATE OFF", ":OUTPUT1:STATE?"), "OFF"),
        ((":UNIT:TEMPERATURE?",), "C"),
        ((":UNIT:TEMPERATURE F", ":SOURCE:CLOOP1:PVALUE?"), "73.40"),
        (
            (
                ":UNIT:TEMPERATURE F",
                ":SOURCE:CLOOP1:SPOINT 50",
                ":UNIT:TEMPERATURE C",
                ":SOURCE:CLOOP1:SPOINT?",
            ),
            "10.00",
        ),
        (("SYST:ERR?",), None),
        ((":SOURCE:CLOOP1:SPOINT 25.0",), None),
    ],
)
def test_f4t_answers_as_the_guide_prints(sent: tuple[str, ...], answered: str | None) -> None:
    assert tell(WatlowF4T(a_world()), *sent) == answered


def test_f4t_of_old_firmware_speaks_fahrenheit_and_does_not_say_so() -> None:
    world = a_world()
    chamber = WatlowF4T(world, old_firmware=True)
    assert tell(chamber, ":UNIT:TEMPERATURE?") is None
    assert tell(chamber, ":SOURCE:CLOOP1:PVALUE?") == "73.40"
    tell(chamber, ":SOURCE:CLOOP1:SPOINT 50")
    world.clock.sleep(7200.0)
    assert world.chamber_c == pytest.approx(10.0, abs=0.001)


# --- Thermotron -------------------------------------------------------------------------------------


def slowly(chamber: Thermotron8800, world: World, *messages: str) -> str | None:
    """Send messages a second apart; return the last reply."""
    reply = None
    for message in messages:
        reply = tell(chamber, message)
        world.clock.sleep(1.0)
    return reply


def test_thermotron_answers_and_acts_at_runm_only() -> None:
    world = a_world()
    chamber = Thermotron8800(world)
    assert slowly(chamber, world, "IDEN?") == "8800 V3.12"
    assert slowly(chamber, world, "SETP1,60.0", "SETP1?") == "60.000"
    assert slowly(chamber, world, "MODE?") == "2"
    world.clock.sleep(3600.0)
    assert slowly(chamber, world, "PVAR1?") == "23.000"
    assert slowly(chamber, world, "RUNM", "MODE?") == "16"
    world.clock.sleep(7200.0)
    assert slowly(chamber, world, "PVAR1?") == "60.000"
    assert slowly(chamber, world, "STOP", "MODE?") == "2"
    assert slowly(chamber, world, "SETP1,500.0", "SETP1?") == "60.000"
    assert slowly(chamber, world, "NONSENSE") is None


def test_thermotron_loses_what_comes_within_a_second_of_a_command() -> None:
    world = a_world()
    chamber = Thermotron8800(world)
    assert tell(chamber, "SETP1,60.0", "SETP1?") is None
    world.clock.sleep(1.0)
    assert tell(chamber, "SETP1?", "SETP1?") == "60.000"
    chamber.power_cycle()
    assert tell(chamber, "MODE?") == "2"
