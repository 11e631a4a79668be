"""Whatever a client sends, the simulated heads and chambers live on; the text is of what they understand."""

from __future__ import annotations

import random

import pytest

from sim.acutrol import AcutrolTable
from sim.chambers import EspecP300, Thermotron8800, WatlowF4T
from sim.wires.session import Dialect
from sim.zaber import ZaberStage
from tests.support.simulated_stand import a_world

WORDS = [
    word
    for line in (
        "/1 1 07 get set move abs rel home stop warnings clear pos maxspeed comm.checksum 384000 -1 :4F :",
        ":mode:position :mode:rate :demand:rate :demand:position :read:position 1, 045.000 nan inf 1e999",
        "TEMP? TEMP, S25.0 H L-45 MODE, CONSTANT RUN3 MON? *IDN? SETP1, RUNM PVAR1? STOP",
        ":SOURCE:CLOOP1:SPOINT :UNIT:TEMPERATURE? F ? ; , \x00 \xe9 \xb2",
    )
    for word in line.split(" ")
]


@pytest.mark.parametrize("kind", ["zaber", "acutrol", "espec", "f4t", "thermotron"])
def test_nothing_that_is_sent_breaks_it(kind: str) -> None:
    world = a_world()
    dialects: dict[str, Dialect] = {
        "zaber": ZaberStage(world, steps_per_degree=1000.0),
        "acutrol": AcutrolTable(world),
        "espec": EspecP300(world),
        "f4t": WatlowF4T(world),
        "thermotron": Thermotron8800(world),
    }
    dialect = dialects[kind]
    generator = random.Random(20261121)  # noqa: S311
    for _ in range(2000):
        parts = [generator.choice(WORDS) for _ in range(generator.randint(0, 5))]
        message = generator.choice(("", " ")).join(parts).encode("latin-1")
        reply = dialect.handle(message + b"9" * generator.choice((0, 0, 5000)), lambda: False)
        assert reply is None or reply.isascii()
        world.clock.sleep(generator.choice((0.0, 0.3, 2.0)))
    assert abs(world.scale_angle_rad) < 1e6
    assert -80.0 < world.chamber_c < 200.0
