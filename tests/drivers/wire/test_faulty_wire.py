"""Heads and chambers on wires that fail at random: a right value, or one of our errors; never a wrong value."""

import random
import re
from collections.abc import Callable

import pytest

from drivers.chambers import ChamberLimits
from drivers.instruments.acutrol import AcutrolHead
from drivers.instruments.espec import EspecChamber
from drivers.instruments.thermotron import ThermotronChamber
from drivers.instruments.watlow_f4t import WatlowF4TChamber
from drivers.instruments.zaber import ZaberHead
from drivers.interfaces import BenchError, DividingHead, ThermalChamber
from drivers.wire.visa import MessageSession
from sim.acutrol import AcutrolTable
from sim.chambers import EspecP300, Thermotron8800, WatlowF4T
from sim.wires.session import DROP, SILENCE, Dialect, FaultHook, WireFault
from sim.world.world import World
from sim.zaber import ZaberStage
from tests.support.motorised_heads import DEG, travel
from tests.support.simulated_stand import a_world, served

STEPS = 10000.0
TRAVEL = travel(0.002 * DEG, 20 * DEG)
LIMITS = ChamberLimits(-40.0, 85.0)
SEED = 20261121


def at_random(probability: float, generator: random.Random, spoilt: list[bytes]) -> FaultHook:
    """Spoil some of the exchanges, in every way there is, and list them."""

    def fault(message: bytes, reply: bytes | None) -> WireFault | None:
        if generator.random() > probability:
            return None
        spoilt.append(message)
        text = reply or b""
        return generator.choice(
            (
                DROP,
                SILENCE,
                WireFault.cut(reply, generator.randint(0, len(text))),
                WireFault.garble(reply),
                WireFault(lines=(text, text)),
                WireFault(lines=(b"!01 1 IDLE --", text)),
            )
        )

    return fault


HEADS: dict[str, Callable[[MessageSession, World], DividingHead]] = {
    "zaber": lambda session, world: ZaberHead(
        "head", session, world.clock, TRAVEL, steps_per_degree=STEPS, checksums=True
    ),
    "acutrol": lambda session, world: AcutrolHead("head", session, world.clock, TRAVEL),
}
CHAMBERS: dict[str, Callable[[MessageSession, World], ThermalChamber]] = {
    "espec": lambda session, world: EspecChamber("chamber", session, world.clock, LIMITS),
    "f4t": lambda session, world: WatlowF4TChamber("chamber", session, world.clock, LIMITS, output=1),
    "thermotron": lambda session, world: ThermotronChamber("chamber", session, world.clock, LIMITS),
}


def dialect(kind: str, world: World) -> Dialect:
    dialects: dict[str, Callable[[], Dialect]] = {
        "zaber": lambda: ZaberStage(world, steps_per_degree=STEPS),
        "acutrol": lambda: AcutrolTable(world),
        "espec": lambda: EspecP300(world),
        "f4t": lambda: WatlowF4T(world),
        "thermotron": lambda: Thermotron8800(world),
    }
    return dialects[kind]()


def tried(kind: str, name: str, chance: float, times: int, act: Callable[..., None]) -> None:
    """Act so many times over a wire that fails at random: what is reached is true, and each error says why not."""
    world = a_world()
    generator = random.Random(SEED)  # noqa: S311
    arrived = 0
    messages: list[str] = []
    spoilt: list[bytes] = []
    with served(
        dialect(kind, world), name, world, fault=at_random(chance, generator, spoilt), timeout_s=0.1
    ) as session:
        instrument = {**HEADS, **CHAMBERS}[kind](session, world)
        for number in range(times):
            try:
                instrument.open()
                act(instrument, world, generator, number)
            except BenchError as error:
                messages.append(str(error))
                continue
            arrived += 1
        instrument.close()
    assert arrived >= 2
    assert len(spoilt) >= 5
    assert all(re.fullmatch(rf"{name}: [^\n]+; [^\n]+", message) for message in messages)


@pytest.mark.slow
@pytest.mark.parametrize("kind", HEADS)
def test_a_head_is_where_it_says_or_says_why_not(kind: str) -> None:
    def turn(head: DividingHead, world: World, generator: random.Random, number: int) -> None:
        target_deg, direction = generator.choice(((0, 1), (45, 1), (45, -1), (360, 1), (100, -1)))
        position = head.move(target_deg * DEG, direction, f"{number}/turn")  # type: ignore[arg-type]
        assert position.angle_rad == pytest.approx(target_deg * DEG, abs=TRAVEL.tolerance_rad)
        assert position.angle_rad == pytest.approx(world.scale_angle_rad, abs=1e-8)
        assert world.direction == direction
        assert world.head_rate_rad_s == 0.0

    tried(kind, "head", 0.04, 10, turn)


@pytest.mark.slow
@pytest.mark.parametrize("kind", CHAMBERS)
def test_a_chamber_has_the_temperature_it_says_or_says_why_not(kind: str) -> None:
    def heat(chamber: ThermalChamber, world: World, generator: random.Random, number: int) -> None:
        target_c = generator.choice((-20.0, 10.0, 60.0))
        chamber.set_temperature(target_c, f"{number}/temperature")
        world.clock.sleep(3 * 3600.0)
        assert chamber.temperature(f"{number}/read") == pytest.approx(target_c, abs=0.05)
        assert world.chamber_c == pytest.approx(target_c, abs=0.05)

    tried(kind, "chamber", 0.15, 15, heat)
