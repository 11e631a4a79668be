"""Priors of types and capability: honest calibrations with a prior, conflicts, refusals of what is too short."""

from __future__ import annotations

import numpy as np
import pytest

from bench.calibration.result import CalibrationError
from bench.history.capability import capability
from bench.history.equivalence import STANDARD_GRAVITY, Measured
from bench.history.prior import join, prior_of
from bench.results.fleet import capability_result

DAY = np.datetime64("2026-01-01")


def measured(rng, units, repeats, spread, *, meters=0.0, benches=1, excess=0.0, days=0):
    """Units of a type with u = 1, that differ by `spread`; also the effect of a further unit."""
    effect = spread * rng.normal(size=(units + 1, 12))
    unit = np.repeat(np.arange(units), repeats)
    bench = np.arange(len(unit)) % benches
    own = np.sqrt(1.0 + excess**2) * rng.normal(size=(len(unit), 12))
    values = 50.0 + effect[unit] + own + meters * rng.normal(size=(benches, 12))[bench]
    covariance = np.broadcast_to((1.0 + meters**2) * np.eye(12), (len(unit), 12, 12))
    when = DAY + np.round(np.linspace(0, days, len(unit))).astype("timedelta64[D]")
    table = Measured(
        np.char.add("A ", unit.astype(str)), np.full(len(unit), "A"), np.char.add("b", bench.astype(str)), when,
        values, covariance, np.full((len(unit), 12), meters), "V", True,
    )  # fmt: skip
    return table, 50.0 + effect[units]


@pytest.mark.slow
@pytest.mark.parametrize(("units", "spread"), [(8, 1.0), (30, 1.0), (30, 3.0)])
def test_calibrations_with_a_prior_are_better_and_honest(units, spread):
    rng = np.random.default_rng(21)
    z, u = [], []
    for _ in range(60):
        table, true = measured(rng, units, 2, spread)
        prior = prior_of(table)
        found = join(true + rng.normal(size=12), np.eye(12), np.zeros((12, 12)), prior, STANDARD_GRAVITY)
        own = np.sqrt(np.diag(found.covariance))
        z.append((found.vector - true) / own)
        u.append(own)
    # 720 scores: rms known to 2.7 %, and the prior of each draw is an estimate
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 0.11
    assert np.mean(u) < 0.96


def test_a_unit_unlike_the_others_stops_the_prior():
    rng = np.random.default_rng(5)
    table, true = measured(rng, 30, 2, 1.0)
    prior = prior_of(table)
    other = true + 15.0 * (np.arange(12) == 4)
    found = join(other, np.eye(12), np.eye(12), prior, STANDARD_GRAVITY)
    assert not found.used
    assert found.p < 1e-6
    np.testing.assert_array_equal(found.vector, other)
    np.testing.assert_array_equal(found.covariance, 2.0 * np.eye(12))
    assert int(np.argmax(np.abs(found.pull))) == 4
    assert join(true, np.eye(12), np.eye(12), prior, STANDARD_GRAVITY).used


def test_what_no_reading_shows_stays_whole():
    rng = np.random.default_rng(6)
    table, true = measured(rng, 30, 2, 1.0)
    found = join(true, np.eye(12), 4.0 * np.eye(12), prior_of(table), STANDARD_GRAVITY)
    assert np.all(np.diag(found.covariance) > 4.0)
    assert np.all(np.diag(found.covariance) < 4.8)


def test_errors_of_the_meters_are_in_the_mean():
    rng = np.random.default_rng(9)
    with_meters, _ = measured(rng, 30, 2, 1.0, meters=2.0)
    without, _ = measured(rng, 30, 2, 1.0)
    assert np.all(prior_of(without).mean_u < 0.7)
    assert np.all(prior_of(with_meters).mean_u > 1.2)


def test_scale_factors_are_per_local_gravity():
    table, _ = measured(np.random.default_rng(2), 10, 2, 1.0)
    prior = prior_of(table)
    mean, covariance = prior.per(9.78)
    assert mean[0] == pytest.approx(prior.mean[0] * 9.78 / 9.80665)
    assert mean[9] == prior.mean[9]
    assert covariance[0, 9] == pytest.approx(prior.covariance[0, 9] * 9.78 / 9.80665)


def test_refusals_of_a_prior():
    few, _ = measured(np.random.default_rng(1), 5, 2, 1.0)
    with pytest.raises(CalibrationError, match="5 units of type A: a prior needs 6 or more"):
        prior_of(few)
    many, _ = measured(np.random.default_rng(1), 12, 2, 1.0)
    two = Measured(**{**many.__dict__, "kind": np.where(np.arange(24) < 12, "A", "B")})
    with pytest.raises(CalibrationError, match="there are A, B"):
        prior_of(two)


def test_a_capability_has_scatter_over_time_and_benches_in_it():
    rng = np.random.default_rng(12)
    table, _ = measured(rng, 12, 6, 3.0, benches=4, excess=1.0, days=400)
    shown = capability(table)
    assert np.all(shown.stated == 1.0)
    assert np.mean(shown.scatter) == pytest.approx(1.0, abs=0.25)
    assert all(one.scatter_least < one.scatter < one.scatter_most for one in shown.spreads)
    assert np.mean(shown.u) == pytest.approx(np.sqrt(2.0), abs=0.2)
    assert np.all(shown.below == np.where(shown.u > 1.0, 72, 0))
    written = capability_result(shown, ["asked of all"])
    assert 2.0 * shown.u[0] == written.coefficients["Kxx"].U
    assert written.benches == ["b0", "b1", "b2", "b3"]
    assert written.notes[-1] == "asked of all"


def test_a_short_history_states_no_capability():
    table, _ = measured(np.random.default_rng(1), 6, 2, 1.0, days=30)
    with pytest.raises(CalibrationError) as refused:
        capability(table)
    for lack in ("12 calibrations (20", "6 repeated calibrations of a unit (10", "30 days between"):
        assert lack in str(refused.value)
