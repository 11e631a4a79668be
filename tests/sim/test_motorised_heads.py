"""The simulated Zaber stage and ACUTROL table, as (sent, answered) against their manuals' text."""

import math

import pytest

from sim.acutrol import AcutrolTable
from sim.world.pose import HeadFault
from sim.world.world import World
from sim.zaber import ZaberStage
from tests.support.simulated_stand import a_world, tell

DEG = math.pi / 180
STEPS = 12800 / 3


def a_stage(**options: object) -> tuple[ZaberStage, World]:
    world = a_world()
    return ZaberStage(world, steps_per_degree=STEPS, **options), world  # type: ignore[arg-type]


# --- Zaber ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        ("/1", "@01 0 OK IDLE -- 0"),
        ("/", "@01 0 OK IDLE -- 0"),
        ("/1 1", "@01 1 OK IDLE -- 0"),
        ("/1 1 35", "@01 1 35 OK IDLE -- 0"),
        ("/1 get deviceid", "@01 0 OK IDLE -- 20031"),
        ("/01 0 07 get deviceid", "@01 0 07 OK IDLE -- 20031"),
        ("/1 foo", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 get nothing", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 3 get pos", "@01 3 RJ IDLE -- BADAXIS"),
        ("/1 1 move abs 99999999", "@01 1 RJ IDLE -- BADDATA"),
        ("/1 1 move abs 1.5", "@01 1 RJ IDLE -- BADDATA"),
        ("/1 1 move", "@01 1 RJ IDLE -- BADCOMMAND"),
        ("/1 1 move abs 384000", "@01 1 OK BUSY -- 0"),
        ("/1 1 get resolution", "@01 1 OK IDLE -- 64"),
        ("/1 1 get limit.max", "@01 1 RJ IDLE -- BADCOMMAND"),
        ("/1 1 move rel 5", "@01 1 RJ IDLE -- BADCOMMAND"),
        ("/1 set comm.alert 1", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 set maxspeed 0", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 set resolution 3", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 warnings", "@01 0 OK IDLE -- 00"),
        ("/2 1 get pos", None),
        ("nonsense", None),
        ("", None),
    ],
)
def test_zaber_answers_as_the_manual_prints(sent: str, answered: str | None) -> None:
    stage, _ = a_stage(device_id=20031)
    assert tell(stage, sent) == answered


def test_zaber_moves_at_maxspeed_and_counts_steps() -> None:
    stage, world = a_stage(speed_deg_s=5.0)
    tell(stage, "/1 1 move abs 384000")
    world.clock.sleep(9.0)
    assert (
        tell(stage, "/1 1 get pos") == "@01 1 OK BUSY -- 192003"
    )  # maxspeed is a whole number: 34953 / 1.6384
    world.clock.sleep(9.1)
    assert tell(stage, "/1 1 get pos") == "@01 1 OK IDLE -- 384000"
    tell(stage, "/1 1 set maxspeed 69905", "/1 1 move abs 341333")
    world.clock.sleep(0.5)
    assert world.head_rate_rad_s == pytest.approx(-10 * DEG, rel=1e-4)
    world.clock.sleep(0.6)
    assert tell(stage, "/1 1 get pos") == "@01 1 OK IDLE -- 341333"
    assert math.degrees(world.scale_angle_rad) == pytest.approx(341333 / STEPS, abs=1e-12)


def test_zaber_not_homed() -> None:
    stage, world = a_stage(homed=False)
    world.turn(20 * DEG, 1)
    assert tell(stage, "/1") == "@01 0 OK IDLE WR 0"
    assert tell(stage, "/1 1 move abs 0") == "@01 1 RJ IDLE WR BADDATA"
    assert tell(stage, "/1 warnings clear", "/1 warnings") == "@01 0 OK IDLE WR 01 WR"
    assert tell(stage, "/1 home") == "@01 0 OK BUSY WR 0"
    world.clock.sleep(2.1)
    assert tell(stage, "/1") == "@01 0 OK IDLE -- 0"
    assert world.scale_angle_rad == 0.0
    stage.power_cycle()
    assert tell(stage, "/1") == "@01 0 OK IDLE WR 0"


def test_zaber_homing_that_was_interrupted_or_stuck_leaves_it_unreferenced() -> None:
    stage, world = a_stage(homed=False)
    world.turn(90 * DEG, 1)
    tell(stage, "/1 home")
    world.clock.sleep(1.0)
    assert tell(stage, "/1 stop", "/1") == "@01 0 OK IDLE WR 0"
    world.head_fault = HeadFault(sticks_after_rad=0.1)
    tell(stage, "/1 home")
    world.clock.sleep(60.0)
    assert tell(stage, "/1 warnings") == "@01 0 OK IDLE FS 03 FS WR NI"


def test_zaber_interrupted_and_stalled() -> None:
    stage, world = a_stage()
    tell(stage, "/1 1 move abs 384000")
    assert tell(stage, "/1 1 move abs 0") == "@01 1 OK IDLE NI 0"
    assert tell(stage, "/1 warnings clear", "/1") == "@01 0 OK IDLE -- 0"
    world.head_fault = HeadFault(sticks_after_rad=0.1)
    tell(stage, "/1 1 move abs 384000")
    world.clock.sleep(60.0)
    assert tell(stage, "/1") == "@01 0 OK IDLE FS 0"
    world.head_fault = HeadFault()
    assert tell(stage, "/1 stop", "/1 warnings clear", "/1 1 move abs 384000") == "@01 1 OK BUSY -- 0"


def test_zaber_checksums() -> None:
    stage, _ = a_stage()
    assert tell(stage, "/01 tools:46") is None
    assert tell(stage, "/1:CF") == "@01 0 OK IDLE -- 0"
    reply = tell(stage, "/1 set comm.checksum 1")
    assert reply is not None
    body, _, code = reply[1:].partition(":")
    assert (sum(body.encode()) + int(code, 16)) % 256 == 0


# --- ACUTROL ----------------------------------------------------------------------------------------

READY = (":interlock:open 1", ":interlock:reset 1", ":interlock:close 1")


def a_table() -> tuple[AcutrolTable, World]:
    world = a_world()
    return AcutrolTable(world), world


@pytest.mark.parametrize(
    "message",
    [
        ":mode:position 1",
        ":interlock:close 1",
        ":demand:position 1",
        ":demand:position 1, x",
        ":demand:position 2, 45",
        ":read:nothing 1",
        "nonsense",
    ],
)
def test_acutrol_refuses(message: str) -> None:
    table, _ = a_table()
    assert (tell(table, message) or "")[8:] == "ERR"


def test_acutrol_position_and_rate_mode() -> None:
    table, world = a_table()
    tell(table, *READY, ":D:P 1, 45", ":M:P 1")
    world.clock.sleep(1.0)
    assert (tell(table, ":u:f f ; :R:P 1") or "")[8:] == "10.000000"
    assert (tell(table, ":R:R 1") or "")[8:] == "10.000000"
    world.clock.sleep(10.0)
    assert (tell(table, ":R:P 1") or "")[8:] == "45.000000"
    tell(table, ":demand:rate 1, -002.000", ":mode:rate 1")
    world.clock.sleep(10.0)
    assert world.scale_angle_rad == pytest.approx(25 * DEG)
    tell(table, ":demand:rate 1, 0")
    world.clock.sleep(10.0)
    assert world.scale_angle_rad == pytest.approx(25 * DEG)
    # A demand from before is followed as soon as the mode is entered.
    tell(table, ":mode:position 1")
    world.clock.sleep(10.0)
    assert world.scale_angle_rad == pytest.approx(45 * DEG)


def test_acutrol_stands_when_the_interlock_opens_or_power_fails() -> None:
    table, world = a_table()
    for end in (
        lambda: tell(table, ":interlock:open 1"),
        table.power_cycle,
        lambda: tell(table, ":mode:off 1"),
    ):
        tell(table, *READY, ":demand:position 1, 0", ":mode:position 1")
        world.clock.sleep(60.0)
        tell(table, ":demand:position 1, 45")
        world.clock.sleep(1.0)
        end()
        world.clock.sleep(60.0)
        assert world.scale_angle_rad == pytest.approx(10 * DEG)
