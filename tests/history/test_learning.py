"""Sizes of a bench from many runs of known truth; their likelihood against dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg, stats

from bench.calibration.calibrate import calibrate
from bench.calibration.result import CalibrationError
from bench.history.learning import Beliefs, at, fitted, learn, observed_information, variances_of
from bench.history.run_sums import RunSums, run_fit
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, Installation
from bench.validation.paper_bench import ARCSEC
from tests.support.learning_bench import KINDS, STATED, Bench, simulate

TURNED = {
    label: Installation.from_axes(label, axes)
    for label, axes in (
        ("1T90", ("y", "-x", "z")), ("2T90", ("-y", "z", "-x")),
        ("1T180", ("-x", "-y", "z")), ("2T180", ("x", "z", "-y")),
    )
}  # fmt: skip
MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2, **TURNED})
TRUTH = Bench(
    np.array([1.0, -1.2, 12.0, 9.0]) * ARCSEC, np.array([0.8, 1.2, 5.0, 6.0]) * ARCSEC,
    np.array([5e-5, 7e-5, 6e-5]), 2.5 * ARCSEC, np.array([3.0, -2.0, 1.5, 1.0]) * ARCSEC,
)  # fmt: skip


def fits(runs):
    return [run_fit(table.source, table, MODEL, STATED) for table in runs.tables()]


@pytest.fixture(scope="module")
def turned():
    """Seed 11: 14 runs, with quarter and half turns among them."""
    return simulate(np.random.default_rng(11), TRUTH, 14, turned=(0, 1, 2))


@pytest.fixture(scope="module")
def learned(turned):
    return learn(fits(turned), STATED)


def truth_of(name):
    kind, _, what = name.partition(".")
    if what == "mean":
        return TRUTH.means[KINDS.index(kind)] / ARCSEC
    if what == "remount":
        return TRUTH.remounts[KINDS.index(kind)] / ARCSEC
    if kind.startswith("noise"):
        return TRUTH.noise["xyz".index(kind[-2])]
    waves = dict(zip(("eccentricity.cosine", "eccentricity.sine", "ellipticity.cosine", "ellipticity.sine"),
                     TRUTH.waves / ARCSEC, strict=True))  # fmt: skip
    return {"setting_error": TRUTH.setting / ARCSEC}.get(name, waves.get(name.removeprefix("head_")))


def chance_of(size, truth):
    """Chance of a size as far off on either side: a mean by Student's t, a standard deviation by chi-square."""
    if size.name.startswith(("noise", "setting")) or size.name.endswith("remount"):
        below = stats.chi2.cdf(size.dof * (size.value / truth) ** 2, size.dof)
    else:
        below = stats.t.cdf((size.value - truth) / size.u, size.dof)
    return 2 * min(below, 1 - below)


def test_no_size_is_further_from_its_truth_than_its_u_and_dof_allow(learned):
    """Of the sizes told none is less likely than 1 % shared out among them (Bonferroni), by the dof each states.

    Fourteen runs leave the remount of the zero offset with the mounting error's: it keeps its prior. That of the
    tilt, half of what was stated and less than the setting error, has few degrees of freedom: its upper end alone.
    """
    found = [size for size in learned.sizes() if not size.name.startswith("drift")]
    assert len(found) == 4 + 4 + 4 + 4
    assert [size.name for size in found if not size.told] == ["zero_offset.remount"]
    assert [size.name for size in found if size.dof <= 4] == ["axis_tilt.remount"]
    told = [size for size in found if size.told]
    for size in told:
        assert chance_of(size, truth_of(size.name)) > 0.01 / len(told), size
    assert learned.shown_waves() == [0, 1]
    assert not learned.contradicting


@pytest.mark.slow
def test_what_installations_1_and_2_do_not_tell_keeps_its_prior():
    """Seed 12: the roll shows in neither, the zero offset only beside the mounting error."""
    found = learn(fits(simulate(np.random.default_rng(12), TRUTH, 8)), STATED)
    untold = {size.name: size for size in found.sizes() if not size.told}
    assert {"mounting_roll.mean", "mounting_roll.remount", "zero_offset.remount"} <= set(untold)
    total = found.known.covariance[3, 3] + found.known.remount["mounting_roll"] ** 2
    assert total == pytest.approx(STATED["mounting_roll"] ** 2, rel=0.01)
    assert any("no reading of these runs shows it" in sentence for sentence in found.not_identified())
    assert any("only together with mounting_error" in sentence for sentence in found.not_identified())
    assert any("absolute gain" in sentence for sentence in found.not_identified())


@pytest.mark.slow
def test_with_means_of_their_own_installations_tell_less(turned):
    """The roll of installation 1 and that of 2 are in Kyz and Kzy, and are told by the turns alone."""
    found = learn(fits(turned), STATED, by_installation=True)
    assert len(found.keys) == 4 * 6
    assert found.names[0] == "axis_tilt[1]"


@pytest.fixture(scope="module")
def without_run_4():
    """Seed 13: what ten runs but the fourth tell, and their fits."""
    others = [run for run in fits(simulate(np.random.default_rng(13), TRUTH, 10)) if run.name != "run-4"]
    return learn(others, STATED), others


def test_series_of_one_mounting_are_one_draw_of_its_angles():
    """Seed 15: three series of two passes in one mounting tell of the remount no more than its six passes."""
    whole = simulate(np.random.default_rng(15), TRUTH, 6, passes=6, turned=(1,)).tables()
    parts = [
        replace(
            table, series=(table.pass_number + 1) // 2,
            extra={"mounting_number": (1 + np.unique(table.installation, return_inverse=True)[1]).astype(str)},
        )
        for table in whole
    ]  # fmt: skip
    once, thrice = (learn([run_fit(t.source, t, MODEL, STATED) for t in of], STATED) for of in (whole, parts))
    assert thrice.keys == once.keys
    means = len(once.keys)
    u, u_parts = (np.sqrt(np.diag(one.covariance))[:means] for one in (once, thrice))
    assert u_parts == pytest.approx(u, rel=0.05)
    assert [v.size for v in thrice.variances[:2]] == pytest.approx(
        [v.size for v in once.variances[:2]], rel=0.2
    )


@pytest.mark.slow
@pytest.mark.parametrize("own", [{"K2": {3: 1.5e-4}}, {"drift": {3: 1.2e-3}}])
def test_what_one_block_has_is_named_and_not_charged_to_the_bench(own, without_run_4):
    """Run 4 alone has K2, or a bias that runs away."""
    without, others = without_run_4
    odd = fits(simulate(np.random.default_rng(13), TRUTH, 4, **own))[3]
    with_it = learn([*others[:3], odd, *others[3:]], STATED)
    assert [one.run for one in with_it.contradicting] == ["run-4"]
    assert "run-4" not in with_it.runs
    for one, other in zip(with_it.sizes(), without.sizes(), strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-3, abs=1e-7)


@pytest.mark.slow
def test_a_run_on_another_stand_contradicts_by_its_angles():
    """Seed 14: run 1 has its block mounted 5 arcmin off."""
    off = replace(TRUTH, means=TRUTH.means + np.array([0, 0, 300, 0]) * ARCSEC)
    one = fits(simulate(np.random.default_rng(14), off, 1))
    rest = fits(simulate(np.random.default_rng(15), TRUTH, 10))[1:]
    found = learn([*one, *rest], STATED)
    assert [c.run for c in found.contradicting] == ["run-1"]
    assert found.contradicting[0].what == "its angles of the stand"


def test_the_next_calibration_takes_it_and_its_u_is_smaller(turned, learned):
    """Seed 16, one run more: u of Kyz, most of it the roll's, falls to a third at most, and holds the truth."""
    new = simulate(np.random.default_rng(16), TRUTH, 1)
    (table,) = new.tables()
    stated_u = {name: u for name, u in STATED.items() if name != "mounting_roll"}
    roll = {"mounting_roll": STATED["mounting_roll"]}
    before = calibrate(table, MODEL, stated_u, 9.81, assumed_u=roll, find_shared=False)
    after = calibrate(table, MODEL, stated_u, 9.81, assumed_u=roll, find_shared=False, known=learned.known)
    assert np.all(after.u < 1.2 * before.u)  # the noise of all runs in place of that of this one
    assert after.u[5] < before.u[5] / 3
    z = (after.block.vector - new.truths[0]) / after.u
    assert np.max(np.abs(z)) < 4
    assert after.stand["alpha5[1]"].value == pytest.approx(9.0, abs=4 * 7)
    # the learned roll is no assumption any more: it stands in what the readings and the stand show
    np.testing.assert_allclose(after.covariance_readings, after.covariance)


def test_too_few_runs_and_repeats_are_refused(turned):
    runs = fits(turned)
    with pytest.raises(CalibrationError, match="1 run cannot show"):
        learn(runs[:1], STATED)
    alone = fits(simulate(np.random.default_rng(17), TRUTH, 2, passes=1))
    with pytest.raises(CalibrationError, match="too few repeats"):
        learn(alone, STATED)


def drawn(seed, runs=6, repeats=4, columns=3, waves=2):
    """Runs y = X b + B t + H h + noise of unit size, two own coefficients each: dense arrays, and their sums."""
    rng = np.random.default_rng(seed)
    parts, grams = [], []
    for _ in range(runs):
        n = 8 * repeats
        X, B, H = rng.normal(size=(n, 2)), rng.normal(size=(n, columns)), rng.normal(size=(n, waves))
        t = np.array([0.7, -0.4, 0.2])[:columns] + rng.normal(size=columns) * np.sqrt(
            [0.5, 0.5, 2.0][:columns]
        )
        y = X @ rng.normal(size=2) + B @ t + H @ np.full(waves, 0.3) + rng.normal(size=n)
        q, _ = np.linalg.qr(X)
        W = np.column_stack([B, H, y])
        W = W - q @ (q.T @ W)
        parts.append((X, B, H, y))
        grams.append(W.T @ W)
    random, mean = np.array([[0, 0, 1]] * runs)[:, :columns], np.array([[0, 1, 1]] * runs)[:, :columns]
    names = tuple(f"run {r}" for r in range(runs))
    return parts, RunSums(names, np.array(grams), random, mean, waves, np.zeros(runs), np.ones(runs))


def dense(parts, theta, precision):
    """-2 ln L of all readings at once, and the means: y normal about X b + (B, H) m, b free, m with its prior."""
    y = np.concatenate([part[3] for part in parts])
    X = linalg.block_diag(*[part[0] for part in parts])
    F = np.concatenate([np.column_stack([B[:, 0], B[:, 1] + B[:, 2], H]) for _, B, H, _ in parts])
    V = linalg.block_diag(
        *[np.eye(len(B)) + (B * np.array([theta[0], theta[0], theta[1]])) @ B.T for _, B, _, _ in parts]
    )
    whole = np.column_stack([X, F])
    inverse = np.linalg.inv(V)
    normal = whole.T @ inverse @ whole
    places = X.shape[1] + np.arange(2)
    normal[places, places] += precision
    found = np.linalg.solve(normal, whole.T @ inverse @ y)
    value = np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1]
    value += y @ inverse @ y - found @ (whole.T @ inverse @ y)
    return value, found[X.shape[1] :], np.linalg.inv(normal)[X.shape[1] :, X.shape[1] :]


def free(precision, variances=2):
    return Beliefs(np.asarray(precision, float), *np.full((2, variances), np.nan))


def test_the_sums_of_runs_give_the_likelihood_of_all_their_readings():
    """Seed 1. Up to a constant; means and their covariance to the digits of doubles."""
    parts, body = drawn(1)
    precision = np.array([0.8, 1.3])
    one, two = np.array([0.4, 1.5]), np.array([1.2, 0.3])
    for theta in (one, two):
        _, means, covariance = dense(parts, theta, precision)
        here = at(body, theta, free(precision))
        np.testing.assert_allclose(here.means, means, rtol=1e-9)
        np.testing.assert_allclose(here.covariance, covariance, rtol=1e-8, atol=1e-12)
    expected = dense(parts, one, precision)[0] - dense(parts, two, precision)[0]
    found = at(body, one, free(precision)).minus_two_log - at(body, two, free(precision)).minus_two_log
    assert found == pytest.approx(expected, abs=1e-8)


def test_the_score_is_the_slope_of_the_likelihood_also_where_a_variance_keeps_its_prior():
    _, body = drawn(2)
    beliefs = Beliefs(np.array([1.0, 1.0]), np.array([np.nan, 0.5]), np.array([np.nan, 0.29]))
    theta, step = np.array([0.6, 0.9]), 1e-5
    for j in range(2):
        up, down = theta.copy(), theta.copy()
        up[j], down[j] = theta[j] + step, theta[j] - step
        slope = at(body, up, beliefs).minus_two_log - at(body, down, beliefs).minus_two_log
        assert at(body, theta, beliefs).score[j] == pytest.approx(-slope / (4 * step), rel=1e-5)


def test_at_the_greatest_likelihood_nothing_is_left_to_gain():
    _, body = drawn(3, runs=12)
    theta = fitted(body, free([1.0, 1.0]))
    best = at(body, theta, free([1.0, 1.0])).minus_two_log
    for factor in (0.97, 1.03):
        for j in range(2):
            moved = theta.copy()
            moved[j] *= factor
            assert at(body, moved, free([1.0, 1.0])).minus_two_log > best


def test_a_balanced_design_is_that_of_statsmodels():
    """One way, seed 4, 12 runs of 5 readings: mean, variance between runs, observed information."""
    rng = np.random.default_rng(4)
    runs, repeats = 12, 5
    y = 3.0 + 0.8 * rng.normal(size=(runs, 1)) + rng.normal(size=(runs, repeats))
    import pandas as pd  # in the one worker that has this test
    from statsmodels.regression.mixed_linear_model import MixedLM

    told = pd.DataFrame({"y": y.ravel(), "one": 1.0, "run": np.repeat(np.arange(runs), repeats)})
    judge = MixedLM(told["y"], told[["one"]], groups=told["run"]).fit(reml=True)
    W = [np.column_stack([np.ones(repeats), own]) / np.sqrt(judge.scale) for own in y]
    zeros = np.zeros((runs, 1), dtype=np.int64)
    body = RunSums(
        tuple("abcdefghijkl"), np.array([w.T @ w for w in W]), zeros, zeros, 0, np.zeros(runs), np.ones(runs)
    )
    theta = fitted(body, free([1e-12], 1))
    there = at(body, theta, free([1e-12], 1))
    between = float(judge.cov_re.iloc[0, 0])
    assert theta[0] == pytest.approx(between, rel=1e-3)
    assert there.means[0] == pytest.approx(judge.fe_params.iloc[0], rel=1e-6)
    assert np.sqrt(there.covariance[0, 0]) == pytest.approx(judge.bse_fe.iloc[0], rel=1e-3)
    # closed form of the balanced case: var(t) = 2 (t + s/n)^2/(runs - 1) for a known noise
    closed = 2 * (theta[0] + judge.scale / repeats) ** 2 / (runs - 1)
    information = observed_information(body, theta, free([1e-12], 1))
    assert 1 / information[0, 0] == pytest.approx(closed, rel=2e-2)


def test_a_run_without_unknown_angles_of_the_stand_has_no_columns_for_them():
    table = simulate(np.random.default_rng(17), TRUTH, 1).tables()[0]
    found = run_fit("exact", table, MODEL, {})
    assert found.stand.shape[2] == len(found.angles) == 0


def test_a_likelihood_without_a_peak_gives_the_variances_a_real_u():
    """The observed information was indefinite in 1 of 120 pairs of runs, and the learned file had NaN."""
    saddle, expected = np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([[4.0, 1.0], [1.0, 2.0]])
    spread = variances_of(np.array([0.1, 0.2]), saddle, expected)
    assert spread == pytest.approx(np.linalg.inv(expected))
    peak = np.array([[3.0, 1.0], [1.0, 3.0]])
    assert variances_of(np.array([0.1, 0.2]), peak, expected) == pytest.approx(np.linalg.inv(peak))
