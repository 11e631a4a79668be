"""A budget with learned sizes: of the same assumption as a calibration that takes them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import gls
from bench.calibration.budget.assessment import exact_readings
from bench.calibration.budget.coefficients import make_budget, make_setup
from bench.calibration.budget.error_source import MEANS as SHARED
from bench.calibration.budget.sources import assumed_stand, bench_sources
from bench.calibration.design import make_problem
from bench.calibration.noise import KnownNoise, KnownStand
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_procedure
from tests.support.learned_file import CORRELATION, KINDS, MEANS, REMOUNT, SHIPPED, U

BENCH = load_bench(SHIPPED)
NOISE = KnownNoise(np.array([3e-5, 4e-5, 5e-5]), np.full(3, 80.0), 7e-6, 40.0)
KNOWN = KnownStand(
    tuple((kind, "") for kind in KINDS), MEANS, CORRELATION * np.outer(U, U),
    dict(zip(KINDS, REMOUNT.tolist(), strict=True)), NOISE,
)  # fmt: skip
BY_INSTALLATION = KnownStand(
    (("mounting_error", "1"), ("mounting_error", "2"), ("mounting_roll", "1")),
    MEANS[1:], KNOWN.covariance[1:, 1:], KNOWN.remount, None,
)  # fmt: skip


@pytest.fixture(scope="module")
def setup():
    return make_setup(load_procedure(find_procedure("paper")).expand(), BENCH)


def budget_of(setup, known):
    return make_budget(setup, bench_sources(BENCH, setup, known=known), known=known)


@pytest.mark.parametrize("known", [KNOWN, replace(KNOWN, noise=None), BY_INSTALLATION])
def test_its_u_is_that_of_a_fit_with_what_is_known(setup, known):
    """The posterior covariance of the fit that `bench calibrate` makes, its noise being the learned."""
    stated = {name: d.u for name, d in BENCH.stand_distributions().items()}
    sizes = stated | {name: d.u for name, d in assumed_stand(BENCH).items()}
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), sizes, known=known)
    noise = NOISE.given()
    if known.noise is None:
        noise = replace(
            noise, channels=None, reading=stated["voltmeter_error"], setting_rad=stated["setting_error"]
        )
    own = problem.predict(setup.block, problem.prior_mean)
    fit = gls.fit(problem, own, setup.block, noise)
    found = budget_of(setup, known).of_group("stand").covariance
    u = np.sqrt(np.diag(fit.covariance)[:12])
    np.testing.assert_allclose(found / np.outer(u, u), fit.covariance[:12, :12] / np.outer(u, u), atol=2e-3)


def test_it_is_smaller_than_by_the_limits_and_says_where_it_is_from(setup):
    limits, learned = budget_of(setup, None), budget_of(setup, KNOWN)
    assert np.all(learned.combined.u <= limits.combined.u)
    assert learned.of_group("stand").u[5] < limits.of_group("stand").u[5] / 3  # Kyz: the roll
    origins = {c.source.name: c.source.origin for c in learned.contributions}
    assert origins[SHARED] == "learned of the bench: means of all mountings"
    assert origins["mounting_error"] == "learned of the bench: what a remount adds"
    assert origins["voltmeter_error[y]"] == origins["setting_error"] == "learned of the bench"
    assert "voltmeter_error" not in origins


def test_monte_carlo_draws_what_hangs_together_so(setup):
    """Seed 3, 1,500 trials: variances within five standard errors of the linear ones."""
    budget = budget_of(setup, KNOWN)
    stand = replace(budget, contributions=tuple(c for c in budget.contributions if c.source.group == "stand"))
    drawn = exact_readings(stand, 1500, np.random.default_rng(3)) - setup.signal
    spread = np.einsum("pni,tni->tp", budget.gain, drawn).std(axis=0)
    np.testing.assert_allclose(spread, stand.combined.u, rtol=5 / np.sqrt(2 * 1500))
