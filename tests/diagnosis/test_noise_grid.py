"""The map to white noise, whose blocks are small, against the whole covariance of all rows."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.multi_run_system import make_system
from bench.diagnosis.noise_grid import coupled, make_whitener
from bench.readings.table import JoinedPart, together
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND_U, paper_run
from tests.support.paper_bench import SETTING_U_RAD


def system(blocks):
    """Two short runs of one block, or of two."""
    rng = np.random.default_rng(71)
    tables = [paper_run(rng, directions=(1,)) for _ in range(2)]
    return make_system(
        together([JoinedPart(table, block=b) for table, b in zip(tables, blocks, strict=True)]),
        MODEL,
        STAND_U,
    )


@pytest.mark.parametrize("blocks", [(0, 0), (0, 1)])
@pytest.mark.parametrize("reaching_far", [0, 2])
def test_rows_are_weighed_as_by_the_whole_covariance(blocks, reaching_far):
    linear = system(blocks)
    rng = np.random.default_rng(72)
    wide = 1e-5 * rng.normal(size=(len(linear), reaching_far))
    linear = replace(linear, random=np.column_stack([linear.random, wide]))
    covariance = np.diag((NOISE_V * linear.relative) ** 2) + linear.random @ linear.random.T
    same = (linear.setting[:, None] == linear.setting) & (linear.setting >= 0)
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope, linear.slope), 0.0)
    factor = np.linalg.inv(np.linalg.cholesky(covariance))
    taken, _ = np.linalg.qr(factor @ (linear.fixed / np.linalg.norm(linear.fixed, axis=0)))
    white = factor - taken @ (taken.T @ factor)
    expected = NOISE_V**2 * white.T @ white
    found = make_whitener(linear, NOISE_V, SETTING_U_RAD)
    np.testing.assert_allclose(found.weigh(np.eye(len(linear))), expected, atol=1e-9)
    np.testing.assert_allclose(found.diagonal, np.diag(expected), atol=1e-9)
    y = rng.normal(size=(len(linear), 3))
    np.testing.assert_allclose((found @ y).T @ (found @ y), y.T @ expected @ y, atol=1e-7)
    # nothing is left of what coefficients explain
    explained = linear.fixed @ rng.normal(size=linear.fixed.shape[1])
    assert np.linalg.norm(found @ explained) < 1e-9 * np.linalg.norm(explained)


def test_parts_of_a_matrix_that_do_not_touch_are_found_in_any_order():
    rng = np.random.default_rng(73)
    matrix = np.zeros((11, 6))
    matrix[:4, :2] = rng.normal(size=(4, 2))
    matrix[4:9, 2:5] = rng.normal(size=(5, 3))
    rows, columns = rng.permutation(11), rng.permutation(6)
    parts = [(r.tolist(), c.tolist()) for r, c in coupled(matrix[np.ix_(rows, columns)])]
    where = [
        (sorted(np.flatnonzero(np.isin(rows, own_r))), sorted(np.flatnonzero(np.isin(columns, own_c))))
        for own_r, own_c in ((range(4), range(2)), (range(4, 9), range(2, 5)), ([], [5]))
    ]
    assert sorted(parts) == sorted((list(map(int, r)), list(map(int, c))) for r, c in where)
