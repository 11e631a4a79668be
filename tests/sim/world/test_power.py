"""How the block is fed: power and its loss, in-rush, current limits, protections, disturbances, limits passed."""

import numpy as np
import pytest

from bench.model import CATALOGUE, AppliedEffect, Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.world.clock import VirtualClock
from sim.world.power import Disturbance, PowerSettings, Rail
from sim.world.world import World, WorldSettings

BLOCK = Block(np.diag([-2.2, -2.1, -2.15]), np.array([0.07, -0.2, -0.41]))
PLUS = Rail("p15", "+", 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2)
MINUS = Rail("n15", "-", -15.0, (-18.0, -12.0), (-18.0, 0.5), 0.06, 0.2)
HOUR_S = 3600.0


@pytest.fixture
def world() -> World:
    return fed()


def fed(effects: tuple[AppliedEffect, ...] = (), **settings: float) -> World:
    model = ForwardModel({"1": INSTALLATION_1}, effects)
    power = PowerSettings((PLUS, MINUS), **settings)
    return World(WorldSettings(BLOCK, model, {}, 5, power=power), VirtualClock())


def now(world: World) -> float:
    return world.clock.now_s()


def switch_on(world: World, **changes: object) -> None:
    for output, volts in (("+", 15.0), ("-", -15.0)):
        settings = {"set_v": volts, "limit_a": 0.15, "trip_v": 1.1 * volts, **changes}
        world.power.change(output, now(world), **settings)
        world.power.change(output, now(world), on=True)


def test_a_block_without_rails_always_has_power_and_no_time_since_switching_on():
    world = World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), {}, 5), VirtualClock())
    assert world.power.feeds_block(0.0)
    assert world.power.on_since_s(0.0) is None
    assert world.signal_v("x") == pytest.approx(0.07, abs=2.3)


def test_without_power_it_shows_a_few_millivolts_that_differ(world):
    dead = []
    for _ in range(50):
        world.clock.sleep(1.0)
        dead.append([world.signal_v(channel) for channel in "xyz"])
    assert np.abs(dead).max() < 0.02
    assert (np.std(dead, axis=0) > 1e-5).all()
    switch_on(world)
    world.clock.sleep(1.0)
    assert max(abs(world.signal_v(channel)) for channel in "xyz") > 0.3


def test_it_has_power_only_with_both_rails(world):
    switch_on(world)
    world.clock.sleep(10.0)
    assert world.power.feeds_block(now(world))
    world.power.change("-", now(world), on=False)
    assert not world.power.feeds_block(now(world))
    assert world.power.violations == []


def test_in_rush_is_limited_and_dies_away(world):
    switch_on(world)
    shown = world.power.shown("+", now(world))
    assert shown.limiting
    assert shown.current_a == pytest.approx(0.15)
    assert shown.voltage_v == pytest.approx(15.0 * 0.15 / 0.18)
    world.clock.sleep(5.0)
    shown = world.power.shown("+", now(world))
    assert not shown.limiting
    assert shown.current_a == pytest.approx(0.06, rel=1e-3)
    # It worked from when the rails had come up to 12 V on.
    since_s = world.power.on_since_s(now(world))
    assert since_s is not None
    assert world.power.rail_v("p15", since_s) >= 12.0


def test_the_current_follows_the_temperature():
    world = fed(current_by_temperature=0.01)
    switch_on(world)
    world.set_chamber(73.0)
    world.clock.sleep(10 * HOUR_S)
    assert world.power.shown("+", now(world)).current_a == pytest.approx(0.06 * 1.5, rel=1e-3)


def test_a_short_takes_it_into_current_limit_and_the_block_loses_its_power(world):
    switch_on(world)
    world.power.disturb(Disturbance("load", 100.0, "+", size=10.0, lasts_s=50.0))
    world.clock.sleep(120.0)
    assert not world.power.feeds_block(now(world))
    assert world.power.shown("+", now(world)).limiting
    world.clock.sleep(60.0)
    assert world.power.on_since_s(now(world)) == pytest.approx(150.0)
    assert [alive for _, alive in world.power.switchings] == [False, True, False, True]


def test_an_over_voltage_protection_trips_when_a_drift_reaches_it(world):
    switch_on(world)
    world.power.disturb(Disturbance("drift", 0.0, "+", size=3.0))
    world.clock.sleep(2 * HOUR_S)
    stage = world.power.stage("+", now(world))
    assert (stage.on, stage.tripped) == (False, "voltage")
    # From 15 V at 3 V/h to 16.5 V takes half an hour.
    assert stage.since_s == pytest.approx(HOUR_S / 2, abs=1e-3)
    assert world.power.violations == []


def test_an_over_current_protection_trips_after_its_delay(world):
    switch_on(world, trip_after_s=2.0)
    world.clock.sleep(10.0)
    assert world.power.stage("+", now(world)).on
    world.power.disturb(Disturbance("load", 20.0, "+", size=10.0))
    world.clock.sleep(60.0)
    stage = world.power.stage("+", now(world))
    assert (stage.on, stage.tripped, stage.since_s) == (False, "current", pytest.approx(22.0))


def test_what_the_block_may_not_be_given_is_taken_down_however_short(world):
    switch_on(world, trip_v=None)
    world.clock.sleep(10.0)
    world.power.change("+", now(world), set_v=20.0)
    world.clock.sleep(3.0)
    world.power.change("+", now(world), set_v=15.0)
    world.clock.sleep(3.0)
    world.power.advance(now(world))
    (violation,) = world.power.violations
    assert (violation.rail, violation.unit) == ("p15", "V")
    assert violation.value == pytest.approx(20.0)
    assert (violation.from_s, violation.to_s) == pytest.approx((10.0, 13.0))


def test_a_current_beyond_its_limit_is_taken_down(world):
    switch_on(world, limit_a=1.0)
    world.clock.sleep(10.0)
    world.power.disturb(Disturbance("load", 20.0, "-", size=5.0))
    world.clock.sleep(20.0)
    world.power.advance(now(world))
    assert {(v.rail, v.unit) for v in world.power.violations} == {("n15", "A")}
    assert max(v.value for v in world.power.violations) == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "size", "given_v", "terminals_v"),
    [("sag", 0.5, 7.5, 7.5), ("open", 0.0, 0.0, 15.0), ("off", 0.0, 0.0, 0.0)],
)
def test_disturbances(world, kind, size, given_v, terminals_v):
    switch_on(world)
    world.power.disturb(Disturbance(kind, 100.0, "+", size=size))
    world.clock.sleep(200.0)
    assert world.power.rail_v("p15", now(world)) == pytest.approx(given_v)
    assert world.power.shown("+", now(world)).voltage_v == pytest.approx(terminals_v)
    assert world.power.rail_v("p15", 50.0) == pytest.approx(15.0)
    assert not world.power.feeds_block(now(world))


def test_a_disturbance_of_an_output_without_a_rail_is_refused(world):
    with pytest.raises(ValueError, match="no rail"):
        world.power.disturb(Disturbance("off", 100.0, "3"))


def test_after_a_cut_of_the_mains_everything_is_off_and_the_supply_is_told(world):
    back = []
    world.power.returned = back.append
    switch_on(world)
    world.power.disturb(Disturbance("cut", 100.0, lasts_s=60.0))
    world.clock.sleep(120.0)
    assert not world.power.has_mains(now(world))
    assert not world.power.feeds_block(now(world))
    world.clock.sleep(60.0)
    assert world.power.has_mains(now(world))
    assert back == [160.0]
    assert not world.power.stage("+", now(world)).on


def test_warm_up_counts_from_switching_on():
    warm_up = AppliedEffect(CATALOGUE["warm_up"], {"A": 1e-3, "tau": 1200.0})
    world, cold = fed((warm_up,)), fed()
    for at in (world, cold):
        at.clock.sleep(5 * HOUR_S)
        switch_on(at)
        at.clock.sleep(600.0)
    since_s = world.power.on_since_s(now(world))
    left_g = 1e-3 * np.exp(-(now(world) - since_s) / 1200.0)
    assert world.signal_v("x") - cold.signal_v("x") == pytest.approx(-2.2 * left_g, rel=1e-6)


# --- supply sensitivity -----------------------------------------------------------------------------
# A rail that sags, and a block that is switched off and on, seen in the signals.

FED_BLOCK = Block(np.diag([-2.0, -2.1, -2.2]), np.array([0.1, -0.2, 0.3]))
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
    world = World(WorldSettings(FED_BLOCK, model, {}, 1, power=PowerSettings(RAILS)), VirtualClock())
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
    np.testing.assert_allclose(read(world) - before, np.diag(FED_BLOCK.K) * step["step"], rtol=0, atol=1e-12)
