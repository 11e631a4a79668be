"""Repeats against their stated u: the ratio, the term that makes u honest, and chance."""

import numpy as np
import pytest

from bench.stats.repeats import compare_repeats

U = 1e-3


def repeats(seed, term, size=20 * U, groups=4, count=9, kinds=3):
    """Values and u (groups, count, kinds); the term moves the groups alike, as one switch-on moves all sensors."""
    rng = np.random.default_rng(seed)
    u = U * np.exp(rng.normal(0.0, 0.5, (1, count, 1))) * np.ones((groups, count, kinds))
    common = rng.standard_normal((1, count, kinds))
    moves = {
        "none": 0.0 * common,
        "restart": size * common,
        "drift": size * np.cumsum(common, axis=1),
        "scale": size / U * u * common,
    }
    return moves[term] + u * rng.standard_normal(u.shape) + rng.normal(0.0, 1.0, (groups, 1, kinds)), u


def test_honest_u_is_left_alone():
    found = [compare_repeats(*repeats(seed, "none")) for seed in range(8)]
    assert not any(one.too_small for one in found)
    assert all(one.term is None and one.held_after is None for one in found)
    assert np.mean([one.scatter for one in found]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("term", ["restart", "drift", "scale"])
def test_u_that_is_too_small_is_said_to_be_and_the_term_makes_it_honest(term):
    found = [compare_repeats(*repeats(seed, term)) for seed in range(6)]
    assert all(one.too_small and one.scatter > 5.0 for one in found)
    names = [one.term.name for one in found]
    assert names.count(term) >= 4
    # a 95 % interval holds 1 in 4 of 6 or more, but for a chance of 2 in 1000
    assert sum(one.held_after.low < 1.0 < one.held_after.high for one in found) >= 4
    assert all(np.all(one.term.u > repeats(0, term)[1].min()) for one in found)


def test_missing_repeats_weigh_nothing():
    value, u = repeats(1, "restart", groups=3)
    value[0, 2], u[0, 2] = np.nan, np.nan
    value[1], u[1] = np.nan, np.nan
    found = compare_repeats(value, u)
    assert found.too_small
    assert np.isnan(found.term.u[1]).all()
    alone = compare_repeats(value[[0, 2]], u[[0, 2]])
    assert found.held_after.value == pytest.approx(alone.held_after.value, rel=0.02)


def test_two_repeats_have_a_ratio_and_no_more():
    value, u = repeats(2, "restart", count=2)
    found = compare_repeats(value, u)
    assert found.scatter > 1.5
    assert (found.held_before, found.term, found.too_small) == (None, None, False)
