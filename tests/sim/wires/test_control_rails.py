"""What feeds the block is disturbed from outside."""

from __future__ import annotations

import json

import numpy as np

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.bench import SimulatedBench
from sim.wires.control import BenchControl
from sim.world.clock import VirtualClock
from sim.world.power import PowerSettings, Rail
from sim.world.world import World, WorldSettings


def control(*rails: Rail) -> tuple[World, BenchControl]:
    block = Block(np.diag([-2.2, -2.1, -2.15]), np.zeros(3))
    settings = WorldSettings(
        block, ForwardModel({"1": INSTALLATION_1}), {}, 5, power=PowerSettings(rails, in_rush=1.0)
    )
    world = World(settings, VirtualClock())
    return world, BenchControl(SimulatedBench(world, {}))


def told(of: BenchControl, command: str) -> dict[str, object]:
    return json.loads(of.handle(command.encode(), lambda: False) or b"{}")


def test_a_rail_sags_for_a_while():
    world, of = control(Rail("p15", "+", 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2))
    world.power.change("+", 0.0, set_v=15.0, limit_a=0.2, on=True)
    assert told(of, "rail sag + size=0.5 seconds=20")["ok"]
    world.clock.sleep(10.0)
    assert world.power.rail_v("p15", 10.0) == 7.5
    world.clock.sleep(20.0)
    assert world.power.rail_v("p15", 30.0) == 15.0


def test_mistakes_are_told():
    _, of = control(Rail("p15", "+", 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2))
    assert "sag" in str(told(of, "rail")["error"])
    assert "no rail" in str(told(of, "rail off P25V")["error"])
    assert "no supply" in str(told(control()[1], "rail off")["error"])
