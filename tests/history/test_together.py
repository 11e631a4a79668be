"""Benches in all twelve coefficients at once: against dense algebra over all values, and how often it alarms."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy import stats

from bench.calibration.noise import METERS_DRIFT
from bench.history.comparison import Snapshot, joint_covariances, joint_of
from bench.history.equivalence import Participants, equivalence, pairs, together

UNIT = np.array([0, 0, 0, 1, 1, 1, 2, 2])
BENCH = np.array([0, 1, 2, 0, 1, 2, 0, 1])
DAYS = np.array([0, 10, 20, 30, 45, 60, 200, 200])


def covariance(rng, size):
    root = rng.normal(size=(12, 15)) * size
    return root @ root.T / 15


def snapshots(rng):
    meters = [covariance(rng, 0.5) for _ in range(3)]
    terms = rng.normal(size=(12, 2)) * 0.3
    made = []
    for unit, bench, day in zip(UNIT, BENCH, DAYS, strict=True):
        own = covariance(rng, 1.0) + terms @ terms.T
        made.append(
            Snapshot(
                f"{unit} on {bench}", datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=int(day)), f"A {unit}", "V",
                9.80665, np.zeros(12), own + meters[bench], same_meters=own, meters=(f"meter {bench}",),
                block_terms=terms,
            )
        )  # fmt: skip
    return made, meters, terms


def dense(made, meters, terms):
    """The covariance of all values, (n, 12, n, 12), pair by pair."""
    n = len(made)
    whole = np.zeros((n, 12, n, 12))
    for i in range(n):
        for j in range(n):
            if i == j:
                whole[i, :, i, :] = made[i].covariance
                continue
            if UNIT[i] == UNIT[j]:
                whole[i, :, j, :] += terms @ terms.T
            if BENCH[i] == BENCH[j]:
                part = max(0.0, 1.0 - abs(DAYS[i] - DAYS[j]) / METERS_DRIFT.days)
                whole[i, :, j, :] += part * meters[BENCH[i]]
    return whole


def test_chi_square_is_that_of_dense_algebra_over_all_values():
    rng = np.random.default_rng(3)
    made, meters, terms = snapshots(rng)
    whole = dense(made, meters, terms)
    by_coefficient = joint_covariances(made)
    np.testing.assert_allclose(np.einsum("ikjk->kij", whole), by_coefficient, atol=1e-12)
    values = rng.normal(size=(8, 12))
    taking = [Participants(values[:, k], by_coefficient[k], UNIT, BENCH) for k in range(12)]
    joint = joint_of(made)
    found = [equivalence(one, "weighted mean") for one in taking]
    for b in range(3):
        maps = np.array([one.map[b] for one in found])
        # a difference of all twelve is one matrix times all values
        big = np.einsum("kn,kl->knl", maps, np.eye(12)).reshape(12, 8 * 12)
        expected = big @ whole.reshape(96, 96) @ big.T
        np.testing.assert_allclose(joint.of_sums(maps), expected, atol=1e-12)
        d = big @ values.ravel()
        u = np.sqrt(np.diag(expected))
        (judged,) = together(d[None], u[None], expected[None], u[None])
        chi2 = d @ np.linalg.solve(expected, d)
        assert judged.chi2 == pytest.approx(chi2, rel=1e-8)
        assert judged.p == pytest.approx(stats.chi2.sf(chi2, 12), rel=1e-8)
    for each in zip(*(pairs(one) for one in taking), strict=True):
        maps = np.array([pair.map for pair in each])
        np.testing.assert_allclose(
            np.einsum("kn,nk->k", maps, values), [p.difference for p in each], atol=1e-12
        )
        u = np.sqrt(np.diag(joint.of_sums(maps)))
        np.testing.assert_allclose(u, [pair.u for pair in each], rtol=1e-9)


def test_chance_alarms_as_often_as_it_may_and_a_difference_along_what_errors_have_little_of_is_found():
    """Seed 8: of 600 sets of three, 5 % alarm; 2.6 to 8.2 % but once in 300 times."""
    rng = np.random.default_rng(8)
    root = np.linalg.cholesky(covariance(rng, 1.0) + 0.2 * np.eye(12))
    errors = np.broadcast_to(root @ root.T, (3, 12, 12))
    u = np.sqrt(np.diagonal(errors, axis1=1, axis2=2))
    drawn = rng.normal(size=(600, 3, 12)) @ root.T
    alarms = np.mean([any(one.apart for one in together(d, u, errors, u)) for d in drawn])
    assert 0.026 < alarms < 0.082
    along = np.linalg.eigh(errors[0])[1][:, 0]
    off = np.array([8.0 * np.sqrt(along @ errors[0] @ along) * along, np.zeros(12), np.zeros(12)])
    # within U, k = 2, in every coefficient, and not together
    assert np.all(np.abs(off) < 2.0 * u)
    assert [one.apart for one in together(off, u, errors, u)] == [True, False, False]


def test_what_is_uncertain_beyond_the_errors_makes_a_difference_smaller():
    errors = np.eye(12)[None]
    d = np.full((1, 12), 2.0)
    (plain,) = together(d, np.ones((1, 12)), errors, np.ones((1, 12)))
    (wide,) = together(d, np.full((1, 12), 2.0), errors, np.ones((1, 12)))
    assert (plain.chi2, wide.chi2) == pytest.approx((48.0, 12.0))
