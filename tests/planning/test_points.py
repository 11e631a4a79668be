"""Test points that are planned: their goals, what they reach with how little, and that a calibration signs it."""

import math

import numpy as np
import pytest

from bench.calibration import CalibrationError, calibrate
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import delta_g_contributions, sign
from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import Noise
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.stand import AngleError, TemperatureError
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import ForwardModel, Mounting
from bench.model.geometry import COEFFICIENTS, modulus_slopes
from bench.planning.optimal_design import (
    Goal,
    Stand,
    best_of,
    checks_of,
    coefficient_goals,
    delta_g_goals,
    fewest,
    least_settings,
    modulus_goals,
    repeats,
    vector_goal,
    widening,
)
from bench.planning.points import best_within, cheapest, passes
from bench.planning.requirements import conditions_of, fitted, settings_of
from bench.readings.table import make_readings
from bench.services.planning import delta_g_of, stand_of
from bench.validation.paper_bench import ARCSEC, K
from drivers.clock import utc_now
from tests.support.planning_bench import COST, PAPER, SIZES, STAND, sites, whole


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


def shipped(name):
    return load_bench(find_bench(name))


def edited(section, **stated):
    bench = shipped("paper-stand")
    return bench.model_copy(update={section: getattr(bench, section).model_copy(update=stated)})


def measured_roll():
    return edited("stand", mounting_roll=AngleError(limit="10 arcsec", distribution="rectangular"))


def foundation():
    return edited("stand", foundation=AngleError(limit="60 arcsec", distribution="normal", k=2))


def wandering():
    stated = TemperatureError(limit="1 K", distribution="rectangular", correlation_time="30 min")
    return edited("uncertainty", temperature=stated)


BENCHES = {
    "paper": lambda: shipped("paper-stand"),
    "stand": lambda: shipped("bench-stand"),
    "multiplexer": lambda: shipped("bench-multiplexer"),
    "roll": measured_roll,
    "foundation": foundation,
    "wandering": wandering,
}


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("procedure", ["quick", "remount-90"])
def test_what_is_promised_is_what_is_signed(name, procedure):
    """To 1 %, of each coefficient and of delta g: readings without errors, noise as the plan widens it."""
    bench = BENCHES[name]()
    model = ForwardModel(bench.installation_models())
    stand = stand_of(bench, model, day=utc_now().date())
    settings = fitted(settings_of(load_procedure(find_procedure(procedure)).plan))
    goals = [*coefficient_goals({"all": 1e-4}), *delta_g_of(stand, 1e-3, "--delta-g")]
    promise = stand.promise(settings, goals)

    whole = stand.budget([*settings, *checks_of(goals)]).setup
    conditions = whole.conditions
    labels = [conditions.mounts[m].installation for m in conditions.mount]
    readings = make_readings(
        labels, conditions.pass_number.tolist(), conditions.point.tolist(), conditions.angle_rad, whole.signal,
        series=[conditions.mounts[m].series for m in conditions.mount], direction=conditions.direction.tolist(),
    )  # fmt: skip
    own = conditions_of(settings)
    again = repeats(own)
    freedom = 3 * again if again >= LEAST_REPEATS else 3 * len(own) - stand.unknowns(len(own.mounts))
    wider = widening(freedom)
    noise = Noise(wider * stand.noise.reading, wider * stand.noise.setting_rad, np.inf, "given")
    stated = {key: size.u for key, size in bench.stand_distributions().items()}
    assumed = {key: size.u for key, size in assumed_stand(bench).items()}
    found = calibrate(readings, model, stated, 9.81, noise=noise, assumed_u=assumed)
    signed = sign(found, readings, bench, model, utc_now().date())

    u = [goal.u(promise.readings) for goal in promise.goals]
    np.testing.assert_allclose(u[: len(COEFFICIENTS)], signed.u, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(promise.combined)), signed.u, rtol=0.01)
    at_points = sum(delta_g_contributions(signed, readings, bench, model, utc_now().date()).values())
    np.testing.assert_allclose(u[len(COEFFICIENTS) :], np.sqrt(np.diag(at_points)), rtol=0.02)


def test_goals_against_draws():
    """u of the vector error and of moduli against 20,000 draws of the coefficients, within 3 %."""
    rng = np.random.default_rng(8)
    covariance = STAND.promise(PAPER, ()).combined
    draws = rng.multivariate_normal(np.zeros(12), covariance, 20_000)
    force = rng.normal(size=(20_000, 3))
    force *= 5.0 / np.linalg.norm(force, axis=1, keepdims=True)
    errors = -np.einsum("nij,nj->ni", draws[:, :9].reshape(-1, 3, 3), force) - draws[:, 9:]
    measured = errors @ np.linalg.inv(K).T
    goal = vector_goal(STAND.block, 5.0)
    assert goal.u(covariance) == pytest.approx(float(np.sqrt(np.mean(np.sum(measured**2, axis=1)))), rel=0.03)
    worst = max(g.u(covariance) for g in modulus_goals(STAND.block, 5.0, 1.0))
    slopes, _ = modulus_slopes(force[:2000], STAND.block)
    slopes[:, :9] *= 1.0  # at 5 g already
    seen = np.sqrt(np.einsum("np,pq,nq->n", slopes, covariance, slopes))
    assert worst == pytest.approx(seen.max(), rel=0.03)
    for magnitude in (1.0, 2.5):
        slopes, _ = modulus_slopes(force[:2000] * magnitude / 5, STAND.block)
        assert np.sqrt(np.einsum("np,pq,nq->n", slopes, covariance, slopes)).max() < worst


def test_named_coefficients_win_over_groups():
    goals = {g.name: g.asked for g in coefficient_goals({"all": 1e-4, "Kyx": 2e-5, "U0": 3e-5})}
    assert (goals["Kxx"], goals["Kyx"], goals["U0z"]) == (1e-4, 2e-5, 3e-5)
    with pytest.raises(CalibrationError, match="no coefficient 'Kxw'; choose from Kxx"):
        coefficient_goals({"Kxw": 1e-5})


def test_a_delta_g_below_the_reading_itself_is_refused():
    with pytest.raises(CalibrationError, match=r"one reading at a verification point alone has 4\.7e-05 g"):
        delta_g_goals(STAND.block, np.eye(3), SIZES["voltmeter_error"], 4e-5, [])


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.0, 1.1])
def test_the_size_said_to_be_the_least_of_a_delta_g_is_accepted(factor):
    reading_v = factor * SIZES["voltmeter_error"]
    with pytest.raises(CalibrationError) as refused:
        delta_g_goals(STAND.block, np.eye(3), reading_v, 1e-6, PAPER[:3])
    least_g = float(str(refused.value).split("alone has ")[1].split(" g;")[0])
    assert delta_g_goals(STAND.block, np.eye(3), reading_v, least_g, PAPER[:3])


def test_a_bench_without_noise_is_refused():
    with pytest.raises(CalibrationError, match="states no voltmeter_error"):
        Stand(STAND.model, STAND.block, {"mounting_error": 30 * ARCSEC})


def test_a_goal_is_a_variance_with_a_floor():
    goal = Goal("x", np.eye(12)[:1], 1.0, "g", floor=9.0)
    assert goal.u(16.0 * np.eye(12)) == pytest.approx(5.0)
    assert conditions_of(PAPER).mounts == (Mounting(1, "1"), Mounting(1, "2"))
