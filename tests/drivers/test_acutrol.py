"""The ACUTROL driver against the public client's commands, and over a real socket with a simulated table."""

from itertools import pairwise

import pytest

from drivers.facts import acutrol as facts
from drivers.instruments.acutrol import AcutrolHead
from drivers.interfaces import DividingHead, HeadPosition, Identity, InstrumentLost, InstrumentRefused
from drivers.motion import Travel
from sim.acutrol import AcutrolTable
from sim.wires.session import SILENCE, WireFault
from tests.support.motorised_heads import DEG, opened, travel
from tests.support.scripted_session import Clock, Pairs, ScriptedSession
from tests.support.simulated_stand import a_world

TRAVEL = travel(0.003 * DEG)

OK = "ACUTROL>OK"
PROVE: Pairs = [(":read:position 1", "ACUTROL>12.345678")]
OPEN: Pairs = [
    *PROVE,
    (":utility:lockout on", OK),
    (":interlock:open 1", OK),
    (":interlock:reset 1", OK),
    (":interlock:close 1", OK),
]
MOVE: Pairs = [
    (":read:position 1", "ACUTROL>12.345678"),
    (":demand:position 1, 012.346", OK),
    (":mode:position 1", OK),
    (":read:position 1", "ACUTROL>12.346000"),
    (":demand:position 1, 045.000", OK),
    (":read:rate 1", "ACUTROL>+9.9E+00"),
    (":read:position 1", "ACUTROL>30.000000"),
    (":read:rate 1", "ACUTROL>0.001000"),
    (":read:position 1", "ACUTROL>45.001000"),
    (":read:rate 1", "ACUTROL>-0.001000"),
    (":read:position 1", "ACUTROL>45.001000"),
    (":read:rate 1", "ACUTROL>0.000000"),
    (":read:position 1", "ACUTROL>44.999000"),
]
STOP: Pairs = [(":demand:rate 1, 000.000", OK), (":mode:rate 1", OK)]
CLOSE: Pairs = [*STOP, (":mode:off 1", OK), (":interlock:open 1", OK)]


def head(session: object, clock: object | None = None, **options: object) -> AcutrolHead:
    return AcutrolHead("head", session, clock or Clock(), TRAVEL, **options)  # type: ignore[arg-type]


def test_a_table_that_refuses_rate_0_is_switched_off_and_not_put_into_its_rate_mode() -> None:
    refused = [(":demand:rate 1, 000.000", "ACUTROL>ERR"), (":mode:off 1", OK)]
    script = ScriptedSession(OPEN, refused)
    h = head(script)
    h.open()
    with pytest.raises(
        InstrumentRefused, match=r"did not accept rate 0, .*:demand:rate 1, 000.000 with 'ERR'"
    ):
        h.stop()
    assert script.left == []


def test_start_up_move_and_leaving_at_rate_zero() -> None:
    clock = Clock()
    script = ScriptedSession(OPEN, MOVE, CLOSE, clock=clock)
    h = head(script, clock)
    assert isinstance(h, DividingHead)
    assert h.open() == Identity("Acutronic", "ACUTROL")
    assert h.move(45 * DEG, 1, "1/turn") == HeadPosition(pytest.approx(44.999 * DEG, abs=1e-12), 1)  # type: ignore[arg-type]
    assert h.close() == ""
    assert h.close() == ""
    assert script.left == []
    times_s = [time_s for _, time_s in script.sent_at_s]
    assert all(later - earlier >= 0.25 for earlier, later in pairwise(times_s[1:6]))


@pytest.mark.parametrize(
    ("target_deg", "sent"),
    [(-5.0, "-005.000"), (0.0, "000.000"), (-1e-9, "000.000"), (359.9996, "360.000"), (45.00049, "045.000")],
)
def test_how_an_angle_is_sent(target_deg: float, sent: str) -> None:
    script = ScriptedSession(OPEN, [(f":demand:position 1, {sent}", OK)])
    h = head(script)
    h.open()
    h.start(target_deg * DEG)
    assert script.left == []


def test_a_closed_interlock_that_is_refused_is_said() -> None:
    script = ScriptedSession([*OPEN[:4], (":interlock:close 1", "ACUTROL>ERR")])
    with pytest.raises(InstrumentRefused, match=":interlock:close 1 with 'ERR', not OK; check the interlock"):
        head(script).open()


def test_ctrl_c_stops_the_table_and_the_next_move_enters_the_mode_again() -> None:
    broken: Pairs = [*MOVE[:5], (":read:rate 1", KeyboardInterrupt())]
    script = ScriptedSession(OPEN, broken, STOP, PROVE, MOVE)
    h = head(script)
    h.open()
    with pytest.raises(KeyboardInterrupt):
        h.move(45 * DEG, 1, "1/turn")
    assert h.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(44.999 * DEG)
    assert script.left == []


def test_a_tolerance_finer_than_a_demand_is_refused() -> None:
    fine = Travel(minimum_rad=0.0, maximum_rad=6.0, tolerance_rad=1e-6, speed_rad_s=1.0)
    with pytest.raises(ValueError, match="more than the tolerance"):
        AcutrolHead("head", ScriptedSession(), Clock(), fine)  # type: ignore[arg-type]


# --- over a real socket, with the simulated table ----------------------------------------------------


def stand(world, fault=None, timeout_s=2.0):
    return opened(AcutrolTable(world), head, world, facts, fault=fault, timeout_s=timeout_s)


def test_entering_the_position_mode_moves_nothing() -> None:
    world = a_world()
    world.turn(100.0 * DEG, 1)
    with stand(world) as h:
        h.prepare()
        world.clock.sleep(60.0)
        assert world.scale_angle_rad == pytest.approx(100.0 * DEG, abs=1e-9)


def test_a_silent_controller_is_lost_and_the_table_stopped_over_a_new_connection() -> None:
    world = a_world()

    def silent(message: bytes, reply: bytes | None) -> WireFault | None:
        return SILENCE if message == b":demand:position 1, 045.000" else None

    with stand(world, silent, timeout_s=0.2) as h:
        with pytest.raises(InstrumentLost, match=r"did not answer :demand:position 1, 045\.000 within"):
            h.move(45 * DEG, 1, "1/turn")
        assert world.head_rate_rad_s == 0.0
        world.clock.sleep(60.0)
        assert world.scale_angle_rad < 1 * DEG
