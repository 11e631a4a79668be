"""The Espec driver against the manual's text, and over a real socket with a simulated P300."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from drivers.chambers import ChamberLimits
from drivers.facts.espec import READ_TERMINATION, WRITE_TERMINATION
from drivers.instruments.espec import EspecChamber
from drivers.interfaces import Identity, InstrumentRefused, LimitExceeded, ThermalChamber
from sim.chambers import EspecP300
from sim.wires.session import WireFault
from sim.world.world import World
from tests.support.scripted_session import Clock, Pairs, ScriptedSession
from tests.support.simulated_stand import a_world, served

LIMITS = ChamberLimits(-40.0, 85.0, band_c=2.0)

OPEN: Pairs = [("TYPE?", "T,T,P300,150.0"), ("ROM?", "P30012.03")]
SET: Pairs = [
    ("ALARM?", "0"),
    ("MODE?", "STANDBY"),
    ("TEMP?", "26.4,23.0,140.0,-50.0"),
    ("TEMP, S25.0", "OK:TEMP,S25.0"),
    ("TEMP?", "26.4,25.0,140.0,-50.0"),
    ("MODE,CONSTANT", "OK:MODE,CONSTANT"),
    ("MODE?", "CONSTANT"),
]
READ: Pairs = [("MON?", "26.4,,CONSTANT,0"), ("TEMP?", "26.4,25.0,140.0,-50.0")]


def chamber(session: object, clock: object | None = None, limits: ChamberLimits = LIMITS) -> EspecChamber:
    return EspecChamber("chamber", session, clock or Clock(), limits)  # type: ignore[arg-type]


def swapped(pairs: Pairs, command: str, reply: str) -> Pairs:
    """Change the last reply to a command, and end there."""
    place = max(i for i, (sent, _) in enumerate(pairs) if sent == command)
    return [*pairs[:place], (command, reply)]


def test_set_and_read() -> None:
    script = ScriptedSession(OPEN, SET, READ, [("MODE,STANDBY", "OK:MODE,STANDBY"), ("MODE?", "STANDBY")])
    c = chamber(script)
    assert isinstance(c, ThermalChamber)
    assert not c.asks_person
    assert c.open() == Identity("ESPEC", "P300", "", "P30012.03")
    c.set_temperature(25.0, "1/temperature")
    assert c.temperature("2/read") == 26.4
    c.make_safe()
    c.close()
    c.close()
    assert script.left == []


def test_the_controllers_limits_hold_before_anything_is_set() -> None:
    c = chamber(ScriptedSession(OPEN, [*SET[:2], ("TEMP?", "26.4,23.0,80.0,-30.0")]))
    c.open()
    with pytest.raises(LimitExceeded, match="85 °C is outside the controller's own limits, -30 to 80 °C"):
        c.set_temperature(85.0, "1/temperature")


@pytest.mark.parametrize(
    ("command", "reply", "words"),
    [
        ("ALARM?", "2,12,31", "has the alarm 12 and 31"),
        ("MODE?", "RUN", "operation is RUN, not one that"),
        (
            "TEMP, S25.0",
            "NA:DATA OUT OF RANGE",
            "refused TEMP, S25.0 with DATA OUT OF RANGE .the value is outside",
        ),
        ("TEMP, S25.0", "NA: CONT NOT READY-2", "CONT NOT READY-2 .it cannot do that in its present state"),
        ("TEMP, S25.0", "NA:PROTECT ON", "its settings are protected"),
        ("TEMP, S25.0", "OK:TEMP,S26.0", "answers TEMP, S25.0 with 'OK:TEMP,S26.0'"),
        ("TEMP?", "26.4,23.0,140.0,-50.0", "set point is 23 °C, not the 25 °C demanded"),
        ("MODE?", "STANDBY", "operation is STANDBY, not CONSTANT"),
    ],
)
def test_a_demand_that_is_not_taken(command: str, reply: str, words: str) -> None:
    pairs = [*SET[:1], ("MODE?", reply)] if reply == "RUN" else swapped(SET, command, reply)
    script = ScriptedSession(OPEN, pairs)
    c = chamber(script)
    c.open()
    with pytest.raises(InstrumentRefused, match=words):
        c.set_temperature(25.0, "1/temperature")
    assert script.left == []


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("MON?", "26.4,,CONSTANT,1"), ("ALARM?", "1,7")], "has the alarm 7"),
        ([("MON?", "26.4,,STANDBY,0"), READ[1]], "operation is STANDBY, not CONSTANT"),
        ([READ[0], ("TEMP?", "26.4,30.0,140.0,-50.0")], "set point is 30 °C"),
        ([READ[0], ("TEMP?", "29.4,25.0,140.0,-50.0")], "the air is at 29.4 °C"),
    ],
)
def test_a_temperature_is_not_read_from_a_chamber_in_trouble(pairs: Pairs, words: str) -> None:
    c = chamber(ScriptedSession(OPEN, SET, pairs))
    c.open()
    c.set_temperature(25.0, "1/temperature")
    with pytest.raises(InstrumentRefused, match=words):
        c.temperature("2/read")


# --- over a real socket, with the simulated chamber --------------------------------------------------


@contextmanager
def stand(
    world: World, fault: Callable[[bytes, bytes | None], WireFault | None] | None = None, **options: float
) -> Iterator[tuple[EspecChamber, EspecP300]]:
    simulated = EspecP300(world, **options)
    with served(
        simulated,
        "chamber",
        world,
        read_termination=READ_TERMINATION,
        write_termination=WRITE_TERMINATION,
        fault=fault,
    ) as session:
        c = chamber(session, world.clock)
        c.open()
        yield c, simulated
        c.close()


def test_the_noise_of_the_sensor_belongs_to_the_step() -> None:
    def shown() -> list[float]:
        world = a_world()
        with stand(world, noise_c=0.5) as (c, _):
            world.begin_step("7/read")
            return [c.temperature("7/read") for _ in range(4)]

    values = shown()
    assert len(set(values)) > 1
    assert shown() == values
