"""The chart of a check block: what it rejects, what it does not, what it says."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from bench.calibration.result import CalibrationError
from bench.history.control_chart import CheckRun, KnownDrift, Reference, control_chart
from bench.stats.control_charts import ChartDesign, components_of, drift_of, short_term

BEGUN = datetime(2026, 3, 1, 8, tzinfo=UTC)
U = np.geomspace(1e-5, 1e-4, 12)
COVARIANCE = np.diag(U**2)
NOTHING = np.zeros((12, 12))


def check_run(day: float, z: np.ndarray | float = 0.0, **changed) -> CheckRun:
    """A run so many days on, so many u off in every coefficient."""
    run = CheckRun(
        name=f"check-{day:g}",
        when=BEGUN + timedelta(days=day),
        value=2.0 + np.zeros(12) + z * U,
        covariance=COVARIANCE,
        noise=0.5 * U,
        s=1e-4,
        s_dof=36.0,
        design="plan",
        meters=("m1", "m2", "m3"),
        of_meters=NOTHING,
        lasting=NOTHING,
    )
    return replace(run, **changed)


def runs(count: int, seed: int = 1, first: float = 0.0, scatter: float = 1.0) -> list[CheckRun]:
    rng = np.random.default_rng(seed)
    return [check_run(first + k, scatter * rng.normal(size=12)) for k in range(count)]


def shifted(name: int, size: float) -> np.ndarray:
    return np.where(np.arange(12) == name, size, 0.0)


def test_a_bench_that_stays_is_in_control_and_one_that_jumps_is_not():
    baseline, later = runs(10), runs(5, seed=2, first=10.0)
    chart = control_chart(baseline, later, ChartDesign())
    assert chart.in_control
    assert [verdict.run for verdict in chart.verdicts] == [run.name for run in later]
    jumped = check_run(20.0, shifted(3, 12.0))
    chart = control_chart(baseline, [*later, jumped], ChartDesign())
    assert not chart.in_control
    (reason,) = chart.verdicts[-1].reasons
    assert reason.startswith("T² = ")
    assert "Kyx +1" in reason
    # what T² rejects is no part of the memory
    assert np.isnan(chart.ewma.t2[-1])


def test_a_small_shift_that_lasts_is_seen_by_the_ewma_alone():
    later = [check_run(10.0 + k, shifted(0, 2.5)) for k in range(12)]
    chart = control_chart(runs(10), later, ChartDesign())
    assert np.all(chart.shewhart.t2 < chart.limit_t2)
    assert "EWMA" in chart.verdicts[-1].reasons[0]
    assert "Kxx +" in chart.verdicts[-1].reasons[0]
    # once the bench is mended the memory begins anew
    mended = [*later, check_run(30.0)]
    begun = control_chart(runs(10), mended, ChartDesign(), restarted=BEGUN + timedelta(days=29))
    carried = control_chart(runs(10), mended, ChartDesign())
    assert begun.in_control
    assert abs(begun.ewma.z[-1, 0]) < 1.0 < carried.ewma.z[-1, 0]


def test_noise_is_judged_by_itself():
    chart = control_chart(runs(10), [check_run(11.0, s=2e-4)], ChartDesign())
    (reason,) = chart.verdicts[0].reasons
    assert "2.00 times that of the baseline (F = 4.00 for 36 and 360)" in reason


def test_limits_come_closer_with_more_runs_and_are_those_of_known_u_in_the_end():
    limits = [control_chart(runs(count), [], ChartDesign()).limit_t2 for count in (3, 5, 10, 60)]
    known = [replace(run, s_dof=0.0) for run in runs(3)]
    believed = control_chart(known, [], ChartDesign(basis="stated"))
    assert limits == sorted(limits, reverse=True)
    assert limits[-1] > believed.limit_t2 > 0.95 * limits[-1]


def test_the_scale_of_stated_u_is_found_and_told():
    chart = control_chart(runs(12, scatter=2.0), [], ChartDesign())
    assert float(chart.centre.scale) ** 0.5 == pytest.approx(2.0, rel=0.2)
    assert any("times as much as stated u" in note and "follow the scatter" in note for note in chart.notes)


def test_a_run_of_the_baseline_that_stands_apart_is_named():
    baseline = [*runs(8), check_run(8.5, shifted(5, 15.0))]
    chart = control_chart(baseline, [], ChartDesign())
    assert any(note.startswith("check-8.5 differs from the other runs") for note in chart.notes)


def test_a_known_drift_is_taken_off_with_its_u():
    later = [check_run(365.25, shifted(0, 20.0))]
    assert not control_chart(runs(10), later, ChartDesign()).in_control
    drift = KnownDrift(shifted(0, 20.0) * U, shifted(0, 1.0) * U)
    chart = control_chart(runs(10), later, ChartDesign(), drift=drift)
    assert chart.in_control
    assert chart.shewhart.u[0, 0] > 1.2 * chart.shewhart.u[0, 1] * U[0] / U[1]


@pytest.mark.parametrize(("known", "u", "told"), [(20.0, 1.0, False), (18.0, 5.0, False), (10.0, 0.5, True)])
def test_the_drift_of_accepted_runs_is_that_beyond_the_known_one(known, u, told):
    """A block that drifts by 20 u a year."""
    rng, years = np.random.default_rng(7), np.arange(0.0, 1.0, 1 / 36)
    real = [check_run(365.25 * year, rng.normal(size=12) + shifted(0, 20.0 * year)) for year in years]
    drift = KnownDrift(shifted(0, known) * U, shifted(0, u) * U)
    chart = control_chart(real[:10], real[10:], ChartDesign(basis="stated"), drift=drift)
    off = chart.drift.per_year - shifted(0, 20.0 - known) * U
    assert np.all(np.abs(off) < 4.0 * chart.drift.u)
    assert chart.drift.u[0] > u * U[0]
    assert any("add it under 'drift'" in note for note in chart.notes) == told


def test_a_reference_from_elsewhere_carries_what_lasts():
    lasting = np.diag((5.0 * U) ** 2)
    later = [check_run(1.0, shifted(2, 12.0), lasting=lasting)]
    reference = Reference("certificate", BEGUN, np.full(12, 2.0), NOTHING + COVARIANCE)
    chart = control_chart([], later, ChartDesign(basis="stated"), reference=reference)
    assert chart.in_control
    assert chart.shewhart.u[0, 2] == pytest.approx(U[2] * np.sqrt(1.0 + 1.0 + 25.0))
    assert "certificate" in chart.notes[0]


def test_other_meters_widen_the_limits_and_are_told():
    limits_of_meters = np.diag((10.0 * U) ** 2)
    later = [check_run(11.0, shifted(0, 15.0), meters=("new", "m2", "m3"), of_meters=limits_of_meters)]
    chart = control_chart(runs(10), later, ChartDesign())
    assert chart.in_control
    assert any("check-11" in note and "new baseline" in note for note in chart.notes)


def test_drift_of_the_block_is_found_with_its_u():
    rng = np.random.default_rng(2)
    year = np.linspace(0.0, 1.0, 30)
    values = rng.normal(size=(30, 12)) * U
    values[:, 4] += 30.0 * U[4] * year
    found = drift_of(year, values, U, np.inf)
    assert found.per_year[4] / U[4] == pytest.approx(30.0, abs=4.0 * found.u[4] / U[4])
    assert found.p[4] < 1e-6
    assert np.all(np.delete(found.p, 4) > 0.01)


def test_components_tell_what_stated_u_does_not_hold():
    rng = np.random.default_rng(6)
    values = rng.normal(size=(20, 12)) * U
    honest = components_of(values, COVARIANCE, 0.5 * U)
    assert honest.birge2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 228))
    assert honest.alike_p > 0.01
    assert np.all(honest.between_most > 0.0)
    values[:, 7] *= 5.0
    found = components_of(values, COVARIANCE, 0.5 * U)
    assert found.more_than_stated[7] < 1e-6
    assert found.between[7] == pytest.approx(np.sqrt(24.0) * U[7], rel=0.5)
    assert found.alike_p < 1e-6


def test_short_term_standard_deviations_are_pooled_by_their_freedom():
    """NIST/SEMATECH e-Handbook, 2.3.5.1: the limit is s sqrt(F), F of 1 % for 3 and 351 degrees of freedom."""
    found = short_term(np.array([2.0]), np.array([3.0]), np.full(117, 1.0), np.full(117, 3.0))
    assert found.pooled_dof == 351.0
    assert found.limits(0.01) == pytest.approx([np.sqrt(3.8384)], rel=1e-3)
    assert found.f == pytest.approx([4.0])
    assert found.p[0] < 0.01


def test_nothing_to_begin_with_is_refused():
    with pytest.raises(CalibrationError, match="measure the check block first"):
        control_chart([], [], ChartDesign())


def test_what_is_expected_of_a_later_day_follows_the_drift_and_is_less_sure_of_it():
    """Known: Kxx drifts by 100 u in a year, known to 20 u. The centre is that of the baseline's mean day, 4.5."""
    per_year, u_drift = shifted(0, 100.0) * U, shifted(0, 20.0) * U
    drifting = [
        replace(run, value=run.value + per_year * (run.when - BEGUN).days / 365.25) for run in runs(10)
    ]
    chart = control_chart(drifting, [], ChartDesign(), drift=KnownDrift(per_year, u_drift))
    plain = control_chart(runs(10), [], ChartDesign())
    for days in (4.5, 369.75):
        years = (days - 4.5) / 365.25
        value, covariance = chart.expected(BEGUN + timedelta(days=days))
        still, alike = plain.expected(BEGUN + timedelta(days=days))
        assert value - still == pytest.approx(per_year * (days / 365.25), abs=1e-3 * U[0])
        assert np.diag(covariance - alike) == pytest.approx((years * u_drift) ** 2, abs=1e-15)


def test_a_drift_that_the_runs_show_is_expected_to_continue():
    slope = shifted(5, 400.0) * U
    drifting = [
        replace(run, value=run.value + slope * (run.when - BEGUN).days / 365.25)
        for run in [check_run(30.0 * k, 0.3 * np.random.default_rng(k).normal(size=12)) for k in range(14)]
    ]
    chart = control_chart(drifting, [], ChartDesign())
    value, covariance = chart.expected(BEGUN + timedelta(days=730.5))
    assert value[5] - 2.0 == pytest.approx(2 * slope[5], rel=0.02)
    assert abs(value[4] - 2.0) < 3 * U[4]
    assert covariance[5, 5] > chart.expected(BEGUN + timedelta(days=400))[1][5, 5]


@pytest.mark.parametrize("baseline", [1, 2])
def test_stated_u_of_a_noise_from_few_readings_rejects_no_more_good_runs_than_stated(baseline):
    """The noise of each run has 22 degrees of freedom, for which its u is widened, as a calibration states it."""
    rng, dof, count = np.random.default_rng(17), 22.0, 20_000
    design = ChartDesign(arl=10.0, basis="stated")
    chart = control_chart([check_run(float(k), s_dof=dof) for k in range(baseline)], [check_run(9.0)], design)
    s2 = rng.chisquare(dof, (count, baseline)).mean(axis=1) / dof * dof / (dof - 2)
    deviation = rng.normal(size=(count, 12)) - rng.normal(size=(count, 12)) / np.sqrt(baseline)
    t2 = np.sum(deviation**2, axis=1) / (s2 * (1 + 1 / baseline))
    rejected, nominal = np.mean(t2 > chart.limit_t2), 1 / 30
    assert rejected == pytest.approx(nominal, abs=4 * np.sqrt(nominal / count))
    one = np.mean(np.abs(deviation[:, 0]) / np.sqrt(s2 * (1 + 1 / baseline)) > chart.limit_single)
    assert one == pytest.approx(nominal / 12, abs=4 * np.sqrt(nominal / 12 / count))
    assert chart.centre.p_joint(chart.limit_t2) == pytest.approx(nominal)


def at_two_places(seed: int, baseline: list[int], design: ChartDesign, u_there: float = 1.0):
    """The chart of runs at two places, whose values of g are wrong; 0 and 1 are the places of the baseline.

    u of a run at place 1 is `u_there` times that at place 0.
    """
    rng, of_g = np.random.default_rng(seed), np.where(np.arange(12) < 4, 10 * U, 0.0)
    wrong = rng.normal(size=2)
    own = [
        check_run(
            float(k),
            u_there**place * rng.normal(size=12) + wrong[place] * of_g / U,
            place=9.81 + 0.01 * place,
            of_gravity=of_g,
            covariance=u_there ** (2 * place) * COVARIANCE,
            design=f"plan-{place if u_there != 1.0 else 0}",
        )
        for k, place in enumerate([*baseline, 0, 1])
    ]
    return control_chart(own[:-2], own[-2:], design)


@pytest.mark.parametrize("basis", ["stated", "scaled"])
@pytest.mark.parametrize(
    ("baseline", "u_there"), [([0, 0, 0, 0, 0], 1.0), ([0, 0, 1, 0, 1, 1], 1.0), ([0, 0, 1, 0, 1, 1], 3.0)]
)
def test_runs_of_another_place_are_judged_with_the_u_of_both_values_of_g(basis, baseline, u_there):
    """Of places with unequal u, the one with the smaller u has most of the weight in the centre."""
    design, count = ChartDesign(basis=basis), 100
    charts = [at_two_places(seed, baseline, design, u_there) for seed in range(count)]
    for run in (0, 1):
        for p in (
            [chart.shewhart.p_joint[run] for chart in charts],
            [chart.shewhart.p[run, 0] for chart in charts],
        ):
            below = np.sum(np.array(p) < 0.1)
            assert below == pytest.approx(0.1 * count, abs=4 * np.sqrt(0.09 * count))
    assert np.mean([chart.centre.scale for chart in charts]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("between", [0.0, 9.0])
def test_a_run_without_some_readings_of_the_plan_has_the_noise_of_the_baseline(between):
    """By chance, its own readings scatter half as much; what differs `between` runs stays as stated."""
    own = {"covariance": (0.5 + between) * COVARIANCE, "noise": np.sqrt(0.5 * 34 / 36) * U, "s": 0.5e-4}
    partial = check_run(20.0, design="plan some", **own)
    chart = control_chart(runs(10), [partial], ChartDesign(basis="stated"))
    assert chart.shewhart.u[0] == pytest.approx(U * np.sqrt(2.0 + between + 0.1))
