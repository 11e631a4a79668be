"""Goals of a plan, against draws of the coefficients."""

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.model import Mounting
from bench.model.geometry import modulus_slopes
from bench.planning.optimal_design import (
    Goal,
    Stand,
    coefficient_goals,
    delta_g_goals,
    modulus_goals,
    vector_goal,
)
from bench.planning.requirements import conditions_of
from bench.validation.paper_bench import ARCSEC, K
from tests.support.planning_bench import PAPER, SIZES, STAND


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


def test_a_bench_without_noise_is_refused():
    with pytest.raises(CalibrationError, match="states no voltmeter_error"):
        Stand(STAND.model, STAND.block, {"mounting_error": 30 * ARCSEC})


def test_a_goal_is_a_variance_with_a_floor():
    goal = Goal("x", np.eye(12)[:1], 1.0, "g", floor=9.0)
    assert goal.u(16.0 * np.eye(12)) == pytest.approx(5.0)
    assert conditions_of(PAPER).mounts == (Mounting(1, "1"), Mounting(1, "2"))
