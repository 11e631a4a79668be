"""What every encoder of a head that a person turns must do: its angle, its side, no angle where there is none."""

import contextlib
import math

import pytest

from drivers.interfaces import BadReading, BenchError, InstrumentRefused, LimitExceeded
from sim.wires.faults import Fault, FaultKind
from tests.support.instrument_stand import standing, turned_by

read_outs = pytest.mark.parametrize("device", turned_by("hand"), ids=lambda device: device.name)
HANDS_FREE = {"hands_free": "yes"}


class Watched:
    """The person of a stand, whose questions and keys are counted."""

    def __init__(self, hands):
        self.hands = hands
        self.keys: list[str] = []
        self.prompts: list[str] = []

    @property
    def meanwhile(self):
        return self.hands.meanwhile

    @meanwhile.setter
    def meanwhile(self, look):
        self.hands.meanwhile = look

    def ask(self, prompt):
        self.prompts.append(prompt.text)
        answer = self.hands.ask(prompt)
        self.keys.append(prompt.action["do"])
        return answer


def watched(stand):
    stand.driver._person = person = Watched(stand.driver._person)
    return person


@read_outs
@pytest.mark.parametrize("changes", [HANDS_FREE, {}], ids=["hands free", "confirmed"])
@pytest.mark.parametrize(("target_deg", "direction"), [(90.0, 1), (360.0, 1), (0.0, -1), (270.0, -1)])
def test_its_angle_is_that_of_the_head_come_to_from_the_side_demanded(
    device, tmp_path, changes, target_deg, direction
):
    with standing(device, tmp_path, **changes) as stand:
        person = watched(stand)
        stand.driver.open()
        position = stand.driver.move(math.radians(target_deg), direction, "1/turn")
        assert position.direction == direction == stand.world.direction
        assert abs(position.angle_rad - math.radians(target_deg)) <= stand.section.tolerance
        assert position.angle_rad == pytest.approx(stand.world.scale_angle_rad, abs=1e-5)
        assert person.keys.count("turn") == (0 if changes else 1)


@read_outs
@pytest.mark.parametrize("falling", ["yes", "no"])
def test_zero_and_sense_of_the_encoder_are_those_of_the_bench_file(device, tmp_path, falling):
    with standing(device, tmp_path, zero="12.5 deg", falling=falling, **HANDS_FREE) as stand:
        stand.driver.open()
        assert stand.driver.move(1.0, 1, "1/turn").angle_rad == pytest.approx(1.0, abs=2e-4)
        assert stand.driver.position_rad() == pytest.approx(stand.world.scale_angle_rad, abs=1e-5)


@read_outs
def test_counts_that_are_lost_on_the_way_are_told_and_nothing_is_read(device, tmp_path):
    with standing(device, tmp_path, **HANDS_FREE) as stand:
        stand.driver.open()
        stand.driver.move(0.5, 1, "1/turn")
        person = watched(stand)
        looks = []

        def ask(prompt):
            looks.append(1)
            stand.dialect.lose_counts(123.0)
            stand.world.clock.sleep(0.5)
            person.meanwhile()
            raise AssertionError("a jump was not told")

        person.ask = ask
        with pytest.raises(
            BadReading, match=r"jumped by 123°00′\d\d″ .* faster than 90°/s; .*reference mark"
        ):
            stand.driver.move(1.0, 1, "2/turn")
        assert looks


@read_outs
def test_a_signal_that_fails_is_told_and_nothing_is_read(device, tmp_path):
    with standing(device, tmp_path, **HANDS_FREE) as stand:
        stand.driver.open()
        stand.dialect.fail()
        with pytest.raises(BenchError) as told:
            stand.driver.move(0.5, 1, "1/turn")
        assert told.value.remedy
        assert told.value.instrument == "head"
        assert isinstance(told.value, InstrumentRefused | BadReading)


@read_outs
def test_without_a_reference_mark_nothing_is_read_unless_somebody_says_otherwise(device, tmp_path):
    with standing(device, tmp_path, **HANDS_FREE) as stand:
        stand.dialect.power_cycle()
        stand.driver.open()
        person = watched(stand)
        if stand.driver._tells_reference:
            with pytest.raises(InstrumentRefused, match="a relative angle"):
                stand.driver.move(0.5, 1, "1/turn")
            assert person.prompts == []
        else:
            stand.driver.move(0.5, 1, "1/turn")
            assert person.prompts[0].startswith("Turn the head across the encoder's reference mark.")
        stand.dialect.cross_reference()
        assert stand.driver.move(0.5, 1, "2/turn").angle_rad == pytest.approx(0.5, abs=2e-4)


@read_outs
@pytest.mark.parametrize("kind", [FaultKind.CUT, FaultKind.GARBLE, FaultKind.TWICE, FaultKind.DROP])
def test_a_wire_that_fails_shows_no_false_angle(device, tmp_path, kind):
    with standing(device, tmp_path, timeout="0.5 s", **HANDS_FREE) as stand:
        stand.driver.open()
        stand.served.arm(Fault(kind, at=9, instrument="head"))
        with contextlib.suppress(BenchError):
            position = stand.driver.move(0.5, 1, "1/turn")
            assert position.angle_rad == pytest.approx(stand.world.scale_angle_rad, abs=1e-5)
        assert len(stand.sent) >= 9


@read_outs
def test_an_angle_that_is_none_is_refused_before_anybody_is_asked(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        with pytest.raises(LimitExceeded):
            stand.driver.move(math.nan, 1, "1/turn")
