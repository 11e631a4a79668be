"""The Zaber driver against the protocol manual's text."""

from collections.abc import Callable
from contextlib import contextmanager
from functools import partial

import pytest

from bench.base.arrays import ARCSEC
from drivers.facts import zaber as facts
from drivers.instruments.zaber import ZaberHead
from drivers.interfaces import BadReading, DividingHead, HeadPosition, Identity, InstrumentRefused
from sim.wires.session import WireFault
from sim.zaber import ZaberStage
from tests.support.motorised_heads import DEG, opened, travel
from tests.support.scripted_session import Clock, Pairs, ScriptedSession, swapped, until
from tests.support.simulated_stand import a_world

STEPS = 12800 / 3
"""Microsteps per degree of a stage with 0.9 arcsec steps."""
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


def head(session: object, clock: object | None = None, **options: object) -> ZaberHead:
    options = {"steps_per_degree": STEPS} | options
    return ZaberHead("head", session, clock or Clock(), travel(10 * ARCSEC), **options)  # type: ignore[arg-type]


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
        ("ZZ", "an unknown warning"),
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
        (0.0, "steps_per_degree: state a number other than 0"),
        (1e8, "exceed 2147483647 steps"),
        (100.0, "coarser than its tolerance"),
    ],
)
def test_steps_that_cannot_express_the_angles_are_refused(steps: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        head(ScriptedSession(), steps_per_degree=steps)


# --- zaber stage ------------------------------------------------------------------------------------
# The Zaber driver over a real socket and a serial port, with a simulated stage.


@contextmanager
def stand(world, stage=None, fault=None, **options):
    stage = stage or ZaberStage(world, steps_per_degree=STEPS)
    with opened(stage, partial(head, **options), world, facts, fault=fault) as h:
        yield h, stage


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
        with pytest.raises(BadReading, match="has a wrong checksum"):
            h.move(90 * DEG, 1, "2/turn")
        assert 1000 - spoilt["left"] == 3


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
