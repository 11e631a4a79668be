"""The Heidenhain ND 281B and ND 287 against what their manuals say."""

import math

import pytest

from drivers.facts import heidenhain_nd28x as facts
from drivers.instruments.heidenhain_nd28x import HeidenhainNd28x
from drivers.interfaces import BadReading, Identity, InstrumentRefused
from drivers.readout import Approach, ScaleOfEncoder
from drivers.wire.replay import WireLog, replayed
from sim.counters import HeidenhainNd28x as SimulatedNd28x
from tests.support.scripted_session import ScriptedSession, swapped, until
from tests.support.simulated_stand import a_world, served

ESC = "\x1b"
OPENED_281B = [
    (f"{ESC}A0400", "\x02349797-04 "),
    (f"{ESC}A0000", "\x02ND-281B   \r\n349797-04 \r\n2001-05-04"),
]
OPENED_287 = [
    (f"{ESC}A0400", "\x02646118-01 "),
    (f"{ESC}A0000", "\x02ND-287    \r\n646118-01 \r\nV1-01     "),
    (f"{ESC}A0800", "\x0200010211"),
]
READ = [(f"{ESC}A0900", "\x0211000000000000"), (f"{ESC}A0100", "\x02+00045.0028")]
READ_287 = [(f"{ESC}A0900", "\x02000000010"), (f"{ESC}A0100", "\x02-12345.6789")]
APPROACH = Approach(1e-4, 0.02, 1e-5, 2.0, 1.5)


def head(*parts, model="ND-281B", **scale):
    session = ScriptedSession(*parts)
    counter = HeidenhainNd28x(
        "head", session, session.clock, None, APPROACH, model=model, scale=ScaleOfEncoder(**scale)
    )  # type: ignore[arg-type]
    return counter, session


@pytest.mark.parametrize(
    ("model", "pairs", "firmware", "angle_deg"),
    [
        ("ND-281B", [*OPENED_281B, *READ], "349797-04 2001-05-04", 45.0028),
        ("ND-287", [*OPENED_287, *READ_287], "646118-01 V1-01", -12345.6789),
    ],
)
def test_a_counter_is_proved_with_its_unit_and_read(model, pairs, firmware, angle_deg):
    counter, session = head(pairs, model=model)
    assert counter.open() == Identity("HEIDENHAIN", model, firmware=firmware)
    assert math.degrees(counter.position_rad()) == pytest.approx(angle_deg)
    assert session.left == []


def test_another_model_than_that_of_the_bench_file_is_refused():
    counter, _ = head(OPENED_281B, model="ND-287")
    with pytest.raises(InstrumentRefused, match=r"it is an ND-281B, not an ND-287; state its model"):
        counter.open()


@pytest.mark.parametrize(
    ("bar", "why"),
    [
        ("10010211", "distance to go"),
        ("00110211", "scaling factor"),
        ("00010311", "decimal degrees"),
        ("00010011", "decimal degrees"),
    ],
)
def test_an_nd_287_that_shows_something_else_is_refused(bar, why):
    counter, _ = head(swapped(OPENED_287, f"{ESC}A0800", f"\x02{bar}"), model="ND-287")
    with pytest.raises(InstrumentRefused, match=why):
        counter.open()


@pytest.mark.parametrize(("model", "indicators"), [("ND-281B", "01"), ("ND-281B", "21"), ("ND-287", "02")])
def test_a_value_without_reference_mark_is_no_angle(model, indicators):
    opened = OPENED_281B if model == "ND-281B" else OPENED_287
    said = indicators + "0" * (12 if model == "ND-281B" else 7)
    counter, session = head(opened, [(f"{ESC}A0900", f"\x02{said}")], model=model)
    counter.open()
    with pytest.raises(InstrumentRefused, match=r"a relative angle, as its reference mark"):
        counter.position_rad()
    assert session.left == []  # the display is not even asked


def test_inches_are_refused():
    counter, _ = head(OPENED_281B, swapped(until(READ, f"{ESC}A0900"), f"{ESC}A0900", "\x0211000010000000"))
    counter.open()
    with pytest.raises(InstrumentRefused, match="it shows inches"):
        counter.position_rad()


@pytest.mark.parametrize("shown", ["SIGNAL ERR. ", "ENT...CL  ", "+045.00.10", "+000000045", "+45.0028"])
def test_what_is_shown_in_place_of_degrees_is_told(shown):
    counter, _ = head(OPENED_281B, swapped(READ, f"{ESC}A0100", f"\x02{shown}"))
    counter.open()
    with pytest.raises(InstrumentRefused, match="instead of an angle in decimal degrees") as told:
        counter.position_rad()
    assert shown.strip() in told.value.cause


@pytest.mark.parametrize("reply", ["+00045.0028", "\x02", "\x02+00045.0028+00045.0028", facts.NAK])
def test_half_a_reply_or_two_is_none(reply):
    bad = (f"{ESC}A0100", reply)
    counter, session = head(OPENED_281B, READ[:1], [bad], OPENED_281B, [bad], OPENED_281B, [bad])
    counter.open()
    with pytest.raises(BadReading):
        counter.position_rad()
    assert session.left == []  # asked three times, each time proved anew


@pytest.mark.parametrize("sign", [" ", "+"])
def test_blanks_for_a_plus_and_leading_zeros_are_understood(sign):
    counter, _ = head(OPENED_281B, swapped(READ, f"{ESC}A0100", f"\x02{sign}    45.0028"))
    counter.open()
    assert math.degrees(counter.position_rad()) == pytest.approx(45.0028)


def test_a_session_with_a_name_of_three_lines_goes_through_again(tmp_path):
    log = WireLog(tmp_path / "wire.log")
    with served(
        SimulatedNd28x(world := a_world()),
        "head",
        world,
        read_termination=facts.READ_TERMINATION,
        write_termination=facts.WRITE_TERMINATION,
        wire=log,
    ) as session:
        of_wire = HeidenhainNd28x(
            "head", session, world.clock, None, APPROACH, model="ND-281B", scale=ScaleOfEncoder()
        )  # type: ignore[arg-type]
        identity = of_wire.open()
        of_wire.position_rad()
        of_wire.close()
    log.close()
    with replayed(log.path, "head") as (session, clock):
        again = HeidenhainNd28x(
            "head", session, clock, None, APPROACH, model="ND-281B", scale=ScaleOfEncoder()
        )  # type: ignore[arg-type]
        assert again.open() == identity
        assert again.position_rad() == 0.0


@pytest.mark.parametrize("reply", [b"ND-281B\r\n349797-04", b"ND-281B\r\n349797-04\r\n2001-05-04\r\nmore"])
def test_a_name_that_is_cut_or_followed_by_more_is_refused(reply):
    class Wrong(SimulatedNd28x):
        @property
        def _device(self):
            return reply.decode()

    world = a_world()
    ends = {"read_termination": facts.READ_TERMINATION, "write_termination": facts.WRITE_TERMINATION}
    with served(Wrong(world), "head", world, timeout_s=0.1, **ends) as session, pytest.raises(BadReading):
        HeidenhainNd28x(
            "head", session, world.clock, None, APPROACH, model="ND-281B", scale=ScaleOfEncoder()
        ).open()  # type: ignore[arg-type]


def test_a_counter_exchanged_between_two_connections_is_refused():
    """Another counter counts from a reference mark of its own."""
    other = swapped(OPENED_281B, f"{ESC}A0000", "\x02ND-281B   \r\n349797-04 \r\n2003-01-15")
    counter, session = head(OPENED_281B, other)
    counter.open()
    session.connection = None
    with pytest.raises(
        InstrumentRefused, match=r"was HEIDENHAIN ND-281B .* 2001-05-04 and is now .* 2003-01-15"
    ):
        counter.open()
