"""What a head on its way must not do, and what it may: samples of a scale against a watch."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from drivers.interfaces import InstrumentRefused, WentAstray
from drivers.motion import Travel, TravelWatch

POLL_S = 0.25


def travel(speed_deg_s: float = 10.0) -> Travel:
    return Travel(math.radians(-5.0), math.radians(365.0), 5 * ARCSEC, math.radians(speed_deg_s))


def watched(angles_deg: list[float], target_deg: float, speed_deg_s: float = 10.0) -> int:
    """Feed a watch; return how many samples it took without complaint."""
    watch = TravelWatch(
        "head", travel(speed_deg_s), math.radians(angles_deg[0]), math.radians(target_deg), 0.0
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
