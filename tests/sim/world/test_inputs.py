"""Inputs of the simulated meters that are switched to a short or a reference: what the meters then see."""

import math

import pytest

from bench.model import AppliedEffect, ForwardModel
from bench.model.effects import Effect, Parameter, Stage
from bench.model.geometry import INSTALLATION_1
from drivers.person import Prompt, PromptKind
from sim.world.clock import VirtualClock
from sim.world.operator import OperatorSettings, ScriptedOperator
from sim.world.world import World, WorldSettings
from tests.support.simulated_stand import BLOCK


class Doubled(Effect):
    """The signal once more, at a stage of one's choice."""

    name = "doubled"
    sentence = "the signal once more"
    shown_by = "any reading"
    parameters: tuple[Parameter, ...] = ()

    def __init__(self, stage: Stage) -> None:
        self.stage = stage

    def addition(self, values, seen):
        return seen.signal


def a_world(*stages: Stage) -> World:
    effects = tuple(AppliedEffect(Doubled(stage), {}) for stage in stages)
    return World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}, effects), {}, 5), VirtualClock())


def signals(world: World, time_s: float | None = None) -> list[float]:
    return [world.signal_v(channel, time_s) for channel in ("x", "y", "z")]


def test_all_inputs_are_switched_together_and_back() -> None:
    world = a_world()
    at_rest = signals(world)
    world.select_input("short")
    assert signals(world) == [0.0, 0.0, 0.0]
    world.select_input("reference", -1.5)
    assert signals(world) == [-1.5, -1.5, -1.5]
    world.turn(math.pi / 2, 1)
    assert signals(world) == [-1.5, -1.5, -1.5]
    world.select_input("signal")
    assert signals(world)[0] == pytest.approx(-2.177 + 0.07)
    world.turn(0.0, -1)
    assert signals(world) == at_rest


def test_samples_handed_over_late_are_of_their_own_time() -> None:
    world = a_world()
    before = signals(world)
    world.clock.sleep(10.0)
    world.select_input("short")
    world.clock.sleep(10.0)
    assert signals(world, 5.0) == before
    assert signals(world, 15.0) == [0.0, 0.0, 0.0]


def test_a_reference_shows_the_voltmeters_effects_and_none_of_the_block() -> None:
    world = a_world(Stage.SPECIFIC_FORCE, Stage.BLOCK_OUTPUT, Stage.VOLTMETER_READING)
    world.select_input("reference", 1.25)
    assert signals(world) == [2.5, 2.5, 2.5]


@pytest.mark.parametrize(
    ("source", "says"), [("shrot", "no input 'shrot'"), ("reference", "needs a voltage")]
)
def test_what_cannot_be_switched_is_refused(source: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        a_world().select_input(source)


def test_the_operator_takes_time_for_it() -> None:
    world = a_world()
    operator = ScriptedOperator(world, OperatorSettings(task_time_s=40.0))
    action = {"do": "select_input", "source": "reference", "reference_v": 2.0}
    answer = operator.ask(Prompt("7/input", PromptKind.CONFIRM, "Switch", default="yes", action=action))
    assert (answer.prompt_id, answer.text) == ("7/input", "yes")
    assert world.clock.now_s() == 40.0
    assert signals(world) == [2.0, 2.0, 2.0]
