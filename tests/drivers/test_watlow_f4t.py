"""The F4T driver against the guide's text, and over a real socket with a simulated controller."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest

from drivers.chambers import ChamberLimits
from drivers.instruments.watlow_f4t import WatlowF4TChamber
from drivers.interfaces import Identity, InstrumentLost, InstrumentRefused, ThermalChamber
from sim.chambers import WatlowF4T
from sim.world.world import World
from tests.support.scripted_session import Clock, Pairs, ScriptedSession
from tests.support.simulated_stand import a_world, served

LIMITS = ChamberLimits(-40.0, 85.0, band_c=2.0)
LOOP = ":SOURCE:CLOOP1"
CELSIUS: Pairs = [(":UNIT:TEMPERATURE?", "C")]
FAHRENHEIT: Pairs = [(":UNIT:TEMPERATURE?", "F")]
IDENTITY = ("*IDN?", "Watlow Electric,F4T,12345,04:07:0011")
NO_ERROR = (f"{LOOP}:ERROR?", "NONE")


def chamber(session: object, clock: object | None = None, **options: object) -> WatlowF4TChamber:
    return WatlowF4TChamber("chamber", session, clock or Clock(), LIMITS, **options)  # type: ignore[arg-type]


def test_set_and_read_in_celsius_with_an_output_and_a_second_after_each_write() -> None:
    clock = Clock()
    script = ScriptedSession(
        [IDENTITY, *CELSIUS],
        [NO_ERROR, *CELSIUS, (f"{LOOP}:SPOINT 25.00", None), *CELSIUS, (f"{LOOP}:SPOINT?", "25.0")],
        [(":OUTPUT1:STATE ON", None), (":OUTPUT1:STATE?", "ON")],
        [NO_ERROR, *CELSIUS, (f"{LOOP}:SPOINT?", "25.0"), (":OUTPUT1:STATE?", "ON")],
        [*CELSIUS, (f"{LOOP}:PVALUE?", "24.62")],
        [(":OUTPUT1:STATE OFF", None), (":OUTPUT1:STATE?", "OFF")],
        clock=clock,
    )
    c = chamber(script, clock, output=1)
    assert isinstance(c, ThermalChamber)
    assert c.open() == Identity("Watlow Electric", "F4T", "12345", "04:07:0011")
    c.set_temperature(25.0, "1/temperature")
    assert c.temperature("2/read") == 24.62
    c.make_safe()
    c.close()
    assert script.left == []
    gaps_s = [after - before for (sent, before), (_, after) in pairwise(script.sent_at_s) if "?" not in sent]
    assert gaps_s == pytest.approx([1.0, 1.0, 1.0])


def test_a_controller_that_says_it_speaks_fahrenheit_is_spoken_to_so() -> None:
    script = ScriptedSession(
        [IDENTITY, *FAHRENHEIT],
        [NO_ERROR, *FAHRENHEIT, (f"{LOOP}:SPOINT 77.00", None), *FAHRENHEIT, (f"{LOOP}:SPOINT?", "77.0")],
        [NO_ERROR, *FAHRENHEIT, (f"{LOOP}:SPOINT?", "77.0"), *FAHRENHEIT, (f"{LOOP}:PVALUE?", "76.1")],
    )
    c = chamber(script)
    c.open()
    c.set_temperature(25.0, "1/temperature")
    assert c.temperature("2/read") == pytest.approx(24.5)


@pytest.mark.parametrize(
    "answers", [[InstrumentLost("chamber", "it did not answer", "wait")], ["?", "?", "?"]]
)
def test_a_controller_that_does_not_tell_its_unit_is_refused(answers: list[str | BaseException]) -> None:
    pairs: Pairs = [IDENTITY, *((":UNIT:TEMPERATURE?", answer) for answer in answers)]
    with pytest.raises(
        InstrumentRefused, match=r"does not say whether it speaks °C or °F .*; update its firmware"
    ):
        chamber(ScriptedSession(pairs)).open()


# --- over a real socket, with the simulated controller -----------------------------------------------


@contextmanager
def stand(world: World, simulated: WatlowF4T, **options: object) -> Iterator[WatlowF4TChamber]:
    with served(simulated, "chamber", world, timeout_s=0.2) as session:
        c = chamber(session, world.clock, **options)
        yield c
        c.close()


@pytest.mark.parametrize("broken_sensor", [False, True])
def test_without_an_output_it_is_made_safe_by_a_demand(broken_sensor: bool) -> None:
    world = a_world()
    simulated = WatlowF4T(world)
    with stand(world, simulated, safe_c=30.0) as c:
        c.open()
        c.set_temperature(60.0, "1/temperature")
        world.clock.sleep(3 * 3600.0)
        simulated.error = broken_sensor
        c.make_safe()
        world.clock.sleep(3 * 3600.0)
        assert world.chamber_c == pytest.approx(30.0, abs=0.01)


def test_a_broken_sensor_and_a_power_cycle_are_noticed() -> None:
    world = a_world()
    simulated = WatlowF4T(world)
    with stand(world, simulated, output=1) as c:
        c.open()
        c.set_temperature(25.0, "1/temperature")
        world.clock.sleep(3600.0)
        simulated.error = True
        with pytest.raises(InstrumentRefused, match="control loop reports ERROR"):
            c.temperature("2/read")
        simulated.error = False
        simulated.power_cycle()
        with pytest.raises(InstrumentRefused, match="its output 1 is OFF, not ON"):
            c.temperature("2/read")


def test_a_simulated_controller_in_fahrenheit_is_set_and_read_in_celsius_also_once_its_unit_changes() -> None:
    world = a_world()
    simulated = WatlowF4T(world, unit="F")
    with stand(world, simulated, output=1) as c:
        c.open()
        c.set_temperature(25.0, "1/temperature")
        world.clock.sleep(3 * 3600.0)
        for unit in "FC":
            simulated.handle(f"UNIT:TEMP {unit}".encode())
            assert c.temperature("2/read") == pytest.approx(25.0, abs=0.02)
    assert world.chamber_c == pytest.approx(25.0, abs=0.02)


def test_old_firmware_which_speaks_fahrenheit_only_is_refused_on_its_wire() -> None:
    world = a_world()
    with (
        stand(world, WatlowF4T(world, old_firmware=True)) as c,
        pytest.raises(InstrumentRefused, match="°C or °F"),
    ):
        c.open()
