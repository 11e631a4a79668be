"""The Newport ESP301 driver against what public programs show of one, and with the simulated controller."""

from functools import partial

import pytest

from drivers.facts import newport_esp301 as facts
from drivers.instruments.newport_esp301 import NewportHead
from drivers.interfaces import BadReading, HeadPosition, Identity, InstrumentLost, InstrumentRefused
from sim.newport_esp301 import Esp301
from sim.wires.session import SILENCE, WireFault
from tests.support.motorised_heads import DEG, opened, travel
from tests.support.scripted_session import Clock, Pairs, ScriptedSession, swapped, until
from tests.support.simulated_stand import a_world

TRAVEL = travel(0.0015 * DEG)

FINE = "0, 451322, NO ERROR DETECTED"
OFF = "113, 314883, AXIS-1 MOTOR NOT ENABLED"
SETTINGS: Pairs = [("1SN?", "7"), ("1VA?", "10.000")]
OPEN: Pairs = [
    ("*IDN?", "ESP300 Version 3.04 07/27/01"),
    ("TB?", OFF),
    ("TB?", FINE),
    ("1VA10.000000;TB?", FINE),
    *SETTINGS,
    ("1TP?", "12.345"),
]
PREPARE: Pairs = [("1MD?", "1"), ("TB?", FINE), *SETTINGS, ("1MO?", "1"), ("1TP?", "12.345")]
STANDS: Pairs = [("1MD?", "1"), ("TB?", FINE), ("1MO?", "1"), ("1TP?", "45.001")]
MOVE: Pairs = [
    ("1PA45.000000;TB?", FINE),
    ("1MD?", "0"),
    ("TB?", FINE),
    ("1MO?", "1"),
    ("1TP?", "30.000"),
    *STANDS,
    *STANDS,
    *STANDS,
]
STOP: Pairs = [("1ST;TB?", FINE)]


def head(session: object, clock: object | None = None, **options: object) -> NewportHead:
    return NewportHead("head", session, clock or Clock(), TRAVEL, **options)  # type: ignore[arg-type]


def test_a_whole_move_after_which_it_is_stopped_and_held() -> None:
    clock = Clock()
    script = ScriptedSession(OPEN, PREPARE, MOVE, STOP, clock=clock)
    h = head(script, clock)
    assert h.open() == Identity("Newport", "ESP300", "", "3.04 07/27/01")
    assert h.move(45 * DEG, 1, "1/turn") == HeadPosition(pytest.approx(45.001 * DEG, abs=1e-12), 1)  # type: ignore[arg-type]
    assert h.close() == ""
    assert h.close() == ""
    assert script.left == []


@pytest.mark.parametrize(
    ("target_deg", "sent"), [(-5.0, "-5.000000"), (-1e-9, "0.000000"), (359.9999996, "360.000000")]
)
def test_how_an_angle_is_sent(target_deg: float, sent: str) -> None:
    script = ScriptedSession(OPEN, [(f"1PA{sent};TB?", FINE)])
    h = head(script)
    h.open()
    h.start(target_deg * DEG)
    assert script.left == []


@pytest.mark.parametrize(
    ("command", "reply", "told"),
    [
        ("*IDN?", "ESP100 Version 1.0", "no model like ESP30"),
        ("*IDN?", "ACME,COFFEE-MAKER,0,1.0", "is 'ACME,COFFEE-MAKER,0,1.0'"),
        ("1VA10.000000;TB?", "110, 1, AXIS-1 MAXIMUM VELOCITY EXCEEDED", "110.*state a speed"),
        ("1SN?", "2", "has unit 2, not degrees"),
        ("1VA?", "1.000", "did not accept the speed: its speed is 1 deg/s, not 10 deg/s"),
        ("1TP?", "12.35", "2 decimals of a degree, coarser than its tolerance of"),
    ],
)
def test_one_that_is_not_as_it_must_be_is_refused(command: str, reply: str, told: str) -> None:
    script = ScriptedSession(swapped(until(OPEN, command), command, reply))
    with pytest.raises(InstrumentRefused, match=told):
        head(script).open()
    assert script.left == []


@pytest.mark.parametrize(
    ("pairs", "command", "reply", "told"),
    [
        (PREPARE, "1MO?", "0", "its motor is off: it may have lost its reference.*allow homing"),
        (PREPARE, "1VA?", "1.000", "was switched off or its settings changed: its speed is 1 deg/s"),
        ([*PREPARE, *MOVE], "1PA45.000000;TB?", OFF, "move the axis to 45° and reports error 113, AXIS-1"),
    ],
)
def test_it_does_not_move_when_its_angle_may_be_false(
    pairs: Pairs, command: str, reply: str, told: str
) -> None:
    script = ScriptedSession(OPEN, swapped(until(pairs, command), command, reply), STOP)
    h = head(script)
    h.open()
    with pytest.raises(InstrumentRefused, match=told):
        h.move(45 * DEG, 1, "1/turn")
    assert script.left == []


@pytest.mark.parametrize(
    ("replies", "told"),
    [
        (("103, 9, AXIS-1 FOLLOWING ERROR THRESHOLD EXCEEDED",), "reports error 103.*free the head"),
        (("4, 9, EMERGENCY STOP ACTIVATED",), "reports error 4, EMERGENCY STOP ACTIVATED"),
        ((FINE, "0"), "its motor went off on the way"),
    ],
)
def test_what_happens_on_the_way_is_said(replies: tuple[str, ...], told: str) -> None:
    way = [("1PA45.000000;TB?", FINE), ("1MD?", "0"), *zip(("TB?", "1MO?"), replies, strict=False)]
    script = ScriptedSession(OPEN, PREPARE, way, STOP)
    h = head(script)
    h.open()
    with pytest.raises(InstrumentRefused, match=told):
        h.move(45 * DEG, 1, "1/turn")
    assert script.left == []


def test_errors_without_end_are_said() -> None:
    script = ScriptedSession(OPEN[:1], [("TB?", "20, 5, DATA ACQUISITION IS BUSY")] * 11)
    with pytest.raises(InstrumentRefused, match="errors, the last of them 20, DATA ACQUISITION IS BUSY"):
        head(script).open()
    assert script.left == []


@pytest.mark.parametrize("reply", ["45", "45.", "45.0 45.0", "nan", "1TP45.0"])
def test_half_an_angle_is_none(reply: str) -> None:
    h = head(ScriptedSession([*OPEN[:-1], ("1TP?", reply)] * 3))
    with pytest.raises(BadReading):
        h.open()


# --- with the simulated controller ------------------------------------------------------------------


def stand(world, dialect, fault=None, **options):
    return opened(dialect, partial(head, **options), world, facts, fault=fault, timeout_s=0.2)


def test_homing_finds_the_zero_only_where_it_is_allowed() -> None:
    world = a_world()
    world.turn(12.0 * DEG, 1)
    with stand(world, Esp301(world, homed=False)) as h:
        with pytest.raises(InstrumentRefused, match="motor is off"):
            h.move(45 * DEG, 1, "1/turn")
        assert world.scale_angle_rad == 12.0 * DEG
    with stand(world, Esp301(world, homed=False), allow_homing=True) as h:
        assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45 * DEG, abs=1e-6)
        assert world.scale_angle_rad == pytest.approx(45 * DEG, abs=1e-6)


def test_a_demand_whose_answer_was_lost_is_not_sent_again_and_the_head_stopped() -> None:
    world = a_world()
    sent: list[bytes] = []

    def silent(message: bytes, reply: bytes | None) -> WireFault | None:
        sent.append(message)
        return SILENCE if message.startswith(b"1PA") else None

    with stand(world, Esp301(world), silent) as h:
        with pytest.raises(InstrumentLost, match="did not answer 1PA45"):
            h.move(45 * DEG, 1, "1/turn")
        assert sum(message.startswith(b"1PA") for message in sent) == 1
        assert world.head_rate_rad_s == 0.0
