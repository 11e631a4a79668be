"""Reference data: certified values follow from the data exactly; all checks pass and say where they come from."""

import math
import re
from decimal import Decimal, localcontext
from fractions import Fraction

import pytest

from bench.validation.reference import strd
from bench.validation.registry import Context, carry_out, every

QUICK = ("reference data", "statistics of own results", "results given out")


def solved(matrix, right):
    """The exact solution of a linear system, by Gauss and Jordan."""
    rows = [[*row, *more] for row, more in zip(matrix, right, strict=True)]
    n = len(rows)
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                rows[k] = [a - rows[k][i] * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [row[n:] for row in rows]


def root(value):
    with localcontext() as context:
        context.prec = 40
        return float((Decimal(value.numerator) / Decimal(value.denominator)).sqrt())


@pytest.mark.parametrize("name", strd())
def test_certified_values_follow_from_the_data_exactly(name):
    """Least squares in rational arithmetic: estimates, their deviations and that of the residuals, to 14 digits."""
    one = strd()[name]
    if one["powers"] == "columns":
        rows = [[Fraction(1), *map(Fraction, row)] for row in one["x"]]
    else:
        rows = [[Fraction(x) ** power for power in one["powers"]] for x in one["x"]]
    y, p = list(map(Fraction, one["y"])), len(rows[0])
    normal = [[sum(row[i] * row[j] for row in rows) for j in range(p)] for i in range(p)]
    right = [
        [sum(row[i] * value for row, value in zip(rows, y, strict=True)), *(int(i == j) for j in range(p))]
        for i in range(p)
    ]
    found = solved(normal, [list(map(Fraction, row)) for row in right])
    estimates = [row[0] for row in found]
    left = [
        value - sum(e * x for e, x in zip(estimates, row, strict=True))
        for row, value in zip(rows, y, strict=True)
    ]
    variance = sum(one**2 for one in left) / (len(y) - p)
    assert [float(one) for one in estimates] == pytest.approx(list(map(float, one["estimates"])), rel=1e-14)
    deviations = [root(variance * found[i][1 + i]) for i in range(p)]
    assert deviations == pytest.approx(list(map(float, one["deviations"])), rel=1e-14)
    assert root(variance) == pytest.approx(float(one["residual_deviation"]), rel=1e-14)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    from bench.config.shipped import find_bench

    context = Context(find_bench("paper-stand"), tmp_path_factory.mktemp("scratch"), quick=True)
    return carry_out(context, [one for one in every() if one.family in QUICK])


@pytest.mark.slow
def test_published_results_are_met(rows):
    assert len(rows) > 60
    assert [f"{row.name}: {row.found}, not {row.expected}" for row in rows if not row.passed] == []


@pytest.mark.slow
def test_every_row_says_what_was_expected(rows):
    assert [row.name for row in rows if not (row.expected and row.found and row.did)] == []
    assert [row.name for row in rows if row.clause != "6.4.13" and not row.source] == []


def test_every_check_has_a_clause_a_sentence_and_a_place():
    for one in every():
        assert re.fullmatch(r"[678](\.\d+)+", one.clause), one.name
        assert one.did.endswith((".", ";")) or one.did, one.name
    names = [(one.family, one.name) for one in every()]
    assert len(set(names)) == len(names)


def test_random_checks_together_fail_by_chance_once_in_a_thousand_at_most():
    assert 0.0 < sum(one.p_false for one in every()) <= 1e-3
    assert all(math.isfinite(one.p_false) for one in every())
