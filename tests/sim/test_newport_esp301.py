"""The simulated ESP301, as (sent, answered); its lines end in CR, its replies in CR LF."""

import math

import pytest

from sim.newport_esp301 import Esp301
from sim.world.pose import HeadFault
from sim.world.world import World
from tests.support.simulated_stand import a_world, tell

DEG = math.pi / 180


def a_stage(**options: object) -> tuple[Esp301, World]:
    world = a_world()
    return Esp301(world, **options), world  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        ("*IDN?", "ESP301 Version 3.04 07/27/01"),
        ("1TP?", "0.00000"),
        ("1tp", "0.00000"),
        ("1MD?", "1"),
        ("1SN?", "7"),
        ("1MO?", "1"),
        ("1MO;1MO?;1MD?", "1\r\n1"),
        ("1 PA 45; 1 VA ?", "2.00000"),
        ("1VA10", None),
        ("", None),
    ],
)
def test_it_answers_queries_alone_a_line_each(sent: str, answered: str | None) -> None:
    stage, _ = a_stage()
    assert tell(stage, sent) == answered
    assert tell(stage, "TB?") == "0, 0, NO ERROR DETECTED"


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        ("1XX", "6, 0, COMMAND DOES NOT EXIST"),
        ("1PAx", "7, 0, PARAMETER OUT OF RANGE"),
        ("1PAnan", "7, 0, PARAMETER OUT OF RANGE"),
        ("2PA45", "9, 0, AXIS NUMBER OUT OF RANGE"),
        ("PA45", "37, 0, AXIS NUMBER MISSING"),
        ("1PA", "38, 0, COMMAND PARAMETER MISSING"),
        ("1PA401", "106, 0, AXIS-1 POSITIVE SOFTWARE LIMIT DETECTED"),
        ("1PR-5", "6, 0, COMMAND DOES NOT EXIST"),
        ("1PA-401", "107, 0, AXIS-1 NEGATIVE SOFTWARE LIMIT DETECTED"),
        ("1VA21", "110, 0, AXIS-1 MAXIMUM VELOCITY EXCEEDED"),
    ],
)
def test_a_mistake_is_answered_by_its_error_buffer_alone(sent: str, told: str) -> None:
    stage, world = a_stage()
    assert tell(stage, sent) is None
    assert tell(stage, "TB?") == told
    assert tell(stage, "TB?") == "0, 0, NO ERROR DETECTED"
    assert world.head_rate_rad_s == 0.0


def test_it_turns_at_its_speed_and_tells_when_it_is_done() -> None:
    stage, world = a_stage()
    tell(stage, "1VA10", "1PA45.0")
    world.clock.sleep(2.0)
    assert tell(stage, "1TP?;1MD?;TB?") == "20.00000\r\n0\r\n0, 5000, NO ERROR DETECTED"
    tell(stage, "1ST")
    world.clock.sleep(9.0)
    assert tell(stage, "1TP;1MD?") == "20.00000\r\n1"
    tell(stage, "1PA15")
    world.clock.sleep(9.0)
    assert world.scale_angle_rad == pytest.approx(15 * DEG)


def test_switched_off_and_on_it_counts_from_where_it_stands_until_it_is_homed() -> None:
    stage, world = a_stage()
    tell(stage, "1PA45")
    world.clock.sleep(60.0)
    stage.power_cycle()
    assert tell(stage, "1TP?;1MO?;1PA45;TB?") == "0.00000\r\n0\r\n113, 150000, AXIS-1 MOTOR NOT ENABLED"
    tell(stage, "1MO", "1OR1")
    world.clock.sleep(60.0)
    assert tell(stage, "1MD?;1TP?") == "1\r\n0.00000"
    assert world.scale_angle_rad == 0.0


def test_a_stuck_axis_ends_in_a_following_error_without_its_motor() -> None:
    stage, world = a_stage()
    world.head_fault = HeadFault(sticks_after_rad=0.1)
    tell(stage, "1PA45")
    world.clock.sleep(60.0)
    told = (tell(stage, "1MO?;TB?;TB?") or "").split("\r\n")
    assert [line.partition(",")[0] for line in told] == ["0", "103", "0"]
