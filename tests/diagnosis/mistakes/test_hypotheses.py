"""The table of hypotheses on wrong readings: each evidence is that of a fit with the columns of the hypothesis."""

import numpy as np
import pytest
from scipy.special import logsumexp

from bench.calibration.design import make_problem
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.mistakes.hypotheses import ERRORS, Table
from bench.model import Block
from tests.support.mistaken_runs import MODEL, NOISE_V, run, with_outlier
from tests.support.paper_bench import STAND_U, U0, K

RATIO = 1.4


@pytest.fixture(scope="module")
def table():
    rows = with_outlier(run([121, 0]), 30, 1, 3e-4).oriented()
    return Table.of(make_problem(MODEL, rows.conditions(), STAND_U), Block(K, U0), rows.signal, 1e-7)


def by_fits(table, columns, sizes):
    """ln of the Bayes factor of columns of unit noise, from a fit with each prior size."""
    fits = [table.seen(RATIO, more=[size * table.unit * columns]).log_evidence for size in sizes]
    return logsumexp(fits) - np.log(len(sizes)) - table.seen(RATIO).log_evidence


def test_the_noise_of_the_bulk_is_that_of_a_reading(table):
    # the median of 162 residuals, along the turn of the head with the error of a setting of twice the noise
    assert NOISE_V / 1.3 < table.unit < 1.6 * NOISE_V


@pytest.mark.parametrize("row", [3, 30])
def test_an_error_of_a_reading(table, row):
    columns = (np.arange(len(table.left)) == row)[:, None, None] * np.eye(3)
    found = table.seen(RATIO).of_readings()
    assert found[row] == pytest.approx(by_fits(table, columns, ERRORS), rel=1e-6, abs=1e-6)
    assert int(np.argmax(found)) == 30


def test_a_change_of_the_bench(table):
    of_pass = table.of_pass(table.turn == 2)
    found = table.seen(RATIO).of_group(of_pass)
    assert found == pytest.approx(by_fits(table, of_pass, SIZES), rel=1e-6, abs=1e-6)


def test_a_known_error_is_no_error_any_more(table):
    row = (np.arange(len(table.left)) == 30)[:, None, None] * np.eye(3)
    beside = table.seen(RATIO, [row])
    assert beside.noise < 0.8 * table.seen(RATIO).noise
    assert np.max(np.delete(beside.of_readings(), 30)) < 0
