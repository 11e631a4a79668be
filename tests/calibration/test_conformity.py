"""Conformity with a tolerance, against published examples, closed forms of scipy and simulation."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from bench.calibration import CalibrationError, conformity
from bench.calibration.conformity import (
    GUARDED,
    NON_BINARY,
    RULES,
    SIMPLE,
    DecisionRule,
    MeasuredValues,
    Population,
    Statement,
    global_risk,
    global_risk_together,
    probability_all_accepted,
    probability_one_outside,
    probability_outside,
)
from bench.run.events import DEFAULT_RULE
from benchmarks.verdict_risk import within_chance

VALUES = np.linspace(-5.0, 5.0, 41)


# --- one quantity -----------------------------------------------------------------------------------


def test_the_oil_of_jcgm_106():
    """JCGM 106:2012, 7.4, example: viscosity 13.6 within 12.5 to 16.3 mm²/s, u = 1.8 mm²/s: p = 0.66."""
    middle, half = (12.5 + 16.3) / 2, (16.3 - 12.5) / 2
    assert 1 - float(probability_outside(13.6 - middle, 1.8, half)) == pytest.approx(0.66, abs=0.005)


def test_the_diode_of_jcgm_106():
    """JCGM 106:2012, 7.3, example: one limit, 0.07 V = 1.4 u away: p = 0.92; the other limit is far away."""
    far = 100.0
    assert 1 - float(probability_outside(far - 0.07, 0.05, far)) == pytest.approx(0.92, abs=0.005)


@pytest.mark.parametrize("dof", [np.inf, 50.0, 7.0, 3.0])
def test_the_probability_is_what_the_distribution_leaves_outside(dof):
    posterior = stats.norm(VALUES, 0.7) if np.isinf(dof) else stats.t(dof, VALUES, 0.7)
    expected = posterior.sf(2.0) + posterior.cdf(-2.0)
    np.testing.assert_allclose(probability_outside(VALUES, 0.7, 2.0, dof), expected, rtol=1e-9)


def test_a_value_that_is_certain_is_in_or_out():
    np.testing.assert_array_equal(probability_outside([1.9, -2.0, 2.1], 0.0, 2.0), [0, 0, 1])


# --- rules and statements ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "band", "value", "accepted", "statement"),
    [
        (SIMPLE, None, 0.69, True, "pass"),
        (SIMPLE, None, 0.99, True, "conditional pass"),
        (SIMPLE, None, 1.01, False, "conditional fail"),
        (SIMPLE, None, 1.31, False, "fail"),
        (GUARDED, None, 0.69, True, "pass"),
        (GUARDED, None, 0.71, False, "conditional pass"),
        (GUARDED, 0.5, 0.84, True, "pass"),
        (GUARDED, 0.5, 0.86, False, "conditional pass"),
        (GUARDED, 0.5, 1.16, False, "fail"),
        (GUARDED, 3.0, 0.11, False, "conditional pass"),
        (NON_BINARY, None, 0.69, True, "pass"),
        (NON_BINARY, None, -0.71, False, "conditional pass"),
        (NON_BINARY, None, -1.29, False, "conditional fail"),
        (NON_BINARY, None, float("nan"), False, "fail"),
    ],
)
def test_what_a_rule_accepts_and_states(name, band, value, accepted, statement):
    """Limit 1, U = 0.3 (ILAC-G8:09/2019, 4.2): guard bands of U, and of other parts of it."""
    rule = DecisionRule.of(name, band)
    known = MeasuredValues.of(0.15)
    assert bool(abs(value) <= rule.acceptance_limit(1.0, known)) is accepted
    assert rule.statements(np.array([value]), 1.0, known) == [statement]


@pytest.mark.parametrize("name", [*RULES, None])
def test_beyond_the_limit_u_allows_no_statement_but_a_failure(name):
    rule = DecisionRule.of(name)
    known = MeasuredValues.of(np.full(VALUES.shape, 0.505))
    for value, statement in zip(VALUES, rule.statements(VALUES, 1.0, known), strict=True):
        assert statement is (Statement.FAIL if abs(value) > 2.01 else Statement.INCONCLUSIVE)
    assert np.all(rule.acceptance_limit(1.0, known) < 0.0)
    unknown = MeasuredValues.of(float("nan"))
    assert rule.statements(np.zeros(1), 1.0, unknown) == [Statement.INCONCLUSIVE]
    assert np.isnan(rule.acceptance_limit(1.0, unknown))


@pytest.mark.parametrize(
    ("band", "risk"), [(3.0, 1e-6), (1.5, 0.0016), (1.0, 0.025), (0.83, 0.05), (0.0, 0.50)]
)
def test_risks_of_guard_bands_are_those_of_ilac_g8(band, risk):
    """ILAC-G8:09/2019, table 1: the largest specific risk of a value accepted with w = r U, k = 2."""
    u = 0.1
    at = DecisionRule.of(GUARDED if band else SIMPLE, band or None).acceptance_limit(
        1.0, MeasuredValues.of(u)
    )
    worst = probability_outside(at, u, 1.0).item()
    assert 0.8 * risk < worst <= risk or band == 3.0
    assert worst <= risk


@pytest.mark.parametrize("dof", [np.inf, 30.0, 5.0])
@pytest.mark.parametrize("ratio", [1.0, 1.05, 1.5, 4.0])
def test_without_a_rule_it_is_accepted_up_to_five_per_cent(dof, ratio):
    """JCGM 106:2012, 8.3.2: the guard band is where a twentieth of the distribution lies outside."""
    factor = (stats.t(dof) if np.isfinite(dof) else stats.norm).ppf(stats.norm.cdf(2.0))
    known = MeasuredValues(np.array([0.1]), np.array([0.1 * factor]), np.array([dof]))
    limit = ratio * known.expanded.item()
    rule = DecisionRule.of(None)
    at = rule.acceptance_limit(limit, known).item()
    distribution = stats.t(dof, at, 0.1) if np.isfinite(dof) else stats.norm(at, 0.1)
    assert distribution.sf(limit) + distribution.cdf(-limit) == pytest.approx(0.05, abs=1e-9)
    one_sided = limit - 0.1 * (stats.t(dof) if np.isfinite(dof) else stats.norm).ppf(0.95)
    assert 0 < at <= one_sided
    assert ratio < 4 or at == pytest.approx(one_sided, rel=1e-4)
    beyond = limit + 1.01 * (limit - one_sided)
    stated = [rule.statements(np.array([y]), limit, known)[0] for y in (at, at + 1e-6, -limit - 1e-6, beyond)]
    assert stated == ["pass", "conditional pass", "conditional fail", "fail"]
    assert [rule.rejects(Statement(one)) for one in stated[1:]] == [False, True, True]


def test_a_guard_band_without_a_name_is_that_of_the_non_binary_rule():
    assert DecisionRule.of(None, 0.5) == DecisionRule(NON_BINARY, 0.5)
    assert DecisionRule.of("non-binary") == DecisionRule(NON_BINARY, 1.0)
    for rule in (DecisionRule.of(None), DecisionRule.of(None, 0.5), DecisionRule.of(SIMPLE)):
        assert DecisionRule.of_json(rule.to_json()) == rule
    assert DecisionRule.of(None).to_json()["guard_band"] == pytest.approx(stats.norm.ppf(0.95) / 2)
    assert DecisionRule.of_json(DEFAULT_RULE) == DecisionRule.of(None)


def test_a_rule_that_is_none_is_refused():
    assert DecisionRule.of("simple").name == SIMPLE
    assert DecisionRule.of("guarded", 0.83).words == "guarded (w = 0.83 U)"
    with pytest.raises(
        CalibrationError, match="unknown decision rule 'kind'; choose from simple acceptance, guarded"
    ):
        DecisionRule.of("kind")
    with pytest.raises(CalibrationError, match="simple acceptance has no guard band"):
        DecisionRule.of("simple", 0.5)
    for band in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(CalibrationError, match=r"give a positive number, such as 0\.83"):
            DecisionRule.of("guarded", band)


# --- several together -------------------------------------------------------------------------------


def correlated(size, common):
    """A covariance with `common` as the part that all share in different measure."""
    slopes = np.random.default_rng(size).normal(size=(size, 3))
    return common * slopes @ slopes.T + np.diag(np.linspace(0.5, 1.5, size))


@pytest.mark.parametrize(("limit", "common"), [(2.5, 0.5), (4.5, 0.3), (3.0, 0.0)])
def test_the_probability_of_all_together_is_the_multivariate_one(limit, common):
    """Against the integral of Genz in scipy: five standard deviations of 100,000 draws, and 1e-4 of its own."""
    covariance, value = correlated(4, common), np.array([0.3, -0.8, 1.0, 0.1])
    high, low = limit - value, -limit - value
    inside = stats.multivariate_normal.cdf(high, cov=covariance, lower_limit=low, rng=1)
    found = probability_one_outside(value, covariance, limit)
    assert found == pytest.approx(1 - inside, abs=1e-4 + 5 * np.sqrt(inside * (1 - inside) / 1e5))
    assert found == probability_one_outside(value, covariance, limit)


def test_the_two_digits_of_a_small_risk_of_several_points_are_right():
    """Δg at the four points of a run, in µg: 100,000 plain draws of the same seed give 0.0089, not 0.0092."""
    value = np.array([49.30, -55.58, 68.96, 28.16])
    signs, u = np.array([1.0, -1.0, 1.0, -1.0]), np.array([88.21, 88.61, 88.49, 88.20])
    covariance = np.outer(signs * u, signs * u) * (0.68 + 0.32 * np.eye(4))
    inside = stats.multivariate_normal.cdf(
        300 - value, cov=covariance, lower_limit=-300 - value, rng=1, abseps=1e-5, maxpts=400_000
    )
    assert probability_one_outside(value, covariance, 300.0) == pytest.approx(1 - inside, abs=1e-4)


def test_what_is_common_to_all_points_counts_once():
    one = float(probability_outside(1.0, 1.0, 3.0))
    together = probability_one_outside(np.ones(6), np.ones((6, 6)), 3.0)
    apart = probability_one_outside(np.ones(6), np.eye(6), 3.0)
    assert together == pytest.approx(one, abs=5e-4)
    assert apart == pytest.approx(1 - (1 - one) ** 6, abs=2e-3)


def test_a_rare_risk_is_not_said_to_be_none():
    risk = probability_one_outside(np.zeros(4), np.eye(4), 6.0)
    one = float(probability_outside(0.0, 1.0, 6.0))
    assert one <= risk <= 4 * one


# --- a population -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "ratio", "guard", "accept", "reject"),
    [(2.0, 4.0, 1.0, 0.008, 0.015), (2.5, 4.0, 1.0, 0.0025, None), (2.0, 2.0, 0.91, 0.008, 0.066)],
)
def test_global_risks_that_were_published(limit, ratio, guard, accept, reject):
    """Deaver, How to Maintain Your Confidence (NCSL 1993): population of deviation 1, measured with 1/ratio."""
    risk = global_risk(Population(0.0, 1.0), 1 / ratio, limit, guard * limit)
    assert risk.false_accept == pytest.approx(accept, abs=1e-4)
    assert reject is None or risk.false_reject == pytest.approx(reject, abs=5e-4)


@pytest.mark.parametrize(("mean", "deviation", "u"), [(0.0, 1.0, 0.3), (0.8, 0.6, 0.5), (-3.0, 0.2, 0.05)])
@pytest.mark.parametrize("accepted_up_to", [2.0, 1.4])
def test_global_risks_are_those_of_the_bivariate_normal(mean, deviation, u, accepted_up_to):
    """True and measured value are normal together: four rectangles of their distribution, by scipy."""
    limit = 2.0
    both = stats.multivariate_normal(
        [mean, mean], [[deviation**2, deviation**2], [deviation**2, deviation**2 + u**2]]
    )
    conforms = stats.norm(mean, deviation).cdf(limit) - stats.norm(mean, deviation).cdf(-limit)
    spread = stats.norm(mean, np.hypot(deviation, u))
    accepted = spread.cdf(accepted_up_to) - spread.cdf(-accepted_up_to)
    good = both.cdf([limit, accepted_up_to], lower_limit=[-limit, -accepted_up_to])
    risk = global_risk(Population(mean, deviation), u, limit, accepted_up_to)
    assert risk.false_accept == pytest.approx(accepted - good, abs=1e-6)
    assert risk.false_reject == pytest.approx(conforms - good, abs=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_global_risks_of_a_check_at_several_points_are_those_that_are_counted(correlation):
    """Seed 5: 400 000 blocks, each measured at four points; a block is accepted only at all of them."""
    rng, limit, accepted_up_to = np.random.default_rng(5), 2.0, np.array([1.6, 1.7, 1.6, 1.5])
    covariance = 0.3**2 * ((1.0 - correlation) * np.eye(4) + correlation)
    true = rng.normal(0.3, 0.9, 400_000)
    measured = true[:, None] + rng.multivariate_normal(np.zeros(4), covariance, len(true))
    accepted, conforms = (np.abs(measured) <= accepted_up_to).all(axis=1), np.abs(true) <= limit
    found = global_risk_together(Population(0.3, 0.9), covariance, limit, accepted_up_to)
    for stated, counted in (
        (found.false_accept, np.sum(accepted & ~conforms)),
        (found.false_reject, np.sum(~accepted & conforms)),
    ):
        assert stats.binomtest(int(counted), len(true), stated).pvalue > 0.001
    alone = global_risk_together(Population(0.3, 0.9), np.array([[0.09]]), limit, np.array([1.7]))
    exact = global_risk(Population(0.3, 0.9), 0.3, limit, 1.7)
    assert vars(alone) == pytest.approx(vars(exact), rel=0.03)  # by draws


def test_all_points_are_accepted_together_more_seldom_than_each():
    """Four errors with correlations ±0.6, against the distribution function of scipy."""
    signs = np.array([1.0, -1.0, 1.0, -1.0])
    covariance = 0.4 * np.eye(4) + 0.6 * np.outer(signs, signs)
    limits = np.array([1.8, 1.8, 1.7, 1.9])
    exact = stats.multivariate_normal(cov=covariance).cdf(limits, lower_limit=-limits)
    assert probability_all_accepted(covariance, limits) == pytest.approx(exact, abs=0.005)
    assert exact < stats.norm.cdf(1.7) - stats.norm.cdf(-1.7) - 0.1
    assert probability_all_accepted(covariance, -limits) == 0.0


def test_where_nothing_is_accepted_all_that_conforms_is_rejected():
    risk = global_risk(Population(0.0, 1.0), 1.5, 2.0, -1.0)
    assert risk.false_accept == 0.0
    assert risk.false_reject == pytest.approx(stats.norm.cdf(2) - stats.norm.cdf(-2))


def after(measured, u, dof, population, limit):
    """What prior times likelihood leaves outside ±limit, by integration."""

    def density(x):
        """Prior times likelihood, but for a constant."""
        prior = math.exp(-0.5 * ((x - population.mean) / population.standard_deviation) ** 2)
        square = ((x - measured) / u) ** 2
        return prior * (math.exp(-square / 2) if np.isinf(dof) else (1 + square / dof) ** (-(dof + 1) / 2))

    def part(low, high):
        bends = [x for x in (measured, population.mean) if low < x < high]
        return quad(density, low, high, points=bends or None, limit=200)[0]

    inside = part(-limit, limit)
    outside = part(-12.0, -limit) + part(limit, 12.0)
    return outside / (inside + outside)


@pytest.mark.slow
@pytest.mark.parametrize("dof", [np.inf, 20.0, 4.0])
@pytest.mark.parametrize(("mean", "deviation", "u"), [(0.0, 1.0, 0.7), (0.5, 0.6, 0.9), (-1.5, 0.4, 0.3)])
def test_a_population_is_the_prior_of_the_risk(mean, deviation, u, dof):
    """JCGM 106:2012, A.4, and 6.2 for what is not normal: a t of 200 parts within 1 % or 2e-4."""
    population, values = Population(mean, deviation), np.array([-2.5, 1.4, 1.9])
    found = probability_outside(values, np.full(3, u), 2.0, np.full(3, dof), population)
    expected = [after(y, u, dof, population, 2.0) for y in values]
    np.testing.assert_allclose(found, expected, rtol=1e-6 if np.isinf(dof) else 0.01, atol=2e-4)


def test_a_population_without_bounds_tells_nothing():
    wide = Population(0.3, 1e6)
    np.testing.assert_allclose(
        probability_outside(VALUES, 0.7, 2.0, population=wide),
        probability_outside(VALUES, 0.7, 2.0),
        rtol=1e-4,
    )
    certain = probability_outside([1.9, -2.1], 0.0, 2.0, population=Population(0.0, 1.0))
    np.testing.assert_array_equal(certain, [0, 1])


@pytest.mark.parametrize(("mean", "deviation"), [(0.0, 1.0), (0.6, 0.8), (0.0, 0.2)])
def test_with_a_population_the_guard_band_is_where_its_risk_is(mean, deviation):
    """On the worse side five per cent, never beyond the limit; nothing where the mean is too far out."""
    population = Population(mean, deviation)
    at = DecisionRule.of(None).acceptance_limit(2.0, MeasuredValues.of(0.8, population=population)).item()
    worst = max(after(side * at, 0.8, np.inf, population, 2.0) for side in (1, -1))
    assert worst == pytest.approx(0.05, rel=1e-3) if at < 2.0 else worst <= 0.05
    assert (at == 2.0) is (deviation == 0.2)
    hopeless = MeasuredValues.of(0.8, population=Population(3.0, 0.5))
    assert DecisionRule.of(None).acceptance_limit(2.0, hopeless) < 0


@pytest.mark.slow
@pytest.mark.parametrize("errors", [1, 4])
def test_risks_of_several_points_of_blocks_that_are_drawn(errors, monkeypatch):
    """700 blocks (seed 4) of four points with one error, or one each: five bins within chance at 1 % (Holm)."""
    monkeypatch.setattr(conformity, "_DRAWS", 800)
    monkeypatch.setattr(conformity, "_AT_ONCE", 800)
    rng = np.random.default_rng(4)
    population, covariance = Population(0.2, 0.6), correlated(4, 0.01) * 0.04
    true = np.broadcast_to(rng.normal(0.2, 0.6, (700, errors)), (700, 4))
    measured = true + rng.multivariate_normal(np.zeros(4), covariance, len(true))
    stated = np.array([probability_one_outside(y, covariance, 1.2, population=population) for y in measured])
    wrong = np.any(np.abs(true) > 1.2, axis=1)
    assert within_chance(stated, wrong) == []


@pytest.mark.parametrize("sizes", [(0.0, 0.0), (0.0, -1.0), (float("nan"), 1.0)])
def test_a_population_that_is_none_is_refused(sizes):
    with pytest.raises(CalibrationError, match="give two numbers, the second above 0"):
        Population(*sizes)
