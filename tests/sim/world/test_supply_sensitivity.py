"""A rail that sags, and a block that is switched off and on, seen in the signals."""

import numpy as np
import pytest

from bench.model import CATALOGUE, AppliedEffect, Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.world.clock import VirtualClock
from sim.world.power import Disturbance, PowerSettings, Rail
from sim.world.world import World, WorldSettings

BLOCK = Block(np.diag([-2.0, -2.1, -2.2]), np.array([0.1, -0.2, 0.3]))
BIAS, SCALE = np.array([20e-6, -30e-6, 0.0]), np.array([0.0, 0.0, 50e-6])
RAILS = (
    Rail("p15", "P", 15.0, (13.0, 17.0), (0.0, 18.0), 0.03),
    Rail("n15", "N", -15.0, (-17.0, -13.0), (-18.0, 0.0), 0.03),
)


def world_with(rail: float) -> World:
    values = {"b_S": BIAS, "k_S": SCALE, "rail": np.asarray(rail)}
    return fed_world(AppliedEffect(CATALOGUE["supply_sensitivity"], values))


def fed_world(effect: AppliedEffect) -> World:
    model = ForwardModel({"1": INSTALLATION_1}, (effect,))
    world = World(WorldSettings(BLOCK, model, {}, 1, power=PowerSettings(RAILS)), VirtualClock())
    for output, set_v in (("P", 15.0), ("N", -15.0)):
        world.power.change(output, world.clock.now_s(), on=True, set_v=set_v, limit_a=1.0)
    world.mount("1")
    return world


def signals(world: World) -> np.ndarray:
    return np.array([world.signal_v(channel) for channel in ("x", "y", "z")])


@pytest.mark.parametrize(("rail", "above_v"), [(1.0, 0.0), (2.0, 0.6)])
def test_signals_follow_the_rail_that_sags_and_no_other(rail: float, above_v: float) -> None:
    """4 % of -15 V are 0.6 V more than -15 V; z feels 1 g at zero."""
    world = world_with(rail)
    world.clock.sleep(60.0)
    before = signals(world)
    world.power.disturb(Disturbance("sag", world.clock.now_s() + 1.0, "N", size=0.04))
    world.clock.sleep(60.0)
    expected = np.array([-2.0 * 20e-6, -2.1 * -30e-6, -2.2 * 50e-6]) * above_v
    np.testing.assert_allclose(signals(world) - before, expected, rtol=0, atol=1e-12)


def switched(world: World, on: bool) -> None:
    for output in ("P", "N"):
        world.power.change(output, world.clock.now_s(), on=on)
    world.clock.sleep(60.0)


def read(world: World) -> np.ndarray:
    for channel in ("x", "y", "z"):
        world.new_reading(channel)
    world.clock.sleep(1.0)
    return signals(world)


def test_a_block_that_was_off_since_it_was_read_is_on_another_visit() -> None:
    """A step at the visit "1/2" is there from the first reading after it was off, whatever was before."""
    step = {"step": np.array([100e-6, 0.0, -40e-6])}
    world = fed_world(AppliedEffect(CATALOGUE["turn_on_shift"], step, installations=("1/2",)))
    world.clock.sleep(60.0)
    for on in (False, True):  # before anything is read: no visit of its own
        switched(world, on)
    before = read(world)
    for on in (False, True, False, True):
        switched(world, on)
    np.testing.assert_allclose(read(world) - before, np.diag(BLOCK.K) * step["step"], rtol=0, atol=1e-12)
