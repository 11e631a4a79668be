"""Crossed effects of units and benches, and many looks: dense algebra, statsmodels, recovery, honest u."""

import numpy as np
import pytest

from bench.history.bench_or_block import allotment
from bench.stats import holm
from bench.stats.crossed_effects import BENCH, EXCESS, UNIT, Crossing, fit, most, solve
from benchmarks.fleet_honesty import drawn


def crossing_of(seed: int, n: int, units: int, benches: int, kinds: int = 1):
    return drawn(np.random.default_rng(seed), n, units, benches, (3.0, 1.0, 0.7), kinds=kinds)


@pytest.mark.parametrize("sizes", [(3.0, 1.0, 0.7), (2.0, 0.5, 0.0), (3.0, 0.0, 1.0), (np.inf, 1.0, 0.7)])
def test_equations_are_those_of_dense_matrices(sizes):
    case = crossing_of(0, 60, 20, 4, 2)
    crossing, y, v = case.crossing, case.y, case.variance
    at = solve(crossing, y, v, np.array(sizes))
    of_unit, of_bench = np.eye(crossing.units)[crossing.unit], np.eye(crossing.benches)[crossing.bench]
    fixed = np.isinf(sizes[UNIT])
    X = of_unit if fixed else np.eye(crossing.groups)[crossing.group[crossing.unit]]
    V = np.diag(v + sizes[EXCESS] ** 2) + sizes[BENCH] ** 2 * of_bench @ of_bench.T
    if not fixed:
        V = V + sizes[UNIT] ** 2 * of_unit @ of_unit.T
    inverse = np.linalg.inv(V)
    normal = X.T @ inverse @ X
    P = inverse - inverse @ X @ np.linalg.inv(normal) @ X.T @ inverse
    likelihood = -0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1] + y @ P @ y)
    assert at.likelihood == pytest.approx(likelihood, rel=1e-10)
    variance = sizes[BENCH] ** 2
    np.testing.assert_allclose(at.bench, variance * of_bench.T @ P @ y, atol=1e-12)
    error = variance * np.eye(crossing.benches) - variance**2 * of_bench.T @ P @ of_bench
    np.testing.assert_allclose(at.bench_covariance, error, atol=1e-12)
    if not fixed:
        np.testing.assert_allclose(at.unit(y)[0], sizes[UNIT] ** 2 * of_unit.T @ P @ y, atol=1e-12)
        parts = [of_unit @ of_unit.T, of_bench @ of_bench.T, np.eye(len(y))]
        information = [[0.5 * y @ P @ a @ P @ b @ P @ y for a in parts] for b in parts]
        np.testing.assert_allclose(at.information(y), information, rtol=1e-9)


@pytest.mark.slow
def test_sizes_are_those_of_statsmodels():
    """Its residual is the excess, where next to nothing is stated of each value."""
    mixed = pytest.importorskip("statsmodels.regression.mixed_linear_model")
    case = crossing_of(5, 30, 6, 3)
    crossing, y = case.crossing, case.y
    found = fit(crossing, y, np.full(len(y), 1e-10))
    parts = mixed.VCSpec(
        ["bench", "unit"],
        [[[f"b{k}" for k in range(crossing.benches)]], [[f"u{k}" for k in range(crossing.units)]]],
        [[np.eye(crossing.benches)[crossing.bench]], [np.eye(crossing.units)[crossing.unit]]],
    )
    judge = mixed.MixedLM(y, np.ones((len(y), 1)), groups=np.ones(len(y)), exog_vc=parts).fit(reml=True)
    assert found.sizes[[UNIT, BENCH]] ** 2 == pytest.approx(judge.vcomp[[1, 0]], rel=2e-3)
    assert found.sizes[EXCESS] ** 2 == pytest.approx(judge.scale, rel=2e-3)


@pytest.mark.slow
def test_sizes_and_effects_are_found_with_honest_uncertainty():
    rng = np.random.default_rng(11)
    sizes, u, z = [], [], []
    for _ in range(16):
        case = drawn(rng, 600, 150, 10, (3.0, 1.0, 0.7))
        found = fit(case.crossing, case.y, case.variance)
        effect, covariance = found.bench
        sizes.append(found.sizes)
        u.append(found.u_sizes)
        z.append((effect - case.bench + case.bench.mean()) / np.sqrt(np.diag(covariance)))
    error = (np.mean(sizes, axis=0) - [3.0, 1.0, 0.7]) / (np.std(sizes, axis=0) / 4.0)
    assert np.all(np.abs(error) < 4.0)
    # the scatter of 16 sizes is known to 18 %: four times that
    assert np.all(np.abs(np.mean(u, axis=0) / np.std(sizes, axis=0) - 1.0) < 0.72)
    # 160 scores, of which those of a set sum to nothing: 144 degrees of freedom, known to 5.9 %
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 0.24


def test_no_difference_between_benches_has_a_limit():
    case = drawn(np.random.default_rng(3), 300, 100, 5, (3.0, 0.0, 0.0))
    found = fit(case.crossing, case.y, case.variance)
    assert found.sizes[BENCH] < 0.2
    assert 0.05 < most(found, BENCH) < 0.6


def test_units_given_to_benches_by_their_values_are_noticed():
    case = drawn(np.random.default_rng(7), 400, 200, 4, (3.0, 0.3, 0.0))
    assert allotment(fit(case.crossing, case.y, case.variance)).p > 0.01
    # the last bench is given, beside its own, units that were measured nowhere else and are larger
    unit = np.concatenate([case.crossing.unit, 200 + np.arange(60)])
    bench = np.concatenate([case.crossing.bench, np.full(60, 3)])
    crossing = Crossing(np.unique(unit, return_inverse=True)[1], bench, np.zeros(len(unit), dtype=np.int64))
    y = np.concatenate([case.y, case.y.mean() + 4.0 + np.random.default_rng(1).normal(size=60) * 3.0])
    assert allotment(fit(crossing, y, np.ones(len(y)))).p < 1e-4


def test_benches_that_no_unit_joins_are_apart():
    unit = np.array([0, 0, 1, 1, 2, 2, 3, 3])
    bench = np.array([0, 1, 0, 1, 2, 3, 4, 4])
    crossing = Crossing(unit, bench, np.zeros(8, dtype=np.int64))
    assert crossing.component.tolist() == [0, 0, 1, 1, 2]
    assert crossing.alone().tolist() == [4]
    assert crossing.groups == 3
    assert crossing.repeated == 4


def test_holm_is_that_of_its_published_example():
    """Four looks at 0.01, 0.04, 0.03, 0.005: adjusted 0.03, 0.06, 0.06, 0.02."""
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
