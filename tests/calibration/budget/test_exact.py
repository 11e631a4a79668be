"""Budgets against simulations that use nothing of the model, against GTC, and with meters that err alike."""

import GTC
import numpy as np
import pytest
from scipy.stats import norm

from bench.calibration import CalibrationError, gls
from bench.calibration.budget.assessment import Simulation, exact_monte_carlo, measured
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.budget.meters import LearnedDifferences, joint_errors
from bench.calibration.budget.sources import effect_sources
from bench.calibration.design import make_problem
from bench.calibration.result import Noise
from bench.model import CATALOGUE, AppliedEffect
from bench.validation.paper_bench import U0, K, simulate
from tests.support.budget_bench import ONE_SIGMA, paper_setup, stand

TRIALS = 10_000
LIKE_FOUR_SIGMA = 4 / np.sqrt(2 * TRIALS)
"""A standard deviation from so many trials: four standard errors, 3 %."""


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["closed-form", "gls"])
def test_agrees_with_the_linear_budget(estimator):
    found = exact_monte_carlo(make_budget(paper_setup(), stand(), estimator), TRIALS, seed=1)
    assert found.names[-4:] == ("Δg 45°", "Δg 135°", "Δg 225°", "Δg 315°")
    np.testing.assert_allclose(found.verdict.ratio, 1.0, atol=LIKE_FOUR_SIGMA)
    assert found.verdict.validated.all()
    linear, exact = found.linear.correlation[:12, :12], found.trials.covariance[:12, :12]
    u = found.trials.u[:12]
    np.testing.assert_allclose(exact / np.outer(u, u), linear, atol=4 / np.sqrt(TRIALS))


def test_where_linear_propagation_fails_the_verdict_says_so():
    """A mounting error of ten degrees is of second order in Kxx: cos(alpha3) takes off what no slope shows."""
    sources = stand({"mounting_error": np.radians(10.0), "voltmeter_error": 1e-6})
    found = exact_monte_carlo(make_budget(paper_setup(), sources, "closed-form"), 4000, seed=2)
    kxx, u0x = found.names.index("Kxx"), found.names.index("U0x")
    assert not found.verdict.validated[kxx]
    assert found.verdict.validated[u0x]
    # E cos(alpha) = exp(-s^2/2) for a normal angle, in both installations
    expected = K[0, 0] * np.exp(-(np.radians(10.0) ** 2) / 2)
    assert found.trials.mean[kxx] == pytest.approx(expected, abs=4 * found.trials.u[kxx] / np.sqrt(4000))


@pytest.mark.slow
def test_against_a_simulation_that_uses_nothing_of_the_model():
    """1200 runs of the tests' own bench through the closed form's gain: spread within four standard errors."""
    setup = paper_setup()
    budget = make_budget(setup, stand(), "closed-form")
    rng, runs = np.random.default_rng(3), 1200
    sizes = {name: ONE_SIGMA[name] for name in ("axis_tilt", "zero_offset", "mounting_error")}
    gain = budget.gain[:, setup.fitted]
    setting = ONE_SIGMA["setting_error"]
    signals = [simulate(rng, 3e-4, stand_u=sizes, setting_u_rad=setting).signal for _ in range(runs)]
    found = np.einsum("pni,rni->rp", gain, np.stack(signals))
    ratio = found.std(axis=0, ddof=1) / budget.combined.u
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * runs))


def test_the_gls_map_is_the_fit():
    """Readings with every error through the iterated fit: off the budget's linear map by less than 2 % of u."""
    setup = paper_setup()
    budget = make_budget(setup, stand(), "gls")
    readings = Simulation(budget).readings(12, np.random.default_rng(4))[:, setup.fitted]
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), ONE_SIGMA)
    noise = Noise(ONE_SIGMA["voltmeter_error"], ONE_SIGMA["setting_error"], np.inf, "given")
    gain = budget.gain[:, setup.fitted]
    for reading in readings:
        fitted = gls.fit(problem, reading, setup.block, noise).block.vector
        mapped = setup.block.vector + np.einsum("pni,ni->p", gain, reading - setup.signal[setup.fitted])
        assert np.max(np.abs(fitted - mapped) / budget.combined.u) < 0.02


def test_rectangular_sources_keep_their_u_and_lose_their_tails():
    """One rectangular source alone: the 95.45 % interval is shorter than 2u, by 0.9545 sqrt(3)/2."""
    source = stand({"axis_tilt": 1e-5})[0]
    rectangular = type(source)(
        **{**vars(source), "distribution": type(source.distribution)(1e-5, "rectangular")}
    )
    budget = make_budget(paper_setup(), [rectangular], "closed-form", stated=ONE_SIGMA)
    found = exact_monte_carlo(budget, 8000, seed=5)
    kij = found.names.index("U0y")
    # two installations, each with a rectangle that weighs Kyy/2 or so: a triangle, shorter in the tails
    reach = found.trials.symmetric[kij, 1] - found.linear.value[kij]
    assert reach < norm.ppf(0.97725) * found.linear.u[kij]
    assert found.verdict.ratio[kij] == pytest.approx(1.0, abs=4 / np.sqrt(2 * 8000))


def test_too_few_trials_are_refused():
    with pytest.raises(CalibrationError, match="trials are too few"):
        exact_monte_carlo(make_budget(paper_setup(), stand()), 100)


def test_the_same_seed_gives_the_same_result():
    budget = make_budget(paper_setup(), stand())
    first, second = (exact_monte_carlo(budget, 3000, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.trials.covariance, second.trials.covariance)
    np.testing.assert_array_equal(first.trials.symmetric, second.trials.symmetric)


@pytest.mark.parametrize("with_effect", [False, True])
def test_the_budget_of_gls_is_the_covariance_of_its_fit(with_effect):
    """What the sources put through the gain is what the fit states a posteriori, an effect's prior included."""
    u = {"K2": np.array([4e-6, 0.0, 0.0])}
    effect = AppliedEffect(CATALOGUE["quadratic_nonlinearity"], {"K2": np.array([6e-5, 0.0, 0.0])}, ("x",), u)
    setup = paper_setup(effects=[effect] if with_effect else [])
    budget = make_budget(setup, [*stand(), *effect_sources(setup)], "gls")
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), ONE_SIGMA)
    noise = Noise(ONE_SIGMA["voltmeter_error"], ONE_SIGMA["setting_error"], np.inf, "given")
    fitted = gls.fit(problem, setup.signal[setup.fitted], setup.block, noise)
    size = np.outer(budget.combined.u, budget.combined.u)
    np.testing.assert_allclose(
        budget.combined.covariance / size, fitted.covariance[:12, :12] / size, atol=1e-6
    )


PASSES = 3


def turned(phi, tilt, yaw):
    """Upward unit vector on the platform: tilted, turned about y, turned about z."""
    x, y, z = GTC.sin(phi) * GTC.cos(tilt), GTC.sin(tilt), GTC.cos(phi) * GTC.cos(tilt)
    return GTC.cos(yaw) * x + GTC.sin(yaw) * y, GTC.cos(yaw) * y - GTC.sin(yaw) * x, z


def simulated(u):
    """Uncertain signals [installation][channel][point], the mean of the passes."""
    signals = []
    for installation in (1, 2):
        tilt, offset, yaw = (GTC.ureal(0.0, u[n]) for n in ("axis_tilt", "zero_offset", "mounting_error"))
        rows = [[0.0] * 9 for _ in range(3)]
        for point in range(9):
            for _ in range(PASSES):
                phi = point * np.pi / 4 + offset + GTC.ureal(0.0, u["setting_error"])
                x, y, z = turned(phi, tilt, yaw)
                force = (x, y, z) if installation == 1 else (-x, z, y)
                for i in range(3):
                    reading = sum(float(K[i, j]) * force[j] for j in range(3)) + float(U0[i])
                    rows[i][point] += (reading + GTC.ureal(0.0, u["voltmeter_error"])) / PASSES
        signals.append(rows)
    return signals


def paper_estimate(U1, U2):
    """(7)-(8) as printed, in the order of the coefficients."""
    root = float(np.sqrt(2.0))

    def sine(u):
        return (u[2] - u[6] + u[1] + u[3] - u[5] - u[7]) / (2 * (1 + root))

    def cosine(u):
        return (u[0] + u[8] - 2 * u[4] + root * (u[1] + u[7] - u[3] - u[5])) / 8

    def across(u):
        return (u[0] + u[8] - 2 * u[4]) / 4

    def level(u):
        return (u[0] + u[8] + 2 * u[4]) / 4

    x, y, z = 0, 1, 2
    return [
        (sine(U1[x]) - sine(U2[x])) / 2, across(U2[x]), across(U1[x]),
        ((U1[y][2] - U1[y][6]) / 2 + (U2[y][6] - U2[y][2]) / 2) / 2, cosine(U2[y]), across(U1[y]),
        ((U1[z][2] - U1[z][6]) / 2 + (U2[z][6] - U2[z][2]) / 2) / 2, across(U2[z]), cosine(U1[z]),
        (level(U1[x]) + level(U2[x])) / 2,
        (sum(U1[y][:8]) / 8 + (U2[y][2] + U2[y][6]) / 2) / 2,
        ((U1[z][2] + U1[z][6]) / 2 + sum(U2[z][:8]) / 8) / 2,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def theirs():
    return paper_estimate(*simulated(ONE_SIGMA))


@pytest.fixture(scope="module")
def ours():
    return make_budget(paper_setup(), stand(), "closed-form")


def test_standard_uncertainties_agree(theirs, ours):
    np.testing.assert_allclose(ours.combined.u, [GTC.uncertainty(one) for one in theirs], rtol=1e-6)
    np.testing.assert_allclose(ours.combined.value, [GTC.value(one) for one in theirs], atol=1e-12)


def test_correlations_agree(theirs, ours):
    matrix = [[GTC.get_correlation(a, b) for b in theirs] for a in theirs]
    np.testing.assert_allclose(ours.combined.correlation, matrix, atol=1e-6)
    assert np.max(np.abs(np.array(matrix) - np.eye(12))) > 0.2


@pytest.mark.parametrize("force", [(0.6, -0.2, 0.77), (3.0, 0.0, -4.0)])
def test_a_measured_acceleration_agrees(theirs, ours, force):
    """a = N (U - U0) and |a| from one more reading, in GTC's arithmetic (Cramer's rule)."""
    signal = K @ np.array(force) + U0
    u = [
        GTC.ureal(float(s), ONE_SIGMA["voltmeter_error"]) - b for s, b in zip(signal, theirs[9:], strict=True)
    ]
    k = [theirs[0:3], theirs[3:6], theirs[6:9]]
    whole = det3(k)
    a = [det3([[u[i] if j == c else k[i][j] for j in range(3)] for i in range(3)]) / whole for c in range(3)]
    modulus = GTC.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    found = measured(ours, np.array([force]))
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance[0])), [GTC.uncertainty(one) for one in a], rtol=1e-6
    )
    assert found.u_modulus[0] == pytest.approx(GTC.uncertainty(modulus), rel=1e-6)


def det3(m):
    return (
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    )


PRIOR = np.array([20e-6, 20e-6, 20e-6])
NONE = np.zeros(3, dtype=bool)
VALUES = np.array([10e-6, -4e-6, -6e-6])


def told(u=1e-6, group=(0, 0, 0), values=VALUES):
    centred = np.eye(3) - np.ones((3, 3)) / 3
    return LearnedDifferences(values, u**2 * centred, group)


def of_difference(covariance, a, b):
    return np.sqrt(covariance[a, a] + covariance[b, b] - 2 * covariance[a, b])


def test_every_meter_stays_as_uncertain_as_it_was_and_their_difference_is_the_learned():
    found = joint_errors(told(), [0, 1, 2], PRIOR, NONE, 1.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), PRIOR)
    assert of_difference(found.covariance, 0, 1) == pytest.approx(np.sqrt(2) * 1e-6, rel=0.01)
    assert found.mean[0] - found.mean[1] == pytest.approx(14e-6, rel=0.01)
    assert found.mean.sum() == pytest.approx(0.0, abs=1e-12)
    root = found.u * np.array(found.root)
    np.testing.assert_allclose(root @ root.T, found.covariance, rtol=1e-9, atol=1e-20)


def test_differences_hardly_known_leave_the_limits_as_they_were():
    found = joint_errors(told(u=1e-3), [0, 1, 2], PRIOR, NONE, 1.0)
    np.testing.assert_allclose(found.covariance, np.diag(PRIOR**2), atol=1e-3 * PRIOR[0] ** 2)
    np.testing.assert_allclose(found.mean, 0.0, atol=1e-8)


def test_they_age():
    fresh, old = (joint_errors(told(), [0, 1, 2], PRIOR, NONE, kept) for kept in (1.0, 0.5))
    assert of_difference(old.covariance, 0, 1) > 10 * of_difference(fresh.covariance, 0, 1)
    assert of_difference(old.covariance, 0, 1) < np.sqrt(2) * PRIOR[0]
    np.testing.assert_allclose(np.sqrt(np.diag(old.covariance)), PRIOR)


def test_a_certificate_is_never_touched_and_the_others_follow_it():
    prior = np.array([3e-6, 20e-6, 20e-6])
    found = joint_errors(told(), [0, 1, 2], prior, np.array([True, False, False]), 1.0)
    assert found.mean[0] == 0.0
    assert found.covariance[0, 0] == pytest.approx(prior[0] ** 2)
    assert found.mean[1] == pytest.approx(-14e-6, rel=0.02)
    assert np.sqrt(found.covariance[1, 1]) == pytest.approx(np.hypot(3e-6, np.sqrt(2) * 1e-6), rel=0.02)
    everyone = joint_errors(told(), [0, 1, 2], prior, ~NONE, 1.0)
    assert everyone == "certificates cover all of it"


def test_no_covariance_is_negative_and_no_difference_surer_than_by_bayes():
    """Seed 9: any sizes, groups and certificates: the plain conditional covariance is never undercut."""
    rng = np.random.default_rng(9)
    tried = 0
    for _ in range(200):
        prior = rng.uniform(2e-6, 3e-5, 3)
        certified = rng.random(3) < 0.3
        group = ((0, 0, 0), (0, 0, 1))[int(rng.integers(2))]
        apart = np.array([[a == b for b in group] for a in group])
        centre = np.eye(3) - apart / apart.sum(axis=0)
        spread = centre @ np.diag(rng.uniform(1e-7, 2e-5, 3) ** 2) @ centre
        found = joint_errors(LearnedDifferences(np.zeros(3), spread, group), [0, 1, 2], prior, certified, 1.0)
        if isinstance(found, str):
            continue
        tried += 1
        C = found.covariance
        assert np.min(np.linalg.eigvalsh(C)) > -1e-18
        assert np.all(np.diag(C) <= prior**2 * (1 + 1e-6))
        size, axes = np.linalg.eigh(centre)
        Q = axes[:, size > 0.5]
        P = np.diag(prior**2)
        bayes = P - P @ Q @ np.linalg.inv(Q.T @ P @ Q + Q.T @ spread @ Q) @ Q.T @ P
        for a, b in ((0, 1), (0, 2), (1, 2)):
            assert of_difference(C, a, b) > of_difference(bayes, a, b) * (1 - 1e-6)
    assert tried > 100


def test_limits_that_are_contradicted_are_told():
    said = joint_errors(told(values=20 * VALUES), [0, 1, 2], PRIOR, NONE, 1.0)
    assert "contradict certificates or makers' limits" in said
    assert joint_errors(told(), [0, None, None], PRIOR, NONE, 1.0) == "no two of these meters were compared"
