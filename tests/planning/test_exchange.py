"""The information matrix and the exchange of settings, against brute force and another calculation."""

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest

from bench.planning.optimal_design import ExchangeDesign, best_of, vector_goal
from bench.validation.paper_bench import U0, K, specific_force
from tests.support.planning_bench import PAPER, SIZES, STAND, sites


def by_hand(settings, wider=1.0):
    """(J' V^-1 J)^-1 from the tests' own geometry, V = R + Z D Z', every derivative by differences."""
    label = [s.mount.installation for s in settings]
    phi = np.array([s.angle_rad for s in settings])
    n, step = len(phi), 1e-6

    def signal(**angles):
        return (specific_force(label, phi, **angles) @ K.T + U0).ravel()

    force = specific_force(label, phi)
    jacobian = np.zeros((n, 3, 12))
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3], jacobian[:, i, 9 + i] = force, 1.0
    covariance = (wider * SIZES["voltmeter_error"]) ** 2 * np.eye(3 * n)
    slope = ((signal(alpha4=step) - signal(alpha4=-step)) / (2 * step)).reshape(n, 3)
    for i in range(n):
        own = slice(3 * i, 3 * i + 3)
        covariance[own, own] += (wider * SIZES["setting_error"]) ** 2 * np.outer(slope[i], slope[i])
    for name, symbol in (("axis_tilt", "alpha1"), ("zero_offset", "alpha2"), ("mounting_error", "alpha3")):
        column = (signal(**{symbol: step}) - signal(**{symbol: -step})) / (2 * step)
        for mount in set(label):
            own = column * np.repeat(np.array(label) == mount, 3)
            covariance += SIZES[name] ** 2 * np.outer(own, own)
    flat = jacobian.reshape(3 * n, 12)
    return np.linalg.inv(flat.T @ np.linalg.solve(covariance, flat))


def test_the_covariance_of_a_plan_is_that_of_another_calculation():
    """The paper's 54 settings tell the noise by 36 repeats: 108 degrees of freedom widen u by sqrt(72/70)."""
    wider = math.sqrt(72 / 70)
    np.testing.assert_allclose(
        STAND.promise(PAPER, ()).combined, by_hand(PAPER, wider), rtol=1e-4, atol=1e-13
    )


def test_the_design_has_the_covariance_of_the_estimator():
    found = sites(angles=8)
    candidates = found.candidates((0, 1))
    counts = np.random.default_rng(5).integers(0, 4, len(candidates.rows))
    settings = [
        s._replace(mount=found.mounts[i // 8], angle_rad=float(found.angle_rad[i % 8]), point=i)
        for i, times in enumerate(counts)
        for s in [PAPER[0]] * int(times)
    ]
    design = ExchangeDesign(candidates, [vector_goal(STAND.block)], counts)
    np.testing.assert_allclose(design.coefficient_covariance, by_hand(settings), rtol=1e-4, atol=1e-13)


def test_moves_choose_what_a_full_calculation_would():
    candidates = sites(angles=12).candidates((0, 1))
    goal = vector_goal(STAND.block, asked_g=1e-4)
    counts = np.random.default_rng(6).integers(0, 3, len(candidates.rows))

    def after(change):
        scores = np.full(len(counts), np.inf)
        for i in range(len(counts)):
            if counts[i] + change >= 0:
                moved = counts.copy()
                moved[i] += change
                scores[i] = goal.u(ExchangeDesign(candidates, [goal], moved).coefficient_covariance)
        return scores

    for move, change in ((ExchangeDesign.add_best, 1), (ExchangeDesign.drop_least, -1)):
        design = ExchangeDesign(candidates, [goal], counts)
        move(design)
        chosen = goal.u(design.coefficient_covariance)
        assert chosen == pytest.approx(after(change).min(), rel=1e-9)


@pytest.mark.slow
def test_exchanges_come_to_the_best_of_all_designs():
    """Five angles in two mountings, eight settings: the least of all 24,310 multisets, to 0.2 %."""
    candidates = sites(angles=5).candidates((0, 1))
    goal = vector_goal(STAND.block, asked_g=1e-4)
    information = candidates.information
    prior = np.diag(np.r_[np.ones(12), np.ones(candidates.unknowns - 12)])
    sums = np.array(
        [np.bincount(chosen, minlength=10) for chosen in combinations_with_replacement(range(10), 8)], float
    )
    best = np.inf
    for part in np.array_split(sums, 20):
        joint = prior + np.tensordot(part, information, axes=1)
        covariance = np.linalg.inv(joint)[:, :12, :12]
        u2 = np.einsum("ki,nij,kj->n", goal.functionals, covariance, goal.functionals)
        best = min(best, float(np.sqrt(u2.min())))
    found = best_of(candidates, [goal], 2, 8)
    assert found.settings == 8
    assert goal.u(found.coefficient_covariance) == pytest.approx(best, rel=2e-3)
