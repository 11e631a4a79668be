"""The handbook's own check standard: a kilogram over thirteen years, whose process changed after 1985.

NIST/SEMATECH e-Handbook, 2.3.5.2: the values to the end of 1984 are the baseline; those after it are judged by a
Shewhart chart, an EWMA with lambda = 0.2 and, for the residual standard deviations, an F ratio.
"""

from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.stats.control_charts import centre_of, judge, short_term

DATA = Path(__file__).parents[1] / "data" / "kilogram-check.csv"
SMOOTHING = 0.2
YEAR, VALUE, SD = np.loadtxt(DATA, delimiter=",", skiprows=1).T
BASELINE = YEAR < 1985.0
MEAN, LONG_TERM = VALUE[BASELINE].mean(), VALUE[BASELINE].std(ddof=1)


def judged(smoothing=1.0, **settings):
    unit = np.ones((len(YEAR), 1, 1))
    centre = centre_of(VALUE[BASELINE, None], unit[BASELINE], "scatter")
    return judge(centre, VALUE[~BASELINE, None], unit[~BASELINE], smoothing, **settings)


def test_the_limits_are_those_of_the_scatter_before_1985():
    found = judged()
    assert found.deviation[:, 0] == pytest.approx(VALUE[~BASELINE] - MEAN)
    # a new value scatters about a mean that is itself of 99 values
    assert found.u[:, 0] == pytest.approx(LONG_TERM * np.sqrt(1 + 1 / 99))


def test_single_values_are_out_more_often_than_chance_allows():
    """At k = 2 one in 22 is out by chance: the handbook's chart has far more after 1985."""
    out = np.abs(judged().z[:, 0]) > 2.0
    before = np.abs(VALUE[BASELINE] - MEAN) > 2.0 * LONG_TERM
    assert stats.binomtest(int(before.sum()), len(before), 0.0455).pvalue > 0.05
    assert stats.binomtest(int(out.sum()), len(out), 0.0455).pvalue < 1e-5


def test_the_ewma_shows_the_shift_that_single_values_hardly_show():
    found = judged(SMOOTHING, settled=True)
    values = list(
        accumulate(VALUE[~BASELINE], lambda z, y: (1 - SMOOTHING) * z + SMOOTHING * y, initial=MEAN)
    )
    assert found.deviation[:, 0] == pytest.approx(np.array(values[1:]) - MEAN)
    ewma, shewhart = np.abs(found.z[:, 0]) > 3.0, np.abs(judged().z[:, 0]) > 3.0
    assert np.mean(ewma[-60:]) > 0.5
    assert np.mean(shewhart[-60:]) < 0.05


def test_the_precision_is_judged_by_f():
    dof = np.full(len(SD), 3.0)
    found = short_term(SD[~BASELINE], dof[~BASELINE], SD[BASELINE], dof[BASELINE])
    pooled = np.sqrt(np.mean(SD[BASELINE] ** 2))
    assert found.pooled == pytest.approx(pooled)
    assert found.p == pytest.approx(stats.f.sf(SD[~BASELINE] ** 2 / pooled**2, 3, 3 * 99))
