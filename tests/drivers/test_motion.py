"""What motorised heads share, on an axis without a wire."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from drivers.interfaces import HeadPosition, InstrumentRefused, LimitExceeded, WentAstray
from drivers.motion import Mover, Travel, TravelWatch
from tests.support.motorised_heads import DEG, travel
from tests.support.scripted_session import Clock

TRAVEL = travel(10 * ARCSEC, settle_s=2.0)


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
    with pytest.raises(
        InstrumentRefused, match=r"did not come to rest .* it is 0°00′20\.0″ below it"
    ) as stopped:
        mover.move(45 * DEG, 1)
    (note,) = stopped.value.__notes__
    assert note.startswith("head: its stop is not confirmed; check that it stands still")
    assert "OSError" in note


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"minimum_rad": 7.0}, "must be below the highest"),
        ({"tolerance_rad": 0.0}, "tolerance_rad of the head must be positive"),
        ({"speed_rad_s": -1.0}, "speed_rad_s of the head must be positive"),
        ({"backoff_rad": 1e-9}, "a back-off above the tolerance"),
    ],
)
def test_a_travel_that_cannot_be_is_refused(changes: dict[str, float], words: str) -> None:
    settings = {"minimum_rad": 0.0, "maximum_rad": 6.3, "tolerance_rad": 1e-5, "speed_rad_s": 0.1}
    with pytest.raises(ValueError, match=words):
        Travel(**(settings | changes))


# --- travel watch -----------------------------------------------------------------------------------
# What a head on its way must not do, and what it may: samples of a scale against a watch.

POLL_S = 0.25


def watched_travel(speed_deg_s: float) -> Travel:
    return Travel(math.radians(-5.0), math.radians(365.0), 5 * ARCSEC, math.radians(speed_deg_s))


def watched(angles_deg: list[float], target_deg: float, speed_deg_s: float = 10.0) -> int:
    """Feed a watch; return how many samples it took without complaint."""
    watch = TravelWatch(
        "head", watched_travel(speed_deg_s), math.radians(angles_deg[0]), math.radians(target_deg), 0.0
    )
    for number, angle_deg in enumerate(angles_deg[1:], start=1):
        watch.take(math.radians(angle_deg), number * POLL_S)
    return len(angles_deg) - 1


def ramp(start_deg: float, rate_deg_s: float, samples: int) -> list[float]:
    return [start_deg + rate_deg_s * POLL_S * n for n in range(samples + 1)]


@pytest.mark.parametrize("speed_deg_s", [0.5, 10.0, 300.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_sample_of_a_head_that_turns_away_is_enough(speed_deg_s: float, side: float) -> None:
    away = ramp(100.0, -side * speed_deg_s, 1)
    with pytest.raises(WentAstray, match="sent from 100°00′00″ to"):
        watched(away, 100.0 + side * 50.0, speed_deg_s)


def test_one_that_runs_through_its_target_is_found_out_at_the_next_sample() -> None:
    on = ramp(0.0, 10.0, 18)  # at the target of 45° with the last of these
    assert watched(on, 45.0) == 18
    with pytest.raises(WentAstray, match="it was at 47°30′00″"):
        watched([*on, 47.5], 45.0)


def test_one_outside_its_limits_is_found_out_even_on_its_way() -> None:
    assert watched([365.0, 365.001], 364.0) == 1
    with pytest.raises(WentAstray, match="outside its limits, -5°00′00″ to 365°00′00″"):
        watched([365.0, 365.002], 364.0)


def test_a_servo_may_swing_through_its_target() -> None:
    """A damped swing of 0.4° about a target that is approached at full speed, as a rate table shows it."""
    swing = [45.0 + 0.4 * math.exp(-0.3 * n) * math.cos(1.3 * n) for n in range(40)]
    assert watched([*ramp(0.0, 10.0, 17), *swing], 45.0) == 57


def test_noise_and_play_of_the_scale_are_no_turning_away() -> None:
    """Seed 1: 0.01° of noise on the scale, a start that first gives way by 0.03°, 200 movements."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        start_deg, target_deg = rng.uniform(0.0, 360.0, 2)
        way_deg = target_deg - start_deg
        samples = max(1, math.ceil(abs(way_deg) / 10.0 / POLL_S))
        way = np.concatenate([[0.0, -0.03 * np.sign(way_deg)], np.linspace(0.0, way_deg, samples)])
        angles = start_deg + way + rng.normal(0.0, 0.003, len(way))
        assert watched(list(angles), target_deg) == len(angles) - 1


def test_a_head_that_stands_short_of_its_target_has_stalled_after_five_seconds() -> None:
    stuck = [*ramp(0.0, 10.0, 8), *[20.0] * 19]
    assert watched(stuck, 45.0) == 27
    with pytest.raises(
        InstrumentRefused, match="it stalled at 20°00′00″, sent to 45°00′00″: no progress in 5 s"
    ):
        watched([*stuck, 20.0], 45.0)


@pytest.mark.parametrize("share", [0.06, 0.5])
def test_one_that_goes_on_slowly_has_not_stalled(share: float) -> None:
    assert watched(ramp(0.0, 10.0 * share, 36), 45.0) == 36


def test_one_that_stands_near_its_target_is_judged_by_the_window_not_here() -> None:
    assert watched([44.6] * 200, 45.0) == 199
