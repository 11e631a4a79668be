"""Reference values and degrees of equivalence: published cases, statsmodels, correlated and several units."""

from __future__ import annotations

import numpy as np
import pytest

from bench.calibration.result import CalibrationError
from bench.history.equivalence import (
    DERSIMONIAN_LAIRD,
    MANDEL_PAULE,
    WEIGHTED_MEAN,
    Participants,
    equivalence,
    of_one_unit,
    pairs,
)

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
