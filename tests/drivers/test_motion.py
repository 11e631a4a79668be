"""What motorised heads share, on an axis without a wire."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from bench.base.arrays import ARCSEC
from drivers.interfaces import HeadPosition, InstrumentRefused, LimitExceeded
from drivers.motion import Mover, Travel
from tests.support.scripted_session import Clock

DEG = math.pi / 180
TRAVEL = Travel(
    minimum_rad=-10 * DEG,
    maximum_rad=370 * DEG,
    tolerance_rad=10 * ARCSEC,
    speed_rad_s=10 * DEG,
    settle_s=2.0,
)


class FakeAxis:
    """Turns at `speed_rad_s`; `error_rad` of the time since a movement began is added to what it shows."""

    def __init__(self, clock: Clock, at_deg: float = 0.0, speed_deg_s: float = 10.0) -> None:
        self.clock = clock
        self.at_rad = at_deg * DEG
        self.target_rad = self.at_rad
        self.since_s = 0.0
        self.speed_rad_s = speed_deg_s * DEG
        self.error_rad: Callable[[float], float] = lambda _: 0.0
        self.targets_deg: list[float] = []
        self.stops = 0
        self.interrupt_at_s = math.inf

    def prepare(self) -> None:
        pass

    def _true_rad(self) -> float:
        way_rad = self.target_rad - self.at_rad
        turned_rad = (self.clock.now_s() - self.since_s) * self.speed_rad_s
        return (
            self.target_rad
            if turned_rad >= abs(way_rad)
            else self.at_rad + math.copysign(turned_rad, way_rad)
        )

    def position_rad(self) -> float:
        if self.clock.now_s() >= self.interrupt_at_s:
            raise KeyboardInterrupt
        return self._true_rad() + self.error_rad(self.clock.now_s() - self.since_s)

    def start(self, target_rad: float) -> None:
        self.targets_deg.append(round(math.degrees(target_rad), 9))
        self.at_rad, self.since_s, self.target_rad = self._true_rad(), self.clock.now_s(), target_rad

    def moving(self) -> bool:
        return self._true_rad() != self.target_rad

    def stop(self) -> None:
        self.stops += 1


def a_mover(at_deg: float = 0.0, travel: Travel = TRAVEL) -> tuple[Mover, FakeAxis, Clock]:
    clock = Clock()
    axis = FakeAxis(clock, at_deg)
    return Mover("head", axis, travel, clock), axis, clock


@pytest.mark.parametrize(
    ("start_deg", "target_deg", "direction", "sent_deg"),
    [
        (0.0, 45.0, 1, [45.0]),
        (90.0, 45.0, 1, [44.0, 45.0]),
        (45.0, 45.0, 1, [44.0, 45.0]),
        (44.5, 45.0, 1, [44.0, 45.0]),
        (44.0, 45.0, 1, [45.0]),
        (90.0, 45.0, -1, [45.0]),
        (0.0, 45.0, -1, [46.0, 45.0]),
        (360.0, 0.0, 1, [-1.0, 0.0]),
    ],
)
def test_it_arrives_from_the_demanded_side(
    start_deg: float, target_deg: float, direction: int, sent_deg: list[float]
) -> None:
    mover, axis, _ = a_mover(start_deg)
    position = mover.move(target_deg * DEG, direction)  # type: ignore[arg-type]
    assert position == HeadPosition(pytest.approx(target_deg * DEG, abs=1e-12), direction)  # type: ignore[arg-type]
    assert axis.targets_deg == pytest.approx(sent_deg)
    assert axis.stops == 0


def test_the_angle_returned_is_the_one_read_back() -> None:
    mover, axis, _ = a_mover()
    axis.error_rad = lambda _: 7 * ARCSEC
    assert mover.move(45 * DEG, 1).angle_rad == pytest.approx(45 * DEG + 7 * ARCSEC, abs=1e-12)


@pytest.mark.parametrize(
    ("target_deg", "direction", "words"),
    [
        (370.1, -1, "370°06′00″ is outside its limits, -10°00′00″ to 370°00′00″"),
        (-10.1, 1, "-10°06′00″ is outside"),
        (math.nan, 1, "nan is outside"),
        (-9.5, 1, "to come to -9°30′00″ from below it must start at -10°30′00″"),
        (370.0, -1, "to come to 370°00′00″ from above it must start at 371°00′00″"),
    ],
)
def test_limits_hold_before_anything_is_asked(target_deg: float, direction: int, words: str) -> None:
    mover, axis, _ = a_mover()
    axis.interrupt_at_s = 0.0
    with pytest.raises(LimitExceeded, match=words):
        mover.move(target_deg * DEG, direction)  # type: ignore[arg-type]
    assert (axis.targets_deg, axis.stops) == ([], 0)


def test_a_target_exactly_at_a_limit_is_allowed_from_inside() -> None:
    mover, _, _ = a_mover()
    assert mover.move(370 * DEG, 1).angle_rad == pytest.approx(370 * DEG)


def test_a_head_that_stands_outside_its_limits_is_not_moved() -> None:
    mover, axis, _ = a_mover(at_deg=400.0)
    with pytest.raises(LimitExceeded, match="it stands at 400°00′00″, outside its limits"):
        mover.move(45 * DEG, -1)
    assert axis.targets_deg == []


def test_the_window_begins_again_when_a_sample_lies_outside() -> None:
    quiet, _, quiet_clock = a_mover()
    quiet.move(45 * DEG, 1)
    mover, axis, clock = a_mover()
    axis.error_rad = lambda elapsed_s: 30 * ARCSEC if 5.9 < elapsed_s < 6.1 else 0.0
    mover.move(45 * DEG, 1)
    assert quiet_clock.now_s() == pytest.approx(4.5 + TRAVEL.settle_s, abs=TRAVEL.poll_s)
    assert clock.now_s() == pytest.approx(6.1 + TRAVEL.settle_s, abs=2 * TRAVEL.poll_s)


def test_one_that_oscillates_about_the_target_never_is_in_position() -> None:
    mover, axis, clock = a_mover()
    axis.error_rad = lambda elapsed_s: 15 * ARCSEC * math.cos(math.pi * elapsed_s)
    with pytest.raises(InstrumentRefused, match=r"did not come to rest within 0°00′10\.0″ of 45°00′00″"):
        mover.move(45 * DEG, 1)
    assert axis.stops == 1
    assert clock.now_s() == pytest.approx(TRAVEL.time_limit_s(45 * DEG), abs=2 * TRAVEL.poll_s)


def test_one_that_stops_off_target_is_told_by_how_much() -> None:
    mover, axis, _ = a_mover()
    axis.error_rad = lambda _: -20 * ARCSEC
    with pytest.raises(InstrumentRefused, match=r"it is 0°00′20\.0″ below it"):
        mover.move(45 * DEG, 1)
    assert axis.stops == 1


def test_one_that_never_stops_moving_is_given_up() -> None:
    mover, axis, _ = a_mover()
    axis.moving = lambda: True  # type: ignore[method-assign]
    with pytest.raises(InstrumentRefused, match="it still moved after 21 s, at 45°00′00″, sent to 45°00′00″"):
        mover.move(45 * DEG, 1)
    assert axis.stops == 1


def test_ctrl_c_stops_the_motion() -> None:
    mover, axis, _ = a_mover()
    axis.interrupt_at_s = 1.0
    with pytest.raises(KeyboardInterrupt):
        mover.move(45 * DEG, 1)
    assert axis.stops == 1


def test_a_failure_to_stop_does_not_hide_the_cause() -> None:
    mover, axis, _ = a_mover()

    def cannot_stop() -> None:
        raise OSError

    axis.stop = cannot_stop  # type: ignore[method-assign]
    axis.error_rad = lambda _: -20 * ARCSEC
    with pytest.raises(InstrumentRefused, match="did not come to rest") as stopped:
        mover.move(45 * DEG, 1)
    (note,) = stopped.value.__notes__
    assert note.startswith("head: its stop is not confirmed: see that it stands")
    assert "OSError" in note


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"minimum_rad": 7.0}, "is not below the highest"),
        ({"tolerance_rad": 0.0}, "tolerance_rad of the head must be positive"),
        ({"speed_rad_s": -1.0}, "speed_rad_s of the head must be positive"),
        ({"backoff_rad": 1e-9}, "back off by more than its tolerance"),
    ],
)
def test_a_travel_that_cannot_be_is_refused(changes: dict[str, float], words: str) -> None:
    settings = {"minimum_rad": 0.0, "maximum_rad": 6.3, "tolerance_rad": 1e-5, "speed_rad_s": 0.1}
    with pytest.raises(ValueError, match=words):
        Travel(**(settings | changes))
