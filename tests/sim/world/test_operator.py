"""The scripted operator: what is done to the world, what is answered, how long it takes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.model import Block, Distribution, ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from drivers.interfaces import NoAnswer
from drivers.person import Prompt, PromptKind
from sim.world.clock import VirtualClock
from sim.world.operator import LOOK_S, OperatorSettings, ScriptedOperator, scale_text
from sim.world.world import World, WorldSettings

NEVER_SLIPS = OperatorSettings(slip_probability=0.0)
ALWAYS_SLIPS = OperatorSettings(slip_probability=1.0)
EXACT = OperatorSettings(setting_deviation_rad=0.0, slip_probability=0.0)


def a_world(seed: int = 11) -> World:
    block = Block(-2.0 * np.eye(3), np.zeros(3))
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
    stand = {"setting_error": Distribution(10 * ARCSEC, k=3)}
    return World(WorldSettings(block, model, stand, seed), VirtualClock())


def turn_prompt(prompt_id: str, target_rad: float, direction: int = 1) -> Prompt:
    action = {"do": "turn", "target_rad": target_rad, "direction": direction}
    return Prompt(prompt_id, PromptKind.ANGLE, "Turn the head", action=action)


def arcsec_of(text: str) -> float:
    degrees, minutes, seconds = text.removeprefix("-").split(" ")
    total = int(degrees) * 3600 + int(minutes) * 60 + float(seconds)
    return -total if text.startswith("-") else total


def test_turns_the_head_near_the_target_and_answers_what_the_scale_shows() -> None:
    world = a_world()
    operator = ScriptedOperator(world, NEVER_SLIPS)
    deviations = []
    for i in range(300):
        world.begin_step(f"{i}/turn")
        answer = operator.ask(turn_prompt(f"{i}/turn#1", math.pi / 4, -1))
        assert answer.prompt_id == f"{i}/turn#1"
        assert arcsec_of(answer.text) * ARCSEC == pytest.approx(world.scale_angle_rad, abs=1e-12)
        assert world.direction == -1
        deviations.append(arcsec_of(answer.text) - 45 * 3600)
    # Normal with sigma 2″ rounded to 1″: sqrt(4 + 1/12) = 2.02″; 300 draws know it to 4.1 %, bound 4 sigma.
    assert np.std(deviations) == pytest.approx(2.02, rel=0.17)
    assert abs(np.mean(deviations)) < 4 * 2.02 / math.sqrt(300)


@pytest.mark.parametrize("task_s", [4.0, 10.0, 1200.0, 1203.5])
def test_something_may_be_watched_while_the_person_is_at_a_task_and_it_takes_no_longer(task_s: float) -> None:
    world = a_world()
    operator = ScriptedOperator(world, replace(EXACT, mount_time_s=task_s))
    looks = []

    def look() -> None:
        world.clock.sleep(0.25)  # to look takes time as well
        looks.append(world.clock.now_s())

    operator.meanwhile = look
    action = {"do": "mount", "installation": "2"}
    operator.ask(Prompt("m#1", PromptKind.CONFIRM, "Mount", action=action))
    assert world.clock.now_s() == pytest.approx(task_s, abs=0.25)
    assert max(np.diff([0.0, *looks])) <= LOOK_S + 0.25


@pytest.mark.parametrize(
    ("arcsec", "text"),
    [
        (162003, "45 00 03"), (1296002, "360 00 02"), (1295998, "359 59 58"), (-2, "-0 00 02"),
        (0, "0 00 00"), (-0.0001, "0 00 00"), (59.5, "0 00 59.5"), (59.9999, "0 01 00"),
        (3725.25, "1 02 05.25"),
    ],
)  # fmt: skip
def test_scale_text(arcsec: float, text: str) -> None:
    assert scale_text(arcsec) == text


def test_full_turn_is_never_wrapped_and_zero_may_be_below() -> None:
    operator = ScriptedOperator(a_world(), NEVER_SLIPS)
    full = [arcsec_of(operator.ask(turn_prompt(f"{i}/a#1", math.tau)).text) for i in range(40)]
    assert all(abs(value - 1296000) < 15 for value in full)
    zero = [operator.ask(turn_prompt(f"{i}/b#1", 0.0)).text for i in range(40)]
    assert any(text.startswith("-0 00 0") for text in zero)
    assert all(abs(arcsec_of(text)) < 15 for text in zero)


def test_a_slip_is_a_classic_one_and_the_head_stands_right() -> None:
    world = a_world()
    operator = ScriptedOperator(world, ALWAYS_SLIPS)
    sizes = set()
    for i in range(60):
        text = operator.ask(turn_prompt(f"{i}/turn#1", 1.0)).text
        assert abs(world.scale_angle_rad - 1.0) < 15 * ARCSEC
        sizes.add(round(arcsec_of(text) - world.scale_angle_rad / ARCSEC))
    assert sizes == {3600, -3600, 600, -600, 60, -60}


def test_slips_are_as_frequent_as_stated() -> None:
    # 400 readings at 10 %: 40 expected, sigma 6; bound 4 sigma.
    world = a_world()
    operator = ScriptedOperator(world, OperatorSettings(slip_probability=0.1))
    slips = 0
    for i in range(400):
        text = operator.ask(turn_prompt(f"{i}/turn#1", 1.0)).text
        slips += abs(arcsec_of(text) - world.scale_angle_rad / ARCSEC) > 30
    assert 16 <= slips <= 64


def test_asked_again_the_answer_is_right_and_the_head_is_not_turned_again() -> None:
    world = a_world()
    operator = ScriptedOperator(world, ALWAYS_SLIPS)
    operator.ask(turn_prompt("7/turn#1", 1.0))
    scale_rad, true_rad, now_s = world.scale_angle_rad, world.true_angle_rad, world.clock.now_s()
    answer = operator.ask(turn_prompt("7/turn#2", 1.0))
    assert arcsec_of(answer.text) * ARCSEC == pytest.approx(scale_rad, abs=1e-12)
    assert (world.scale_angle_rad, world.true_angle_rad) == (scale_rad, true_rad)
    assert world.clock.now_s() - now_s == pytest.approx(15.0)


def test_numbers_belong_to_the_step_and_seed() -> None:
    alone = ScriptedOperator(a_world())
    busy = ScriptedOperator(a_world())
    for i in range(5):
        busy.ask(turn_prompt(f"{i}/turn#1", 0.3))
    other_seed = ScriptedOperator(a_world(seed=12))
    prompts = [turn_prompt(f"{i}/late#1", 2.0) for i in range(20)]
    answers = [alone.ask(prompt).text for prompt in prompts]
    assert [busy.ask(prompt).text for prompt in prompts] == answers
    assert [other_seed.ask(prompt).text for prompt in prompts] != answers


def test_time_passes_for_what_a_person_does() -> None:
    world = a_world()
    operator = ScriptedOperator(world, NEVER_SLIPS)
    durations = []
    for i in range(50):
        begun_s = world.clock.now_s()
        operator.ask(turn_prompt(f"{i}/turn#1", 1.0))
        durations.append(world.clock.now_s() - begun_s)
    assert min(durations) >= 60.0
    assert max(durations) <= 180.0
    assert len(set(durations)) == 50
    begun_s = world.clock.now_s()
    operator.ask(Prompt("m#1", PromptKind.CONFIRM, "Mount", action={"do": "mount", "installation": "2"}))
    assert world.clock.now_s() - begun_s == pytest.approx(1200.0)


def test_a_head_is_turned_away_and_back_in_one_turn_and_a_look_and_read_without_a_turn() -> None:
    world = a_world()
    turns: list[float] = []
    turn = world.turn
    world.turn = lambda angle_rad, direction: (turns.append(angle_rad), turn(angle_rad, direction))[1]
    operator = ScriptedOperator(world, EXACT)
    prompt = turn_prompt("1/turn#1", math.radians(1.0))
    operator.ask(replace(prompt, action={**prompt.action, "by_way_of_rad": math.radians(5.0)}))
    assert [round(math.degrees(angle_rad), 9) for angle_rad in turns] == [5.0, 1.0]
    begun_s = world.clock.now_s()
    assert 60.0 <= begun_s - EXACT.second_look_s <= 180.0
    read = Prompt("2/read#1", PromptKind.ANGLE, "Read", action={"do": "read_head"})
    assert operator.ask(read).text == "1 00 00"
    assert world.clock.now_s() - begun_s == EXACT.second_look_s
    assert len(turns) == 2


def test_an_unexpected_reading_is_confirmed_at_once() -> None:
    world = a_world()
    doubt = Prompt("t/right1#1", PromptKind.CONFIRM, "Is that right?", action={"do": "confirm_reading"})
    assert ScriptedOperator(world).ask(doubt).text == "yes"
    assert world.clock.now_s() == 0.0


def test_chamber_and_thermometer() -> None:
    world = a_world()
    operator = ScriptedOperator(world)
    operator.ask(Prompt("c#1", PromptKind.CONFIRM, "Set", action={"do": "set_temperature", "target_c": 60.0}))
    assert world.chamber_c == 60.0
    world.clock.sleep(750.0 - 30.0)
    answer = operator.ask(Prompt("t#1", PromptKind.NUMBER, "Read", action={"do": "read_temperature"}))
    assert float(answer.text) == pytest.approx(60.0 - 37.0 * math.exp(-1), abs=0.006)


def test_other_questions_get_their_default_or_no_answer() -> None:
    operator = ScriptedOperator(a_world())
    wait = Prompt("w#1", PromptKind.CONFIRM, "Wait", default="yes", action={"do": "wait"})
    assert operator.ask(wait).text == "yes"
    with pytest.raises(
        NoAnswer, match=r"no answer to 'Serial number\?', which wants an answer of kind 'number'"
    ):
        operator.ask(Prompt("q#1", PromptKind.NUMBER, "Serial number?"))


def test_a_scale_without_steps_is_refused() -> None:
    with pytest.raises(ValueError, match="a positive resolution"):
        OperatorSettings(resolution_rad=0.0)
