"""Priors of types, and the capability of laboratories whose units drift: dense algebra, honest results."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration.result import CalibrationError
from bench.history.bench_or_block import bench_or_block
from bench.history.capability import YEAR, capability
from bench.history.drift import drift_of_unit
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations
from bench.history.prior import join, prior_of
from bench.results.fleet import capability_result
from bench.stats import unit_histories
from bench.stats.crossed_effects import EXCESS, Crossing, fit
from bench.stats.unit_histories import Within, histories, spread_of
from benchmarks.fleet_honesty import laboratory

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
    table = ComparedCalibrations(
        np.char.add("A ", unit.astype(str)), np.full(len(unit), "A"), np.char.add("b", bench.astype(str)), when,
        values, covariance, np.full((len(unit), 12), meters), np.zeros((len(unit), 12)),
        np.full(len(unit), STANDARD_GRAVITY), "V", True,
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
    with pytest.raises(
        CalibrationError, match="5 units of type A are too few for a prior; calibrate 6 units or more"
    ):
        prior_of(few)
    many, _ = measured(np.random.default_rng(1), 12, 2, 1.0)
    two = ComparedCalibrations(**{**many.__dict__, "kind": np.where(np.arange(24) < 12, "A", "B")})
    with pytest.raises(CalibrationError, match=r"several types \(A, B\), but a prior is for one; add type="):
        prior_of(two)


@pytest.mark.slow
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


VARIANCES = np.array([0.8, 0.5, 0.3, 0.7])
"""Of benches, scatter, rates and walks."""


def test_likelihood_slope_and_information_are_those_of_dense_matrices():
    rng = np.random.default_rng(4)
    unit, bench = rng.integers(0, 7, 30), rng.integers(0, 3, 30)
    unit = np.unique(unit, return_inverse=True)[1]
    years, y, stated = rng.uniform(0, 5, 30), rng.normal(size=30), rng.uniform(0.5, 1.5, 30)
    found = Within(histories(unit, bench, years), y, stated).at(VARIANCES)

    same = unit[:, None] == unit[None, :]
    first = np.array([years[unit == one].min() for one in unit])
    time = years - first
    walk = same * np.minimum(time[:, None], time[None, :])
    parts = [1.0 * (bench[:, None] == bench[None, :]), np.eye(30), same * np.outer(time, time), walk]
    V = np.diag(stated) + sum(v * part for v, part in zip(VARIANCES, parts, strict=True))
    X = np.eye(unit.max() + 1)[unit]
    inverse = np.linalg.inv(V)
    normal = X.T @ inverse @ X
    P = inverse - inverse @ X @ np.linalg.inv(normal) @ X.T @ inverse
    # contrasts of length one have the likelihood of all less half the logarithm of what columns are long
    constant = 0.5 * np.linalg.slogdet(X.T @ X)[1]
    likelihood = -0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1] + y @ P @ y) + constant
    assert found.likelihood == pytest.approx(likelihood, rel=1e-9)
    slope = [0.5 * (y @ P @ part @ P @ y - np.sum(P * part)) for part in parts]
    np.testing.assert_allclose(found.slope, slope, rtol=1e-8)
    information = [[0.5 * y @ P @ a @ P @ b @ P @ y for a in parts] for b in parts]
    np.testing.assert_allclose(found.information, information, rtol=1e-8)


@pytest.mark.slow
def test_capability_holds_the_scatter_of_the_laboratory_without_the_drift_of_its_units():
    """Seed 5: of twelve intervals of 90 % eight or more hold the truth but once in 200 times."""
    made = laboratory(np.random.default_rng(5), 16, 4, 2, (1.0, 3.0, 0.0, 0.5))
    found = capability(made)
    assert sum(one.scatter_least <= 1.0 <= one.scatter_most for one in found.spreads) >= 8
    assert all(one.shown for one in found.spreads)
    assert np.all(found.u > found.stated)
    units, benches = (np.unique(labels, return_inverse=True)[1] for labels in (made.unit, made.bench))
    crossing = Crossing(units, benches, np.zeros_like(units))
    with_drift = [
        fit(crossing, np.ascontiguousarray(y), v).sizes[EXCESS]
        for y, v in zip(made.vector.T[:2], made.variance.T, strict=False)
    ]
    assert min(with_drift) > 2.0
    assert any("a drift of units is taken out in Kxx" in note for note in found.notes)


@pytest.mark.slow
def test_where_no_unit_drifts_scatter_is_not_below_the_truth_more_often_than_it_may():
    """Seed 6: upper limits of 95 %, of twelve four are below the truth once in 450 times."""
    made = laboratory(np.random.default_rng(6), 16, 4, 2, (1.0, 0.0, 0.0, 0.5))
    found = [spread_of(of_column(made, k), several=True) for k in range(12)]
    assert sum(one.scatter_most < 1.0 for one in found) < 4
    # more than nine of twelve below the truth, where half are, once in 50 times
    assert sum(one.scatter < 1.0 for one in found) <= 9
    # 5 % are taken for a drift: five of twelve once in 5,000 times
    assert sum(one.shown for one in found) < 5


def of_column(made, k):
    unit, bench = (np.unique(labels, return_inverse=True)[1] for labels in (made.unit, made.bench))
    of = histories(unit, bench, (made.when - made.when[0]) / YEAR)
    return Within(of, made.vector[:, k], made.variance[:, k])


@pytest.mark.slow
def test_of_long_histories_in_a_large_laboratory_a_part_is_taken_and_that_is_said(monkeypatch):
    made = laboratory(np.random.default_rng(3), 3, 40, 2, (1.0, 0.0, 0.0, 0.5))
    monkeypatch.setattr(unit_histories, "MOST_WORK", 3 * 20.0**3)
    of = histories(*(np.unique(x, return_inverse=True)[1] for x in (made.unit, made.bench)), np.arange(120.0))
    assert (of.longest, of.dof) == (16, 45)
    for alike in of.alike:
        # from the first run to the last
        assert alike.rows[:, 0].tolist() == [0, 40, 80]
        assert alike.rows[:, -1].tolist() == [39, 79, 119]
    notes = capability(made).notes
    assert (
        "3 units have more than 16 runs; 16 of each, spread evenly in time, give scatter and drift" in notes
    )


def test_units_with_too_few_runs_to_tell_their_drift_are_told():
    made = laboratory(np.random.default_rng(2), 14, 2, 2, (1.0, 3.0, 0.0, 0.5))
    found = capability(made)
    assert found.counts["units_with_too_few_runs"] == 14
    assert any("no unit has 3 runs" in note for note in found.notes)
    assert not any(one.shown for one in found.spreads)
    # nothing is taken out that is not told: the drift is in the scatter
    assert min(found.scatter) > 1.0


GRAVITY_U = 0.1


def at_places(table, place, gravity_u=GRAVITY_U):
    """The table with the error of g at each place in its covariance, as coefficients per standard g have it."""
    of_g = np.where(np.arange(12) < 9, table.vector * gravity_u, 0.0)
    covariance = table.covariance + of_g[:, :, None] * of_g[:, None, :]
    return replace(table, covariance=covariance, gravity=of_g, place=place)


def test_the_error_of_gravity_is_one_for_all_benches_of_a_place():
    """The mean of a prior has all of u(g) from one place, and a quarter of its variance from four."""
    table, _ = measured(np.random.default_rng(9), 30, 2, 1.0, benches=4)
    plain = prior_of(table).mean_u
    mean_square = np.mean((table.vector[:, 0] * GRAVITY_U) ** 2)
    for places in (1, 2, 4):
        found = prior_of(at_places(table, 9.8 + np.arange(len(table)) % places))
        assert found.mean_u[0] ** 2 - plain[0] ** 2 == pytest.approx(mean_square / places)
        assert found.mean_u[9:] == pytest.approx(plain[9:])
        assert found.between == pytest.approx(prior_of(table).between)


def test_a_prior_of_other_places_has_the_local_gravity_in_it():
    prior = prior_of(measured(np.random.default_rng(6), 30, 2, 1.0)[0])
    mean, covariance = prior.per(STANDARD_GRAVITY, 3e-2)
    assert np.diag(covariance - prior.covariance)[:9] == pytest.approx((mean[:9] * 3e-2) ** 2)
    true = prior.mean
    known, unsure = (join(true, np.eye(12), 0 * np.eye(12), prior, STANDARD_GRAVITY, u) for u in (0.0, 3e-2))
    assert np.all(np.diag(unsure.covariance)[:9] > np.diag(known.covariance)[:9])


def test_benches_of_different_places_differ_by_the_errors_of_their_gravity():
    """Seed 3: this difference belongs to the benches, and is no scatter of calibrations."""
    rng = np.random.default_rng(3)
    table, _ = measured(rng, 12, 4, 3.0, benches=4)
    bench = np.arange(len(table)) % 4
    error = 1.0 + GRAVITY_U * np.where(np.arange(12) < 9, rng.normal(size=(4, 1)), 0.0)
    known = at_places(replace(table, vector=table.vector * error[bench]), 9.8 + bench)
    assert known.own_variance == pytest.approx(table.own_variance)
    sizes = bench_or_block(known).sizes[0]
    assert sizes.meters == pytest.approx(np.sqrt(np.mean((known.vector[:, 0] * GRAVITY_U) ** 2)))
    assert sizes.bench.value < 2.0 * sizes.meters
    assert sizes.excess.value < 0.5


def test_gravity_cancels_in_the_drift_at_one_place_and_counts_between_places():
    rng = np.random.default_rng(4)
    table, _ = measured(rng, 1, 8, 1.0, days=1000)
    table = replace(table, vector=table.vector + 1e4)
    here, between = (
        drift_of_unit(at_places(table, 9.8 + at, 5e-4)).drift for at in (np.zeros(8), np.arange(8) % 2)
    )
    plain = drift_of_unit(table).drift
    assert here.u_rate == pytest.approx(plain.u_rate, rel=0.02)
    assert np.all(between.u_rate[:9] > 1.5 * plain.u_rate[:9])
    assert here.common[:9] == pytest.approx(np.min(table.vector[:, :9] * 5e-4, axis=0))
