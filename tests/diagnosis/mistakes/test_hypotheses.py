"""The table of hypotheses on wrong readings: each evidence is that of a fit with the columns of the hypothesis."""

from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from bench.calibration.design import make_problem
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.mistakes.gross import ERRORS_G, GrossSearch
from bench.diagnosis.mistakes.hypotheses import ERRORS, Table
from bench.diagnosis.mistakes.reinterpretation import OrientedRows, nothing, suppositions
from bench.model import Block
from bench.validation.paper_bench import STAND_U, U0, K
from tests.support.mistaken_runs import MODEL, NOISE_V, NOMINAL, run, with_outlier

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


@pytest.mark.slow
def test_the_odds_of_a_map_are_those_of_the_whole_normal_density():
    """Coefficients and errors of positions are in the covariance; a unit has a Jacobian, a channel its errors."""
    readings = run([122, 0], passes=2).select(np.arange(40) % 3 == 0)
    search = GrossSearch(MODEL.installations, NOMINAL)
    table = OrientedRows.of(readings)
    maps = [one for one in suppositions(table, units=True) if one.source is None and one.scope.whole][::9]
    position = np.unique(np.stack([table.mount, np.round(np.degrees(table.angle_rad))], axis=1), axis=0)
    assert len(maps) > 3
    assert len(position) < len(table)

    def density(one):
        columns, signal = search._columns(table, one), one.signal(table) / 2.18
        mean, u = (np.array(of) / 2.18 for of in search._prior(table))
        angle = table.angle_rad if one.angle_rad is None else one.angle_rad
        place = np.stack([table.mount, np.round(np.degrees(angle))], axis=1)
        same = (place[:, None] == place).all(axis=2)
        sizes = []
        for reading, shared in product(ERRORS_G, (0.0, *ERRORS_G)):
            noise = reading**2 * np.eye(len(table)) + shared**2 * same
            of_channel = [
                multivariate_normal(columns @ mean[:, i], noise + (columns * u[:, i] ** 2) @ columns.T)
                for i in range(3)
            ]
            sizes.append([of.logpdf(signal[:, i]) for i, of in enumerate(of_channel)])
        return np.sum(logsumexp(sizes, axis=0)) + one.log_jacobian

    found = search._log_evidence(table, [nothing(table), *maps], table, table.every)
    expected = np.array([density(one) for one in [nothing(table), *maps]])
    assert found - found[0] == pytest.approx(expected - expected[0], rel=1e-6, abs=0.05)
