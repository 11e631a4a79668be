"""Degrees of equivalence: published comparisons, honest u, all coefficients together."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy import stats

from bench.calibration.noise import METERS_DRIFT
from bench.calibration.result import CalibrationError
from bench.history.comparison import Snapshot, joint_covariances, joint_of
from bench.history.equivalence import (
    DERSIMONIAN_LAIRD,
    MANDEL_PAULE,
    WEIGHTED_MEAN,
    Participants,
    equivalence,
    pairs,
    together,
)


def of_one_unit(x, u):
    """Return values (N,) of one unit by N benches, one each, with independent standard uncertainties (N,)."""
    values = np.asarray(x, dtype=float)
    variance = np.diag(np.square(np.asarray(u, dtype=float)))
    return Participants(values, variance, np.zeros(len(values), dtype=np.int64), np.arange(len(values)))


PCB28 = of_one_unit([34.3, 32.9, 34.53, 32.42, 31.9, 35.8], [1.03, 0.69, 0.83, 0.29, 0.4, 0.38])
"""CCQM-K25, PCB 28 in sediment, ng/g: the example of the NIST Consensus Builder."""


def test_dersimonian_laird_of_the_consensus_builders_example():
    found = equivalence(PCB28, DERSIMONIAN_LAIRD)
    assert found.reference == pytest.approx([33.6004326], abs=5e-8)
    assert found.u_reference == pytest.approx([0.7449979], abs=5e-8)
    assert found.dark**2 == pytest.approx(2.9289, abs=5e-5)
    assert (found.chi2, found.dof) == (pytest.approx(68.2154, abs=5e-5), 5)
    assert found.p == pytest.approx(2.4092e-13, rel=1e-3)
    degrees = [0.6995674, -0.7004326, 0.9295674, -1.1804326, -1.7004326, 2.1995674]
    assert found.degree == pytest.approx(degrees, abs=5e-8)
    assert not found.consistent
    assert found.birge == pytest.approx(np.sqrt(68.2154 / 5), rel=1e-6)


def test_means_are_those_of_statsmodels():
    meta = pytest.importorskip("statsmodels.stats.meta_analysis")
    x = np.array([61.00, 61.40, 62.21, 62.30, 62.34, 62.60, 62.70, 62.84, 65.90])
    u = np.sqrt([0.2025, 1.2100, 0.0900, 0.2025, 0.3844, 0.5625, 0.0676, 0.0225, 1.8225])
    for of in (PCB28, of_one_unit(x, u)):
        for method, word in ((MANDEL_PAULE, "pm"), (DERSIMONIAN_LAIRD, "dl")):
            judge = meta.combine_effects(of.y, np.diag(of.covariance), method_re=word, atol=1e-10)
            found = equivalence(of, method)
            assert found.dark**2 == pytest.approx(judge.tau2, rel=1e-6)
            assert found.reference[0] == pytest.approx(judge.mean_effect_re, rel=1e-8)
            assert found.u_reference[0] == pytest.approx(judge.sd_eff_w_re, rel=1e-5)


def test_a_consistent_comparison_is_procedure_a():
    """Cox: u2(d) = u2(x) - u2(reference)."""
    x, u = np.array([1.0, 1.1, 0.9, 1.2]), np.array([0.1, 0.2, 0.1, 0.3])
    found = equivalence(of_one_unit(x, u))
    w = u**-2.0
    assert (found.method, found.consistent, found.dark) == (WEIGHTED_MEAN, True, 0.0)
    assert found.reference[0] == pytest.approx(np.sum(w * x) / np.sum(w))
    assert found.u_degree**2 == pytest.approx(u**2 - 1.0 / np.sum(w))
    assert found.en == pytest.approx(np.abs(found.degree) / (2.0 * found.u_degree))


def test_mandel_paule_where_they_disagree_makes_what_is_left_as_large_as_it_should_be():
    found = equivalence(PCB28)
    w = 1.0 / (np.diag(PCB28.covariance) + found.dark**2)
    assert found.method == MANDEL_PAULE
    assert np.sum(w * (PCB28.y - found.reference[0]) ** 2) == pytest.approx(5.0)


def several(seed: int, dark: float = 0.0) -> tuple[Participants, np.ndarray]:
    """Three units on four benches, one pair missing, with meters that each bench keeps: errors in common."""
    rng = np.random.default_rng(seed)
    unit, bench = np.array([(i, j) for i in range(3) for j in range(4) if (i, j) != (2, 3)]).T
    own, common = 0.2, 0.5
    covariance = own**2 * np.eye(len(unit)) + common**2 * (bench[:, None] == bench[None, :])
    off = dark * rng.normal(size=4)
    y = rng.multivariate_normal(10.0 * unit + off[bench], covariance)
    return Participants(y, covariance, unit, bench), off


@pytest.mark.slow
def test_errors_in_common_and_several_units_have_honest_uncertainty():
    pulls, chi2, pair = [], [], []
    for seed in range(120):
        of, _ = several(seed)
        found = equivalence(of, WEIGHTED_MEAN)
        pulls.append(found.degree / found.u_degree)
        chi2.append(found.chi2)
        pair.append([one.difference / one.u for one in pairs(of)])
    # 480 and 720 scores, in 360 independent ones: known to 4 %; chi-square of 8, mean of 120: u 0.37
    assert abs(np.sqrt(np.mean(np.square(pulls))) - 1.0) < 0.16
    assert abs(np.sqrt(np.mean(np.square(pair))) - 1.0) < 0.16
    assert abs(np.mean(chi2) - 8.0) < 1.5


def test_a_bench_that_is_off_is_found_on_several_units():
    of, _ = several(1)
    moved = Participants(of.y + 4.0 * (of.bench == 2), of.covariance, of.unit, of.bench)
    found = equivalence(moved)
    assert found.method == MANDEL_PAULE
    assert int(np.argmax(found.en)) == 2
    assert found.en[2] > 1.0
    against = [one for one in pairs(moved) if 2 in (one.first, one.second)]
    assert len(against) == 3
    assert all(one.en > 1.0 for one in against)


def test_pairs_count_the_units_that_both_measured():
    of, _ = several(1)
    units = {(one.first, one.second): one.units for one in pairs(of)}
    assert units == {(0, 1): 3, (0, 2): 3, (0, 3): 2, (1, 2): 3, (1, 3): 2, (2, 3): 2}


def test_units_on_one_bench_each_compare_nothing():
    of = Participants(np.array([1.0, 2.0]), np.eye(2), np.array([0, 1]), np.array([0, 1]))
    with pytest.raises(CalibrationError, match="no unit was measured on two benches"):
        equivalence(of)
    assert pairs(of) == ()


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
