"""Calibrations over time: E_n, joint test, number of looks, drift, gravity."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy import stats

from bench.calibration import CalibrationError, calibrate
from bench.history.comparison import Snapshot, compare, joint_covariances, joint_of
from bench.history.measured import nine_of
from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import write_csv
from bench.results.compare import compare_result, verdict_of
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from tests.support.thermal_bench import MODEL
from tests.support.whole_truth import turned

BEGIN = datetime(2024, 1, 1, tzinfo=UTC)
A = np.random.default_rng(31).normal(size=(12, 12))
COVARIANCE = 1e-10 * (A @ A.T / 12 + np.eye(12))
ROOT = np.linalg.cholesky(COVARIANCE)
U = np.sqrt(np.diag(COVARIANCE))


def snapshot(vector, days=0.0, name="x", **changes):
    when = BEGIN + timedelta(days=days)
    made = Snapshot(name, when, "block 1", "V", 9.81, np.asarray(vector), COVARIANCE)
    return replace(made, **changes)


def drawn(rng, shift=0.0, **changes):
    return snapshot(TRUTH + shift + ROOT @ rng.normal(size=12), **changes)


def test_e_n_and_chi_square_are_what_their_definitions_say():
    step = np.zeros(12)
    step[4] = 3e-5
    found = compare([snapshot(TRUTH), snapshot(TRUTH + step, 30)]).twelve.changes[0]
    # U = 2 u of each: E_n = |x1 - x2|/sqrt(U1^2 + U2^2)
    assert found.en[4] == pytest.approx(3e-5 / np.sqrt(2 * (2 * U[4]) ** 2), rel=1e-9)
    assert found.chi2 == pytest.approx(step @ np.linalg.inv(2 * COVARIANCE) @ step, rel=1e-9)
    assert found.p == pytest.approx(stats.chi2.sf(found.chi2, 12), rel=1e-9)
    assert found.en[[0, 5, 11]].tolist() == [0.0, 0.0, 0.0]


def test_terms_of_the_block_cancel_as_far_as_both_calibrations_take_them_up():
    """The difference of two x_i = x + B_i t + e_i, t of unit size: covariance 2 C + (B1 - B2)(B1 - B2)^T."""
    first, later = 1e-4 * np.random.default_rng(35).normal(size=(2, 12, 6))
    taken = [
        snapshot(TRUTH, 30 * k, covariance=COVARIANCE + b @ b.T, block_terms=b)
        for k, b in enumerate((first, later))
    ]
    alike = replace(taken[1], covariance=taken[0].covariance, block_terms=first)
    left = first - later
    expected = np.sqrt(np.diag(2 * COVARIANCE + left @ left.T))
    np.testing.assert_allclose(compare(taken).twelve.changes[0].u, expected, rtol=1e-9)
    np.testing.assert_allclose(compare([taken[0], alike]).twelve.changes[0].u, np.sqrt(2) * U, rtol=1e-9)
    # another block, and a result that does not say, have their own
    both = np.sqrt(np.diag(2 * COVARIANCE + first @ first.T + later @ later.T))
    for other in (replace(taken[1], block="block 2"), replace(taken[1], block_terms=None)):
        np.testing.assert_allclose(compare([taken[0], other]).twelve.changes[0].u, both, rtol=1e-9)


def test_a_bias_that_wanders_during_a_run_goes_on_between_runs():
    """Seed 36, 4,000 walks of 60 steps: mean less beginning, beside the rms about it. Four standard errors."""
    walks = np.cumsum(np.random.default_rng(36).normal(size=(4000, 60)), axis=1)
    about = np.mean((walks - walks.mean(axis=1, keepdims=True)) ** 2)
    gone = 2.0 * about
    assert np.mean(walks.mean(axis=1) ** 2) == pytest.approx(gone, rel=4 * np.sqrt(2 / 4000) + 1 / 60)
    wander = np.array([0.0, 1e-5, 2e-5])
    both = [snapshot(TRUTH, 30 * k, wander=wander) for k in range(2)]
    added = compare(both).twelve.changes[0].u ** 2 - 2 * U**2
    np.testing.assert_allclose(added[9:], 2 * 2.0 * wander**2, atol=1e-18)
    np.testing.assert_allclose(added[:9], 0.0, atol=1e-18)


@pytest.mark.slow
def test_of_unchanged_blocks_about_one_in_twenty_is_told_changed():
    """300 pairs: a change is told with 5 %, by the joint test of the nine."""
    told = 0
    chi2, of_nine = [], []
    for k in range(300):
        rng = np.random.default_rng([32, k])
        found = compare([drawn(rng), drawn(rng, days=100)])
        told += found.changed
        chi2.append(found.twelve.changes[0].chi2)
        of_nine.append(found.nine.changes[0].chi2)
    assert stats.binom.ppf(1e-4, 300, 0.05) < told < stats.binom.ppf(0.9999, 300, 0.05)
    assert stats.kstest(chi2, stats.chi2(12).cdf).pvalue > 1e-3
    assert stats.kstest(of_nine, stats.chi2(9).cdf).pvalue > 1e-3


def test_a_block_that_is_turned_differs_in_the_twelve_and_in_none_of_the_nine():
    """A turn of one degree, and meters, terms of the block and wander turned with it: nothing changed."""
    R = turned(np.random.default_rng(39), np.radians(1.0))
    own = np.eye(12)
    own[:9, :9] = np.kron(np.eye(3), R.T)
    terms = 1e-5 * np.random.default_rng(40).normal(size=(12, 6))
    both = {"wander": np.full(3, 1e-6), "meters": ("1", "2", "3")}
    parts = {"covariance": COVARIANCE + terms @ terms.T, "same_meters": COVARIANCE / 2 + terms @ terms.T}
    first = snapshot(TRUTH, 0, block_terms=terms, **parts, **both)
    moved = {name: own @ part @ own.T for name, part in parts.items()}
    later = snapshot(own @ TRUTH, 1, block_terms=own @ terms, **moved, **both)
    found = compare([first, later])
    assert found.nine.changes[0].en == pytest.approx(np.zeros(9), abs=1e-6)
    assert found.twelve.changes[0].p < 1e-9
    result = compare_result(found, ())
    assert not result.changed
    assert "no change exceeds the uncertainty" in verdict_of(result)
    assert "the block is turned" in verdict_of(result)


def test_free_positions_alone_are_compared_in_the_nine():
    """K = L Q with L triangular: the same block, found with and without known orientations."""
    K = TRUTH[:9].reshape(3, 3)
    upper = np.linalg.cholesky((K @ K.T)[::-1, ::-1])[::-1, ::-1]
    free = np.concatenate([upper.ravel(), TRUTH[9:]])
    covariance = np.diag(np.where(free == 0.0, 0.0, 1e-10))
    found = compare([snapshot(TRUTH), snapshot(free, 9, name="free", covariance=covariance)])
    assert found.twelve is None
    assert found.nine.changes[0].en == pytest.approx(np.zeros(9), abs=1e-6)
    assert "free: from free positions alone" in found.notes[0]
    part = compare_result(found, ()).to_dict()["compared"][0]
    assert (part["coefficients"], part["p"], len(part["intrinsic"]["values"])) == ({}, None, 9)


def test_a_change_is_named_and_one_of_all_is_seen_together():
    rng = np.random.default_rng(33)
    step = np.zeros(12)
    step[10] = 8 * U[10]
    found = compare([drawn(rng), drawn(rng, step, days=100)])
    assert np.flatnonzero(found.twelve.changes[0].changed).tolist() == [10]
    assert found.nine.shown == ("by",)
    assert found.changed
    # spread over all: the direction that the covariance holds tightest
    tight = np.linalg.eigh(COVARIANCE)
    together = compare([drawn(rng), drawn(rng, 9 * np.sqrt(tight[0][0]) * tight[1][:, 0], days=9)])
    assert together.twelve.p_constant < 0.01


def test_a_drift_has_its_rate_and_an_honest_uncertainty():
    rate = np.zeros(12)
    rate[9] = 1e-4
    z = []
    for k in range(40):
        rng = np.random.default_rng([34, k])
        days = [0.0, 100.0, 250.0, 400.0]
        drift = compare([drawn(rng, rate * d / 365.25, days=d) for d in days]).twelve.drift
        z.append((drift.per_year - rate) / drift.u)
        assert drift.shown[9]
    z2 = np.mean(np.square(z))
    # 480 values, correlated within a calibration: worth 12 independent directions each
    assert abs(z2 - 1) < 4 * np.sqrt(2 / 480)
    assert drift.dof == 24


@pytest.mark.slow
def test_calibrations_of_one_week_share_the_errors_of_their_meters():
    """Seed 37, 200 unchanged blocks, one day in a year and five in the next: 5 % show a drift or a change."""
    rng = np.random.default_rng(37)
    meters = 25.0 * COVARIANCE
    days = np.array([0.0, 400.0, 401.0, 402.0, 403.0, 404.0])
    apart = np.abs(days[:, None] - days)
    alike = np.linalg.cholesky(np.maximum(1.0 - apart / 90.0, 0.0))
    shown = np.zeros(2)
    for _ in range(200):
        error = alike @ rng.normal(size=(6, 12)) @ (5.0 * ROOT).T
        found = compare([
            drawn(rng, own, days=day, name=f"{day:g}", covariance=COVARIANCE + meters, same_meters=COVARIANCE,
                  meters=("A", "B", "C"))
            for own, day in zip(error, days.tolist(), strict=True)
        ]).twelve  # fmt: skip
        shown += [bool(np.any(found.drift.shown)), found.p_constant < 0.05]
    assert np.all(shown <= 10 + 4 * np.sqrt(10))


def test_the_line_through_independent_coefficients_is_the_textbooks():
    rng = np.random.default_rng(35)
    sizes = [1e-5, 2e-5, 3e-5, 1e-5]
    days = np.array([0.0, 80.0, 200.0, 365.25])
    several = [
        snapshot(TRUTH + rng.normal(0, s, 12), d, covariance=s**2 * np.eye(12))
        for s, d in zip(sizes, days, strict=True)
    ]
    drift = compare(several).twelve.drift
    years, weights = days / 365.25, np.array(sizes) ** -2.0
    middle = np.sum(weights * years) / np.sum(weights)
    spread = np.sum(weights * (years - middle) ** 2)
    values = np.array([s.vector[3] for s in several])
    assert drift.per_year[3] == pytest.approx(np.sum(weights * (years - middle) * values) / spread, rel=1e-6)
    assert drift.u[3] == pytest.approx(spread**-0.5, rel=1e-9)


def test_another_gravity_is_converted_and_told():
    """The same block in V/(m/s^2): at a larger g a local g is more volts."""
    first = snapshot(TRUTH, g_m_s2=9.80)
    factor = np.where(np.arange(12) < 9, 9.83 / 9.80, 1.0)
    elsewhere = snapshot(TRUTH * factor, 50, g_m_s2=9.83, covariance=COVARIANCE * np.outer(factor, factor))
    found = compare([first, elsewhere])
    assert max(np.max(of.changes[0].en) for of in (found.nine, found.twelve)) < 1e-6
    assert any("local gravity differs" in note for note in found.notes)
    assert not found.changed


def test_order_is_that_of_dates_and_without_dates_that_of_names():
    late, early = snapshot(TRUTH, 90, name="late"), snapshot(TRUTH, 0, name="early")
    assert compare([late, early]).nine.first.name == "early"
    undated = compare([snapshot(TRUTH, name="b", when=None), early])
    assert undated.nine.first.name == "b"
    assert any("not every calibration has a date" in note for note in undated.notes)


def test_calibrations_of_one_day_have_no_drift():
    rng = np.random.default_rng(36)
    assert compare([drawn(rng, days=d) for d in (0.0, 0.01, 0.02)]).nine.drift is None


def test_other_blocks_simulations_and_copies_are_noted():
    notes = compare(
        [snapshot(TRUTH), snapshot(TRUTH, 5, block="block 2"), snapshot(TRUTH + 1e-6, 9, simulated=True)]
    ).notes
    assert any("DIFFERENT BLOCKS, as recorded: block 1, block 2" in note for note in notes)
    assert any("simulated" in note for note in notes)
    assert any("come from the same readings" in note for note in notes)


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(CalibrationError, match="two or more calibrations"):
        compare([snapshot(TRUTH)])
    with pytest.raises(CalibrationError, match=r"in different units \(x in V, y in counts\)"):
        compare([snapshot(TRUTH), snapshot(TRUTH, name="y", unit="counts")])
    with pytest.raises(CalibrationError, match="y: the covariance is singular"):
        compare([snapshot(TRUTH), snapshot(TRUTH, name="y", covariance=np.diag([0.0] + [1e-10] * 11))])


@pytest.mark.slow
def test_calibrations_of_simulated_readings_agree_and_a_moved_bias_is_found():
    """Through the calibration itself: the covariances that it gives are the ones that count here."""
    chi2 = []
    for k in range(15):
        pair = [
            calibrate(simulate(np.random.default_rng([37, k, i]), 1e-4), MODEL, STAND_U, 9.81) for i in (0, 1)
        ]
        first, later = (snapshot(c.block.vector, 10 * i, covariance=c.covariance) for i, c in enumerate(pair))
        chi2.append(compare([first, later]).twelve.changes[0].chi2)
    # the mean of 15 chi-squares with 12 degrees of freedom: 12 with a standard deviation of 1.3
    assert abs(np.mean(chi2) - 12.0) < 4 * 1.3
    later.vector[11] += 3e-4
    assert COEFFICIENTS[int(np.argmax(compare([first, later]).twelve.changes[0].en))] == "U0z"


def readings_files(folder):
    for k in range(3):
        table = simulate(np.random.default_rng([38, k]), 1e-4)
        table.signal[:, 2] += 1e-3 * (k == 2)
        write_csv(table, folder / f"r{k}.csv")


@pytest.mark.slow
@pytest.mark.figures
def test_the_command_compares_results_and_files_writes_and_judges(bench, tmp_path):
    readings_files(tmp_path)
    bench("calibrate", "r0.csv", "r2.csv", "--json", "results.json")
    for name, result in zip(("r0", "r2"), json.loads((tmp_path / "results.json").read_text()), strict=True):
        (tmp_path / f"{name}.json").write_text(json.dumps(result))
    status, out, err = bench("compare", "r0.json", "r1.csv", "--strict", "--json", "alike.json")
    assert (status, err) == (0, "")
    assert "no change exceeds the uncertainty" in out
    alike = json.loads((tmp_path / "alike.json").read_text())
    assert (alike["changed"], alike["drift"]) == (False, None)
    assert len(alike["compared"][0]["coefficients"]) == 12
    dates = [text for day in ("2024-01-01", "2025-01-01", "2026-01-01") for text in ("--date", day)]
    status, out, _ = bench(
        "compare", "r0.json", "r1.csv", "r2.json", *dates, "--strict", "--out", "h", "--json", "-"
    )
    assert status == 1
    result = json.loads(out)
    assert result["compared"][1]["coefficients"]["U0z"]["changed"]
    assert result["compared"][1]["intrinsic"]["values"]["bz"]["changed"]
    assert result["changed"] == (result["p_constant_intrinsic"] < 0.05)
    assert result["drift"]["per_year"]["U0z"]["value"] == pytest.approx(5e-4, abs=2e-4)
    assert result == json.loads((tmp_path / "h" / "compare.json").read_text())
    assert "changed" not in result["first"]
    assert (tmp_path / "h" / "compare.svg").read_text().startswith("<?xml")
    assert bench("compare", "results.json")[0] == 0


@pytest.mark.slow
def test_runs_bring_their_dates_and_their_block(bench, tmp_path):
    bench("run", "quick", "--dry-run", "--name", "q")
    status, out, _ = bench("compare", "q", "runs/q/calibrate.json", "--json", "q.json", "--strict")
    assert status == 0
    result = json.loads((tmp_path / "q.json").read_text())
    assert result["first"]["block"] == "triaxial block of the paper 1"
    told = json.loads((tmp_path / "runs" / "q" / "run.json").read_text())
    for found in (result["first"], result["compared"][0]):
        assert datetime.fromisoformat(found["made_at"]) == datetime.fromisoformat(told["created"])
    assert "not every" not in out
    assert "two of these calibrations agree within a hundredth" in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("r0.csv",), "two or more calibrations"),
        (("r0.csv", "no.json"), "no.json: no run of that name"),
        (("r0.csv", "r1.csv", "--date", "2026-01-01"), "--date: 1 given for 2 calibrations"),
        (
            ("r0.csv", "r1.csv", "--date", "soon", "--date", "later"),
            "expected a date such as 2026-01-31, got 'soon'",
        ),
        (("r0.csv", "bad.json"), "bad.json: not a result of 'bench calibrate --json'"),
    ],
)
def test_mistakes_are_one_line(bench, tmp_path, arguments, told):
    readings_files(tmp_path)
    (tmp_path / "bad.json").write_text('{"coefficients": 3}')
    status, _, err = bench("compare", *arguments)
    assert status == 2
    assert told in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_one_set_of_readings_written_and_read_again_is_recognised(bench, tmp_path):
    """Rounded to a microvolt, the same readings give the same coefficients but for a part of their u."""
    table = simulate(np.random.default_rng(5), 1e-4)
    write_csv(table, tmp_path / "a.csv")
    table.signal[:] = np.round(table.signal, 6)
    write_csv(table, tmp_path / "b.csv")
    write_csv(simulate(np.random.default_rng(6), 1e-4), tmp_path / "c.csv")
    assert "come from the same readings" in bench("compare", "a.csv", "b.csv")[1]
    assert "come from the same readings" not in bench("compare", "a.csv", "c.csv")[1]


def test_the_uncertainty_of_gravity_counts_between_places_and_cancels_in_one():
    """S and b = U0/S differ between two places by u of both g, no angle does; in one place g cancels."""
    here = replace(snapshot(TRUTH, g_m_s2=9.80), gravity_u=3e-5)
    factor = np.where(np.arange(12) < 9, 9.83 / 9.80, 1.0)
    elsewhere = replace(snapshot(TRUTH * factor, 50, g_m_s2=9.83), gravity_u=4e-5)
    later = replace(snapshot(TRUTH, 60, g_m_s2=9.80), gravity_u=3e-5)
    far, near = compare([here, elsewhere, later]).nine.changes
    of_g = nine_of("", TRUTH, COVARIANCE).values * 5e-5 * np.repeat([1, 0, 1], 3)
    assert far.u**2 - near.u**2 == pytest.approx(of_g**2, rel=2e-2, abs=2e-2 * np.max(near.u[3:] ** 2))


def test_calibrations_in_one_place_share_the_error_of_its_gravity():
    """The mean of ten calibrations in one place keeps all of u(g); in ten places, a tenth of its variance."""
    taken = [replace(snapshot(TRUTH, g_m_s2=9.81), gravity_u=5e-5) for _ in range(10)]
    spread = [replace(one, g_m_s2=9.81 + k / 1e6) for k, one in enumerate(taken)]
    mean = np.full((9, 10), 0.1)
    one, many = (joint_of([s.per(9.80665).in_nine() for s in of]).of_sums(mean) for of in (taken, spread))
    of_g = (nine_of("", TRUTH, COVARIANCE).values[0] * 5e-5 * 9.80665 / 9.81) ** 2
    assert one[0, 0] - many[0, 0] == pytest.approx(0.9 * of_g, rel=1e-3)
    by_pair = joint_covariances([s.per(9.80665).in_nine() for s in taken])
    assert np.mean(by_pair[0]) == pytest.approx(one[0, 0], rel=1e-9)
