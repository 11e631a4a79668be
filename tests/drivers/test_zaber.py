"""The Zaber driver against the protocol manual's text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from drivers.facts.zaber import READ_TERMINATION, SERIAL, WRITE_TERMINATION, checksum
from drivers.instruments.zaber import ZaberHead
from drivers.interfaces import (
    BadReading,
    DividingHead,
    HeadPosition,
    Identity,
    InstrumentLost,
    InstrumentRefused,
)
from drivers.wire.visa import MessageSession, SerialSettings
from sim.wires.server import TERMINALS, TerminalServer
from sim.wires.session import DROP, SILENCE, ServedInstrument, WireFault
from sim.world.pose import HeadFault
from sim.world.world import World
from sim.zaber import ZaberStage
from tests.support.scripted_session import Clock, Pairs, ScriptedSession, swapped, until
from tests.support.simulated_stand import a_world, served
from tests.support.zaber_head import ARCSEC, DEG, STEPS, TRAVEL, head

OPEN: Pairs = [
    ("/1 0 01 set comm.alert 0", "@01 0 01 OK IDLE -- 0"),
    ("/1 0 02 get deviceid", "@01 0 02 OK IDLE -- 20031"),
    ("/1 1 03 get resolution", "@01 1 03 OK IDLE -- 64"),
    ("/1 1 04 set maxspeed 69905", "@01 1 04 OK IDLE -- 0"),
    ("/1 1 05 get maxspeed", "@01 1 05 OK IDLE -- 69905"),
    ("/1 0 06 get system.serial", "@01 0 06 OK IDLE -- 73021"),
    ("/1 0 07 get version", "@01 0 07 OK IDLE -- 7.38"),
]
PREPARE: Pairs = [
    ("/1 1 08", "@01 1 08 OK IDLE -- 0"),
    ("/1 1 09 warnings clear", "@01 1 09 OK IDLE -- 00"),
    ("/1 1 10", "@01 1 10 OK IDLE -- 0"),
    ("/1 1 11 get pos", "@01 1 11 OK IDLE -- 0"),
]
MOVE: Pairs = [
    ("/1 1 12 move abs 384000", "@01 1 12 OK BUSY -- 0"),
    ("/1 1 13", "@01 1 13 OK BUSY -- 0"),
    ("/1 1 14 get pos", "@01 1 14 OK BUSY -- 200000"),
    ("/1 1 15", "@01 1 15 OK IDLE -- 0"),
    ("/1 1 16 get pos", "@01 1 16 OK IDLE -- 384001"),
    ("/1 1 17", "@01 1 17 OK IDLE -- 0"),
    ("/1 1 18 get pos", "@01 1 18 OK IDLE -- 384002"),
    ("/1 1 19", "@01 1 19 OK IDLE -- 0"),
    ("/1 1 20 get pos", "@01 1 20 OK IDLE -- 384003"),
]


def renumbered(pairs: Pairs, shift: int) -> Pairs:
    """Raise the message numbers, the third word of each message."""

    def raised(text: str) -> str:
        words = text.split(" ")
        return " ".join([*words[:2], f"{int(words[2]) + shift:02d}", *words[3:]])

    return [(raised(sent), raised(str(answered))) for sent, answered in pairs]


def test_a_whole_move() -> None:
    clock = Clock()
    script = ScriptedSession(OPEN, PREPARE, MOVE, [("/1 1 21 stop", "@01 1 21 OK IDLE -- 0")], clock=clock)
    h = head(script, clock)
    assert isinstance(h, DividingHead)
    assert h.open() == Identity("Zaber", "20031", "73021", "7.38")
    assert h.move(90 * DEG, 1, "1/turn") == HeadPosition(pytest.approx(384003 / STEPS * DEG, abs=1e-15), 1)  # type: ignore[arg-type]
    h.close()
    h.close()
    assert script.left == []


def test_the_checksum_makes_the_sum_of_all_bytes_zero() -> None:
    for message in ("01 tools echo", "1 1 07 move abs 384000"):
        code = checksum(message)
        assert len(code) == 2
        assert (sum(message.encode()) + int(code, 16)) % 256 == 0
    assert checksum("@@") == "80"


@pytest.mark.parametrize(
    ("command", "reply", "words"),
    [
        ("/1 0 02 get deviceid", "@01 0 02 OK IDLE -- 30111", "has the Zaber device id 30111"),
        ("/1 1 03 get resolution", "@01 1 03 OK IDLE -- 128", "resolution is 128 microsteps"),
        (
            "/1 1 03 get resolution",
            "@01 1 03 RJ IDLE -- BADCOMMAND",
            "rejected 'get resolution' with BADCOMMAND",
        ),
        (
            "/1 1 04 set maxspeed 69905",
            "@01 1 04 RJ IDLE WR BADDATA",
            "outside what the controller allows, flag WR",
        ),
        ("/1 1 05 get maxspeed", "@01 1 05 OK IDLE -- 1000", "maxspeed is 1000 after it was set to 69905"),
    ],
)
def test_a_stage_that_is_not_what_the_bench_file_says_is_refused(
    command: str, reply: str, words: str
) -> None:
    h = head(ScriptedSession(until(swapped(OPEN, command, reply), command)), identity=r"20\d{3}")
    with pytest.raises(InstrumentRefused, match=words):
        h.open()


def test_old_firmware_without_alert_and_serial_number_will_do() -> None:
    old = swapped(OPEN, "/1 0 01 set comm.alert 0", "@01 0 01 RJ IDLE -- BADCOMMAND")
    old = swapped(old, "/1 0 06 get system.serial", "@01 0 06 RJ IDLE -- BADCOMMAND")
    assert head(ScriptedSession(old)).open() == Identity("Zaber", "20031", "", "7.38")


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("FS", "has stalled"),
        ("FQ", "cannot trust its encoder"),
        ("FD", "motor driver off"),
        ("WR", "has lost its reference"),
        ("NI", "interrupted by another command"),
        ("NC", "turned by its knob"),
        ("ZZ", "a warning that is not known here"),
    ],
)
def test_a_flag_while_it_moves_stops_it_and_is_explained(flag: str, words: str) -> None:
    trouble = swapped(MOVE, "/1 1 13", f"@01 1 13 OK BUSY {flag} 0")
    stop = [("/1 1 14 stop", f"@01 1 14 OK IDLE {flag} 0")]
    script = ScriptedSession(OPEN, PREPARE, until(trouble, "/1 1 13"), stop)
    h = head(script)
    h.open()
    with pytest.raises(
        InstrumentRefused, match=rf"^head: the head .*{words}.* \(flag {flag}\); \w+"
    ) as caught:
        h.move(90 * DEG, 1, "1/turn")
    assert str(caught.value).count("\n") == 0
    assert script.left == []


def test_a_late_reply_of_an_earlier_command_is_not_taken_for_this_one() -> None:
    late = until(swapped(MOVE, "/1 1 14 get pos", "@01 1 11 OK IDLE -- 384000"), "/1 1 14 get pos")
    # Identity and settings are proved again before the question is put again.
    script = ScriptedSession(OPEN, PREPARE, late, renumbered(OPEN, 14), renumbered(MOVE[2:], 8))
    h = head(script)
    h.open()
    assert h.move(90 * DEG, 1, "1/turn").angle_rad == pytest.approx(384003 / STEPS * DEG, abs=1e-15)
    assert script.left == []


def test_a_garbled_reply_to_the_move_itself_ends_it_with_a_stop() -> None:
    garbled = swapped(MOVE, "/1 1 12 move abs 384000", "@01 1 12 OK BU")
    script = ScriptedSession(
        OPEN, PREPARE, until(garbled, "/1 1 12 move abs 384000"), [("/1 1 13 stop", "@01 1 13 OK BUSY NI 0")]
    )
    h = head(script)
    h.open()
    with pytest.raises(BadReading):
        h.move(90 * DEG, 1, "1/turn")
    assert script.left == []


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        (0.0, "needs a number of steps"),
        (1e8, "more than 2147483647 steps"),
        (100.0, "coarser than its tolerance"),
    ],
)
def test_steps_that_cannot_express_the_angles_are_refused(steps: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        head(ScriptedSession(), steps_per_degree=steps)


# --- zaber stage ------------------------------------------------------------------------------------
# The Zaber driver over a real socket and a serial port, with a simulated stage.


@contextmanager
def stand(
    world: World,
    stage: ZaberStage | None = None,
    fault: Callable[[bytes, bytes | None], WireFault | None] | None = None,
    log: list[tuple[str, str]] | None = None,
    **options: object,
) -> Iterator[tuple[ZaberHead, ZaberStage]]:
    stage = stage or ZaberStage(world, steps_per_degree=STEPS)
    with served(stage, "head", world, read_termination="\r\n", fault=fault, log=log) as session:
        h = head(session, world.clock, **options)
        h.open()
        try:
            yield h, stage
        finally:
            h.close()


def test_the_points_of_a_turn_from_both_sides_with_a_fresh_setting_error_each() -> None:
    world = a_world(setting_error_rad=10 * ARCSEC)
    errors = []
    with stand(world, checksums=True) as (h, _):
        for i, (target_deg, direction) in enumerate(
            [(0, 1), (45, 1), (180, 1), (360, 1), (315, -1), (45, -1), (0, -1)]
        ):
            world.begin_step(f"{i}/turn")
            begun_s = world.clock.now_s()
            position = h.move(target_deg * DEG, direction, f"{i}/turn")  # type: ignore[arg-type]
            assert position.angle_rad == pytest.approx(target_deg * DEG, abs=0.5 / STEPS * DEG)
            assert position.angle_rad == pytest.approx(world.scale_angle_rad, abs=1e-14)
            assert world.direction == position.direction == direction
            assert world.clock.now_s() - begun_s >= TRAVEL.settle_s
            errors.append(world.true_angle_rad - world.scale_angle_rad)
    assert len({round(error, 12) for error in errors}) == 7


def test_the_setting_error_does_not_depend_on_where_the_head_came_from() -> None:
    true_rad = []
    for start_deg in (0.0, 100.0):
        world = a_world(setting_error_rad=10 * ARCSEC)
        world.turn(start_deg * DEG, 1)
        world.begin_step("7/turn#1")
        with stand(world) as (h, _):
            h.move(45 * DEG, 1, "7/turn")
        true_rad.append(world.true_angle_rad)
    assert true_rad[0] == true_rad[1] != pytest.approx(45 * DEG, abs=1e-9)


def test_a_head_that_is_not_homed_is_homed_only_where_that_is_allowed() -> None:
    world = a_world()
    world.turn(30 * DEG, 1)
    with (
        stand(world, ZaberStage(world, steps_per_degree=STEPS, homed=False)) as (h, _),
        pytest.raises(InstrumentRefused, match="was not homed since it was switched on"),
    ):
        h.move(45 * DEG, 1, "1/turn")
    assert world.scale_angle_rad == pytest.approx(30 * DEG)
    with stand(world, ZaberStage(world, steps_per_degree=STEPS, homed=False), allow_homing=True) as (h, _):
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)


@pytest.mark.parametrize(
    ("encoder", "words"), [(True, r"has stalled \(flag FS\)"), (False, "stalled at 20°00′00″, sent to 45")]
)
def test_a_stuck_head_is_stopped_and_can_be_used_again_when_freed(encoder: bool, words: str) -> None:
    world = a_world()
    world.head_fault = HeadFault(sticks_after_rad=20 * DEG)
    stage = ZaberStage(world, steps_per_degree=STEPS, encoder=encoder)
    with stand(world, stage) as (h, _):
        with pytest.raises(InstrumentRefused, match=words):
            h.move(45 * DEG, 1, "1/turn")
        assert world.scale_angle_rad == pytest.approx(20 * DEG)
        world.head_fault = HeadFault()
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)


def test_a_head_that_stops_off_target_is_refused() -> None:
    world = a_world()
    world.head_fault = HeadFault(stops_off_rad=-30 * ARCSEC)
    with stand(world) as (h, _), pytest.raises(InstrumentRefused, match=r"0°00′[23].*″ below it"):
        h.move(45 * DEG, 1, "1/turn")


def test_lines_that_come_between_are_no_replies() -> None:
    world = a_world()
    count = 0

    def chatter(message: bytes, reply: bytes | None) -> WireFault | None:
        nonlocal count
        count += 1
        if b"get pos" in message and count % 5 == 0:
            return WireFault(
                lines=(b"!01 1 IDLE --\r", b"#01 0 a line of information\r", (reply or b"") + b"\r")
            )
        return None

    with stand(world, fault=chatter) as (h, _):
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)


@pytest.mark.parametrize("spoil", [lambda reply: reply[:-2] + b"00", lambda reply: reply[:-3]])
def test_a_reply_with_a_wrong_or_missing_checksum_is_asked_again_but_not_for_ever(
    spoil: Callable[[bytes], bytes],
) -> None:
    world = a_world()
    spoilt = {"left": 1}

    def fault(message: bytes, reply: bytes | None) -> WireFault | None:
        if b"get pos" not in message or spoilt["left"] == 0 or reply is None:
            return None
        spoilt["left"] -= 1
        return WireFault(lines=(spoil(reply),))

    with stand(world, fault=fault, checksums=True) as (h, _):
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)
        assert spoilt["left"] == 0
        spoilt["left"] = 1000
        with pytest.raises(BadReading, match="has no right checksum"):
            h.move(90 * DEG, 1, "2/turn")
        assert 1000 - spoilt["left"] == 3


def test_alerts_are_switched_off() -> None:
    world = a_world()
    stage = ZaberStage(world, steps_per_degree=STEPS)
    stage.handle(b"/1 0 set comm.alert 1", lambda: False)
    log: list[tuple[str, str]] = []
    with stand(world, stage, log=log) as (h, _):
        h.move(45 * DEG, 1, "1/turn")
    assert not [text for _, text in log if text.startswith("!")]


def test_a_lost_connection_at_the_move_stops_the_head_over_a_new_one() -> None:
    world = a_world()
    cut = iter([True])

    def drop(message: bytes, reply: bytes | None) -> WireFault | None:
        return DROP if b"move abs" in message and next(cut, False) else None

    with stand(world, fault=drop) as (h, _):
        with pytest.raises(InstrumentLost):
            h.move(45 * DEG, 1, "1/turn")
        assert world.head_rate_rad_s == 0.0
        assert world.scale_angle_rad < 1 * DEG
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)


def test_somebody_at_the_knob_is_noticed() -> None:
    world = a_world()
    with stand(world) as (h, stage):

        def knob(message: bytes, reply: bytes | None) -> None:
            if b"get pos" in message and world.scale_angle_rad > 20 * DEG:
                stage.turn_knob(10 * DEG)

        handle = stage.handle
        stage.handle = lambda message, i: (knob(message, None), handle(message, i))[1]  # type: ignore[method-assign]
        with pytest.raises(InstrumentRefused, match="turned by its knob"):
            h.move(45 * DEG, 1, "1/turn")


def test_a_head_left_moving_by_a_program_that_died_is_stopped_first() -> None:
    world = a_world()
    with stand(world) as (dead, stage):
        dead.start(300 * DEG)
        world.clock.sleep(1.0)
        with stand(world, stage) as (h, _):
            assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)


def test_a_head_that_was_closed_is_not_moved() -> None:
    world = a_world()
    with stand(world) as (h, _):
        h.close()
        with pytest.raises(InstrumentLost, match="is not open"):
            h.move(45 * DEG, 1, "1/turn")
    assert world.scale_angle_rad == 0.0


def test_closing_stops_a_head_that_moves() -> None:
    world = a_world()
    with stand(world) as (h, _):
        h.start(45 * DEG)
        world.clock.sleep(1.0)
    assert world.head_rate_rad_s == 0.0
    assert world.scale_angle_rad == pytest.approx(10 * DEG, rel=1e-3)


@pytest.mark.skipif(not TERMINALS, reason="this system has no pseudo-terminals")
def test_over_a_serial_port_and_after_a_lost_reply() -> None:
    world = a_world()
    lost = iter([True])

    def silent(message: bytes, reply: bytes | None) -> WireFault | None:
        return SILENCE if b"get pos" in message and next(lost, False) else None

    with TerminalServer(
        ServedInstrument(ZaberStage(world, steps_per_degree=STEPS), fault=silent)
    ) as terminal:
        session = MessageSession(
            "head",
            terminal.resource,
            timeout_s=0.2,
            read_termination=READ_TERMINATION,
            write_termination=WRITE_TERMINATION,
            serial=SerialSettings(**SERIAL),
        )
        h = head(session, world.clock)
        h.open()
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG)
        assert next(lost, False) is False
        h.close()
