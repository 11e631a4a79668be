"""The Thermotron driver against the manual's text, and over a real socket with a simulated 8800."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.chambers import ChamberLimits
from drivers.instruments.thermotron import ThermotronChamber
from drivers.interfaces import (
    BadReading,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    ThermalChamber,
)
from sim.chambers import Thermotron8800
from sim.world.world import World
from tests.support.scripted_session import Clock, Pairs, ScriptedSession
from tests.support.simulated_stand import a_world, served

LIMITS = ChamberLimits(-40.0, 85.0, band_c=2.0)
OPEN: Pairs = [("IDEN?", "8800 V3.12")]
SET: Pairs = [("MODE?", "2"), ("SETP1,25.0", None), ("SETP1?", "25.000"), ("RUNM", None), ("MODE?", "16")]
READ: Pairs = [("MODE?", "16"), ("SETP1?", "25.000"), ("PVAR1?", "25.400")]


def chamber(session: object, clock: object | None = None) -> ThermotronChamber:
    return ThermotronChamber("chamber", session, clock or Clock(), LIMITS)  # type: ignore[arg-type]


def test_set_and_read_with_a_second_after_each_command() -> None:
    clock = Clock()
    script = ScriptedSession(OPEN, SET, READ, [("STOP", None), ("MODE?", "2")], clock=clock)
    c = chamber(script, clock)
    assert isinstance(c, ThermalChamber)
    assert c.open() == Identity("Thermotron", "8800", "", "V3.12")
    c.set_temperature(25.0, "1/temperature")
    assert c.temperature("2/read") == 25.4
    c.make_safe()
    c.close()
    assert script.left == []
    sent = script.sent_at_s
    for (command, at_s), (_, next_s) in zip(sent, [*sent[1:], ("", 1e9)], strict=True):
        assert command.endswith("?") or next_s - at_s >= 1.0


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("MODE?", "0")], "its mode is 0, not stopped or manual"),
        ([*SET[:2], ("SETP1?", "23.000")], "set point is 23 °C"),
        ([*SET[:4], ("MODE?", "2")], "its mode is 2, not manual"),
    ],
)
def test_a_demand_that_is_not_taken(pairs: Pairs, words: str) -> None:
    c = chamber(ScriptedSession(OPEN, pairs))
    c.open()
    with pytest.raises(InstrumentRefused, match=words):
        c.set_temperature(25.0, "1/temperature")


def test_a_controller_set_to_fahrenheit_is_noticed_when_it_cannot_be_celsius() -> None:
    c = chamber(ScriptedSession(OPEN, SET, [*READ[:2], ("PVAR1?", "140.000")]))
    c.open()
    c.set_temperature(25.0, "1/temperature")
    with pytest.raises(BadReading, match=r"140 °C, which is not plausible.*its unit"):
        c.temperature("2/read")


# --- over a real socket, with the simulated chamber --------------------------------------------------


@contextmanager
def stand(world: World) -> Iterator[tuple[ThermotronChamber, Thermotron8800]]:
    simulated = Thermotron8800(world)
    with served(simulated, "chamber", world, timeout_s=0.2) as session:
        c = chamber(session, world.clock)
        c.open()
        yield c, simulated
        c.close()


def test_the_world_follows_the_chamber() -> None:
    world = a_world()
    with stand(world) as (c, _):
        c.set_temperature(60.0, "1/temperature")
        world.clock.sleep(3 * 3600.0)
        assert c.temperature("2/read") == pytest.approx(60.0, abs=0.001)
        c.set_temperature(-10.0, "3/temperature")
        world.clock.sleep(3 * 3600.0)
        assert c.temperature("4/read") == pytest.approx(-10.0, abs=0.001)
        assert world.block_c == pytest.approx(-10.0, abs=0.01)
        c.make_safe()
        world.clock.sleep(24 * 3600.0)
        assert world.chamber_c == pytest.approx(23.0, abs=0.1)


def test_a_power_cycle_is_noticed_at_the_next_reading() -> None:
    world = a_world()
    with stand(world) as (c, simulated):
        c.set_temperature(25.0, "1/temperature")
        world.clock.sleep(3600.0)
        simulated.power_cycle()
        with pytest.raises(InstrumentRefused, match="its mode is 2, not manual"):
            c.temperature("2/read")


def test_the_simulated_controller_loses_what_comes_too_soon() -> None:
    world = a_world()
    with served(Thermotron8800(world), "chamber", world, timeout_s=0.1) as session:
        session.open()
        session.write("SETP1,50.0")
        with pytest.raises(InstrumentLost):
            session.query("SETP1?")
        world.clock.sleep(1.0)
        assert session.query("SETP1?") == "50.000"
        assert session.query("MODE?") == "2"
        world.clock.sleep(3600.0)
        assert world.chamber_c == 23.0  # not acted on until RUNM
