"""Monte Carlo on the exact geometry beside the linear budget, and both beside a simulation made apart from them."""

import numpy as np
import pytest
from scipy.stats import norm

from bench.calibration import CalibrationError, gls
from bench.calibration.budget.assessment import exact_monte_carlo, exact_readings
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.budget.sources import effect_sources
from bench.calibration.design import make_problem
from bench.calibration.result import Noise
from bench.model import CATALOGUE, AppliedEffect
from tests.support.budget_bench import ONE_SIGMA, paper_setup, stand
from tests.support.paper_bench import K, simulate

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
    readings = exact_readings(budget, 12, np.random.default_rng(4))[:, setup.fitted]
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
