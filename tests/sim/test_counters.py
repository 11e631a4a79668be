"""The simulated counters of an encoder: what they say on the wire, what is lost when they are switched off."""

import json
import math

import pytest

from sim.bench import SimulatedBench
from sim.control import BenchControl
from sim.counters import EncoderLine, HeidenhainNd28x, MitutoyoMux10
from sim.scpi import never
from tests.support.simulated_stand import a_world


@pytest.fixture
def world():
    made = a_world()
    made.turn(math.radians(45.0028), 1)
    return made


def told(dialect, message):
    return dialect.handle(message, never)


def test_an_nd_281b_speaks_as_its_manual_has_it(world):
    counter = HeidenhainNd28x(world)
    assert told(counter, b"\x1bA0000") == b"\x02ND-281B   \r\n349797-04 \r\n2001-05-04"
    assert told(counter, b"\x1bA0100") == b"\x02+00045.0028"
    assert told(counter, b"\x1bA0900") == b"\x0211000000000000"
    assert told(counter, b"\x1bA0800") == b"\x15"


def test_an_nd_287_has_a_status_bar(world):
    counter = HeidenhainNd28x(world, model="ND-287", falling=True, zero_deg=90.0)
    assert told(counter, b"\x1bA0800") == b"\x0200010211"
    assert told(counter, b"\x1bA0100") == b"\x02+00044.9972"


def test_a_counter_that_was_switched_off_counts_from_where_the_head_stands(world):
    counter = HeidenhainNd28x(world)
    counter.power_cycle()
    assert told(counter, b"\x1bA0100") == b"\x02+00000.0000"
    assert told(counter, b"\x1bA0900").startswith(b"\x022")
    world.turn(math.radians(46.0), 1)
    assert told(counter, b"\x1bA0100") == b"\x02+00000.9972"
    counter.cross_reference()
    assert told(counter, b"\x1bA0100") == b"\x02+00046.0000"
    counter.lose_counts(0.5)
    assert told(counter, b"\x1bA0100") == b"\x02+00045.5000"
    assert HeidenhainNd28x(world, referenced=False).shown_deg == 0.0


def test_a_signal_that_failed_is_shown_in_place_of_the_value(world):
    counter, mux = HeidenhainNd28x(world), MitutoyoMux10(world, channel=2)
    assert told(mux, b"2") == b"02A+045.0028"
    assert told(mux, b"1") is None
    counter.fail()
    mux.fail()
    assert told(counter, b"\x1bA0100") == b"\x02SIGNAL ERR. "
    assert told(mux, b"2") == b"911"


@pytest.mark.parametrize(
    ("pattern", "example", "per_turn", "line"),
    [
        (r"POS=(?P<angle>[+-]\d+\.\d+) deg", "POS=+001.00000 deg", 360.0, b"POS=+045.00280 deg"),
        (r"(?P<angle>\d+)", "00000000", 1296000.0, b"00162010"),
        (r"N(?P<angle>-?\d+)", "N1", 8192.0, b"N1024"),
        (r"(?P<angle> *\d+\.\d)", "   1.0", 360.0, b"45.0"),
    ],
)
def test_a_line_has_the_form_of_its_example(world, pattern, example, per_turn, line):
    ends = ("\r", "\n")
    counter = EncoderLine(
        world, request="?", pattern=pattern, example=example, per_turn=per_turn, ends=ends, errors=("E1",)
    )
    assert told(counter, b"?") == line
    assert told(counter, b"!") is None
    assert counter.line_ends.messages == (b"\r",)
    counter.fail()
    assert told(counter, b"?") == b"E1"


def test_by_the_control_a_head_with_an_encoder_is_turned_as_by_a_hand(world):
    with SimulatedBench(world, {"head": HeidenhainNd28x(world)}) as bench:
        assert json.loads(BenchControl(bench).handle(b"turn 65 deg", never))["ok"]
        world.clock.sleep(0.5)
        assert world.scale_angle_rad == pytest.approx(math.radians(55.0028), abs=1e-9)
        world.clock.sleep(0.5)
        assert world.scale_angle_rad == pytest.approx(math.radians(65.0))
