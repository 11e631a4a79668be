"""Differences of meters by exchanged ones, against dense least squares and by simulation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bench.history.learned import (
    NOT_EXCHANGED,
    ONE_METER,
    TOO_FEW,
    MeterRun,
    lengths_and_biases,
    meter_differences,
)

TURNS = ("ABC", "BCA", "CAB")
SIGMA = 4e-6
G0 = {"A": 12e-6, "B": -9e-6, "C": 3e-6, "D": 25e-6, "E": 0.0, "F": 8e-6}
ZERO = {"A": 9e-6, "B": -14e-6, "C": 2e-6, "D": -5e-6, "E": 1e-6, "F": 4e-6}


def run(rng, name, unit, meters, lengths, biases, extra=0.0, day=0.0, **changed):
    """A run of rows as long as `lengths` (V/g) with `biases` (g): scatter as stated, and `extra` beyond it."""
    own = np.sqrt(SIGMA**2 + extra**2)
    gain, zero = (np.array([of[m] for m in meters]) for of in (G0, ZERO))
    values = np.concatenate([np.log(lengths) + gain, biases + zero / lengths])
    values += own * rng.normal(size=6)
    made = MeterRun(
        name, unit, tuple(meters), day, values, SIGMA**2 * np.eye(6), np.zeros((6, 0)), np.zeros((3, 2)), 90.0
    )
    return replace(made, **changed)


def of_units(rng, *units, **kinds):
    runs = []
    for unit, orders in enumerate(units):
        lengths, biases = rng.uniform(1.0, 2.5, 3), 0.1 * rng.normal(size=3)
        runs += [
            run(rng, f"{unit}-{k}", f"u{unit}", order, lengths, biases, **kinds)
            for k, order in enumerate(orders)
        ]
    return runs


def dense(runs, meters, quantity, between):
    """Differences from the first meter by dummies and whole matrices; their covariance."""
    at = slice(3 * quantity, 3 * quantity + 3)
    y = np.concatenate([r.values[at] for r in runs])
    cells = sorted({(r.unit, c) for r in runs for c in range(3)})
    X = np.zeros((len(y), len(cells) + len(meters) - 1))
    V = np.zeros((len(y), len(y)))
    scale = np.ones(len(y))
    for k, r in enumerate(runs):
        V[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += r.covariance[at, at]
        for c in range(3):
            X[3 * k + c, cells.index((r.unit, c))] = 1.0
            m = meters.index(r.meters[c])
            if m:
                X[3 * k + c, len(cells) + m - 1] = 1.0
            if quantity:
                scale[3 * k + c] = np.exp(np.mean([o.values[c] for o in runs if o.unit == r.unit]))
    for one in range(len(runs)):
        for other in range(len(runs)):
            if runs[one].unit == runs[other].unit:
                alike = runs[one].block[at] @ runs[other].block[at].T
                V[3 * one : 3 * one + 3, 3 * other : 3 * other + 3] += alike
    V = V * np.outer(scale, scale) + between**2 * np.eye(len(y))
    W = np.linalg.inv(V)
    covariance = np.linalg.inv(X.T @ W @ X)
    found = covariance @ X.T @ W @ (scale * y)
    return found[len(cells) :], covariance[len(cells) :, len(cells) :]


@pytest.mark.parametrize("quantity", [0, 1])
def test_differences_are_those_of_whole_matrices(quantity):
    """Seed 3: two units, one with terms of its own that are alike in its runs."""
    rng = np.random.default_rng(3)
    runs = of_units(rng, TURNS, ("ABC", "BAC", "ABC"))
    runs = [replace(r, block=1e-5 * rng.normal(size=(6, 2))) if r.unit == "u0" else r for r in runs]
    found = meter_differences(runs)
    own = (found.gain, found.zero)[quantity]
    values, covariance = dense(runs, list(found.meters), quantity, own.between)
    for b in (1, 2):
        value, u = own.difference(b, 0)
        assert value == pytest.approx(values[b - 1], rel=1e-6, abs=1e-12)
        assert u == pytest.approx(np.sqrt(covariance[b - 1, b - 1]), rel=1e-6)
    assert own.values.sum() == pytest.approx(0.0, abs=1e-15)
    # of what all have in common nothing is told
    np.testing.assert_allclose(own.covariance @ np.ones(3), 0.0, atol=1e-20)


def test_three_turns_of_one_block_have_a_closed_form():
    """Seed 4: the mean over channels of each meter's readings, less the channel's own mean."""
    runs = of_units(np.random.default_rng(4), TURNS)
    y = np.array([r.values[:3] for r in runs])
    left = y - y.mean(axis=0)
    mean = {m: np.mean([left[k, r.meters.index(m)] for k, r in enumerate(runs)]) for m in "ABC"}
    found = meter_differences(runs)
    for b, a in found.pairs():
        value, u = found.gain.difference(b, a)
        assert value == pytest.approx(mean[found.meters[b]] - mean[found.meters[a]], abs=1e-13)
        assert u == pytest.approx(np.sqrt(2 / 3 * (SIGMA**2 + found.gain.between**2)), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("extra", [0.0, SIGMA, 5 * SIGMA])
def test_differences_are_as_sure_as_they_say(extra):
    """Seed 5: 100 benches, three turns of one block or two of two blocks; blocks repeat worse than stated.

    Promised |z| <= 2 in 93 %: fewer than a binomial of that gives in 1 of 1,000 is a failure.
    """
    rng = np.random.default_rng(5)
    z = []
    for k in range(100):
        runs = of_units(rng, *((TURNS,), (TURNS[:2], TURNS[:2]))[k % 2], extra=extra)
        found = meter_differences(runs)
        value, u = found.gain.difference(1, 0)
        true = G0[found.meters[1]] - G0[found.meters[0]]
        z.append((value - true) / u)
    assert np.sum(np.abs(z) <= 2) >= stats.binom.ppf(1e-3, 100, 0.93)
    if extra:
        assert np.sqrt(np.mean(np.square(z))) > 0.6  # nor does a u so wide that it says nothing pass


def test_a_replaced_meter_is_compared_through_the_check_block_and_others_are_not():
    """Seed 6: D took the place of A before the third run; E, F and C never met A or each other's channels."""
    rng = np.random.default_rng(6)
    runs = of_units(rng, ("ABC", "ABC", "DBC", "DBC"))
    found = meter_differences(runs)
    group = dict(zip(found.meters, found.group, strict=True))
    assert group["A"] == group["D"]
    assert len({group["A"], group["B"], group["C"]}) == 3
    (pair,) = found.pairs()
    value, u = found.gain.difference(*pair)
    assert abs(value - (G0["D"] - G0["A"])) < 4 * u
    assert any("no channel was read by both" in words for words in found.not_told())


def test_meters_that_moved_between_the_runs_count_with_it():
    """Seed 7: D was looked at when A was gone, ten days on the mean from when A was."""
    runs = of_units(np.random.default_rng(7), ("ABC", "ABC", "DBC", "DBC"))
    later = [replace(r, day=10.0 * k, drift=np.full((3, 2), 2e-4)) for k, r in enumerate(runs)]
    still, moved = meter_differences(runs), meter_differences(later)
    (pair,) = moved.pairs()
    moved_each = 2e-4 * 5 / 90  # by the nearer of the two runs at the least
    assert moved.gain.difference(*pair)[1] > np.sqrt(2) * moved_each > still.gain.difference(*pair)[1]
    assert moved.day == pytest.approx(15.0)


@pytest.mark.parametrize(
    ("orders", "why"),
    [(("ABC", "ABC"), NOT_EXCHANGED), (("AAA", "AAA"), ONE_METER), (("ABC", "BCA"), TOO_FEW),
     (("ABC", "DEF"), TOO_FEW)],
)  # fmt: skip
def test_what_no_exchange_tells_is_not_told(orders, why):
    """Seed 8: a difference that repeats cannot tell from the block's own change is none of zero u."""
    assert meter_differences(of_units(np.random.default_rng(8), orders)) == why


def test_a_turn_of_the_block_changes_no_length():
    K = np.array([[-2.18, -0.018, 0.025], [0.027, -2.14, 0.033], [0.007, 0.006, -2.144]])
    U0 = np.array([0.07, -0.2, -0.4])
    a = 2e-3
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    plain = np.concatenate([K.ravel(), U0])
    values, slope = lengths_and_biases(plain)
    np.testing.assert_allclose(lengths_and_biases(np.concatenate([(K @ turn).ravel(), U0]))[0], values)
    # a gain of one channel is in its length alone
    gained = lengths_and_biases(plain * np.concatenate([np.repeat([1 + 1e-5, 1, 1], 3), [1 + 1e-5, 1, 1]]))[0]
    np.testing.assert_allclose(gained - values, [1e-5, 0, 0, 0, 0, 0], atol=1e-9)
    steps = 1e-6 * np.eye(12)
    by_step = np.array(
        [(lengths_and_biases(plain + s)[0] - lengths_and_biases(plain - s)[0]) / 2e-6 for s in steps]
    )
    np.testing.assert_allclose(slope, by_step.T, atol=1e-8)
