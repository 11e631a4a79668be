"""Test points that are planned: what they reach, and with how little."""

import math

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.planning.optimal_design import (
    best_of,
    coefficient_goals,
    fewest,
    least_settings,
    vector_goal,
    widening,
)
from bench.planning.points import best_within, cheapest, passes
from tests.support.planning_bench import COST, PAPER, STAND, sites, whole


@pytest.mark.slow
def test_what_the_papers_settings_give_takes_hardly_fewer():
    """Spread evenly and repeated, they are within a percent of the best 54 for the whole error vector."""
    asked = vector_goal(STAND.block).u(STAND.promise(PAPER, ()).combined)
    goals = [vector_goal(STAND.block, 1.0, asked)]
    fewer = cheapest(STAND, sites(), goals, COST, 100, 2)
    assert fewer.reached
    assert 52 <= fewer.count <= 54
    best = best_within(STAND, sites(), goals, COST, COST.total_s(54, 2), 2)
    assert best.count == 54
    assert best.worst.ratio(best.covariance) == pytest.approx(1.0, abs=0.01)


def test_a_plan_reaches_what_was_asked_and_one_setting_less_would_hardly():
    goals = coefficient_goals({"all": 5e-5})
    found = cheapest(STAND, sites(), goals, COST, 100, 2)
    u = np.sqrt(np.diag(found.covariance))
    assert np.all(u <= 5e-5)
    candidates = sites().candidates((0, 1))
    assert best_of(candidates, goals, 2, found.count - 2).largest > 1.0


def test_no_plan_has_fewer_settings_than_tell_the_noise():
    candidates = sites().candidates((0, 1))
    design = fewest(candidates, coefficient_goals({"all": 1.0}), 2, 50)
    assert design is not None
    assert design.settings == least_settings(candidates) == 8
    assert widening(6) == pytest.approx(math.sqrt(2))


@pytest.mark.slow
def test_more_mountings_are_taken_where_they_alone_help():
    """Kyx is held by the limits of alpha2 and alpha3: mounting the block again draws them anew."""
    goals = whole(coefficient_goals({"Kyx": 15e-6}))
    with pytest.raises(
        CalibrationError, match=r"any number .* 1\.15 times .* for Kyx: zero offset 17\.2 µV/g;"
    ):
        cheapest(STAND, sites(), goals, COST, 300, 2)
    found = cheapest(STAND, sites(visits=2), goals, COST, 300, 3)
    assert found.reached
    assert len(found.visits) == 3


def test_a_plan_for_one_coefficient_still_calibrates_the_block():
    goals = whole(coefficient_goals({"Kyx": 4e-5}))
    found = cheapest(STAND, sites(), goals, COST, 100, 2)
    assert found.reached
    assert vector_goal(STAND.block).u(found.covariance) < 1e-3


@pytest.mark.slow
def test_more_time_is_never_worse_and_is_kept_to():
    goals = [vector_goal(STAND.block, 5.0, 1e-3)]
    last = np.inf
    for hours in (3.5, 4.0, 6.0):
        found = best_within(STAND, sites(), goals, COST, hours * 3600, 2)
        ratio = found.worst.ratio(found.covariance)
        assert found.time_s <= hours * 3600
        assert found.time_s + COST.setting_s > hours * 3600
        assert ratio < last
        last = ratio


def test_installations_that_come_to_the_same_are_tried_once():
    four = sites(("1", "2", "1T180", "2T180"))
    pairs = [tuple(four.mounts[m].installation for m in chosen) for chosen in four.choices(2)]
    assert pairs == [("1",), ("2",), ("1", "2"), ("1", "1T180"), ("2", "2T180")]
    goal = vector_goal(STAND.block, asked_g=1e-4)
    a, b = (best_of(four.candidates(chosen), [goal], 2, 20).largest for chosen in ((0, 1), (2, 3)))
    assert a == pytest.approx(b, rel=2e-3)


def test_passes_go_to_and_fro_and_keep_their_points():
    first, second = passes({0.0: 2, 1.0: 1, 2.0: 2, 3.0: 1})
    assert (first.first_point, first.angle_rad, first.directions) == (1, (0.0, 2.0), (1, -1))
    assert (second.first_point, second.angle_rad, second.directions) == (3, (1.0, 3.0), (1,))
