"""The evidence of candidates against the textbook's dense computation."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from bench.base.arrays import CHANNELS
from bench.diagnosis import naming
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import KNOWN_SIZE, SIZES, Search, Whitened
from bench.diagnosis.multi_run_system import make_system
from bench.diagnosis.naming import Naming, Scored, in_place
from bench.diagnosis.noise_grid import RATIOS, ColumnProducts, coupled, make_whitener
from bench.diagnosis.posterior import channels_of
from bench.diagnosis.visibility import smallest
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.readings.table import JoinedPart, together
from bench.validation.paper_bench import SETTING_U_RAD, K
from tests.support.diagnosis_bench import MODEL, NOISE_V, PSI, STAND_U, OneThreshold, paper_run, set_up


@pytest.fixture(scope="module")
def one():
    return set_up(paper_run(np.random.default_rng(11), K2=(0.0, 40e-6, 0.0)))


def dense_log_likelihood(one, extra, ratio_rad_per_v):
    """ln of the restricted likelihood with the noise size integrated out, by whole matrices."""
    linear = one.linear
    n = len(linear)
    setting = linear.setting[:, None] == linear.setting[None, :]
    same = setting & (linear.setting >= 0)[:, None]
    covariance = np.eye(n) + np.where(same, np.outer(linear.slope, linear.slope), 0.0) * ratio_rad_per_v**2
    for part in (linear.random / NOISE_V, *extra):
        covariance = covariance + part @ part.T
    inverse = np.linalg.inv(covariance)
    x = linear.fixed
    normal = x.T @ inverse @ x
    projected = inverse - inverse @ x @ np.linalg.solve(normal, x.T @ inverse)
    chi2 = linear.response @ projected @ linear.response / NOISE_V**2
    return (
        -0.5 * np.linalg.slogdet(covariance)[1]
        - 0.5 * np.linalg.slogdet(normal)[1]
        - 0.5 * (n - 12) * np.log(chi2)
    )


SIZE_WEIGHTS = (0.6, 0.28, 0.1, 0.02)


def dense_evidence(one, columns, known=(), weights=SIZE_WEIGHTS):
    grid = one.whitened.grid
    scaled = one.candidates.columns / NOISE_V
    base = [KNOWN_SIZE * scaled[:, list(known)]] if known else []
    null, variant = [], []
    for prior, ratio in zip(grid.log_prior, grid.setting_rad_per_noise, strict=True):
        null.append(prior + dense_log_likelihood(one, base, ratio))
        for size, weight in zip(SIZES, weights, strict=True):
            extra = [*base, size * scaled[:, list(columns)]]
            variant.append(prior + np.log(weight) + dense_log_likelihood(one, extra, ratio))
    return logsumexp(variant) - logsumexp(null)


def test_a_shift_at_a_remount_may_be_at_the_verification_points(one):
    shifts = {v.mounts for v in one.candidates.variants if v.family == "turn_on_shift"}
    assert shifts == {("2",), ("V",)}


@pytest.mark.parametrize("family", ["quadratic_nonlinearity", "head_eccentricity", "warm_up", "free_by_pass"])
def test_evidence_is_the_ratio_of_marginal_likelihoods(one, family):
    search = Search.beside(one.whitened, ())
    scores = search.score(one.whitened.reduce(one.linear.response[:, None]))
    number = next(i for i, v in enumerate(one.candidates.variants) if v.family == family)
    expected = dense_evidence(one, one.candidates.variants[number].columns)
    assert scores.variants[number, 0] == pytest.approx(expected, abs=1e-5)


def test_an_extreme_size_of_an_effect_of_the_voltmeters_is_improbable(one):
    scores = Search.beside(one.whitened, ()).score(one.whitened.reduce(one.linear.response[:, None]))
    number = next(i for i, v in enumerate(one.candidates.variants) if v.family == "voltmeter_drift")
    weights = (0.61, 0.28, 0.1099, 0.0001)
    expected = dense_evidence(one, one.candidates.variants[number].columns, weights=weights)
    assert scores.variants[number, 0] == pytest.approx(expected, abs=1e-5)


def test_the_same_size_in_all_channels_has_a_tenth_of_the_odds_of_another_form(one):
    """Seven sets of channels and the form with equal sizes, which is about one parameter, not three."""
    data = one.whitened.reduce(one.linear.response[:, None])
    scores = Search.beside(one.whitened, ()).score(data)
    numbers = one.candidates.of_family("quadratic_nonlinearity")
    (equal,) = (i for i in numbers if one.candidates.variants[i].own)
    apart = one.candidates.variants[next(i for i in numbers if len(one.candidates.variants[i].columns) == 3)]
    assert apart == one.candidates.variants[equal].plain
    (column,) = one.candidates.variants[equal].columns
    every = np.sum(one.candidates.columns[:, list(apart.columns)], axis=1)
    np.testing.assert_allclose(one.candidates.columns[:, column], every)
    weight = np.array([0.1 if i == equal else 1.0 for i in numbers])
    expected = logsumexp(scores.variants[numbers, 0], b=weight / weight.sum())
    family = one.candidates.families.index("quadratic_nonlinearity")
    assert scores.families(one.candidates)[family, 0] == pytest.approx(expected, abs=1e-9)


def with_evidence(one, family, **logs):
    """Scores in which forms of a family, by mounting and channels, have these ln of the evidence, others none."""
    scored = Scored.beside(one.whitened, one.whitened.reduce(one.linear.response[:, None]), ())
    scores, known = np.full_like(scored.scores.variants, -50.0), one.candidates.variants
    for i in one.candidates.of_family(family):
        of = "equal" if known[i].own else "".join(CHANNELS[c] for c in known[i].channels)
        scores[i] = logs.get("_".join((of, *known[i].mounts)), -50.0)
    return replace(scored, scores=replace(scored.scores, variants=scores))


def test_a_form_with_equal_sizes_is_found_only_if_it_is_the_most_probable(one):
    """It needs ten times the evidence of another form."""
    for log, channels in ((2.2, (1,)), (2.4, (0, 1, 2))):
        scored = with_evidence(one, "quadratic_nonlinearity", equal=log, y=0.0)
        assert scored.found("quadratic_nonlinearity").variant.channels == channels
        assert scored.likeliest("quadratic_nonlinearity").channels == channels


def test_equal_sizes_in_one_mounting_count_as_three_where_another_mounting_is_possible(one):
    found = with_evidence(one, "turn_on_shift", equal_2=5.0, xy_V=3.0).found("turn_on_shift").variant
    assert (found.channels, found.mounts, len(found.columns)) == ((0, 1, 2), ("2",), 3)


def test_channels_are_as_probable_as_their_forms(one):
    data = one.whitened.reduce(np.random.default_rng(13).normal(0.0, NOISE_V, (len(one.linear), 1)))
    scored = Scored.beside(one.whitened, data, ())
    numbers = one.candidates.of_family("quadratic_nonlinearity")
    forms = [one.candidates.variants[i] for i in numbers]
    weight = np.exp(scored.scores.variants[numbers, 0]) * [0.1 if v.own else 1.0 for v in forms]
    expected = [weight @ [c in v.channels for v in forms] / weight.sum() for c in range(3)]
    named = Naming((scored.found("quadratic_nonlinearity"),))
    assert channels_of(one.whitened, data, named)[0] == pytest.approx(expected, rel=1e-9)


def test_a_search_that_comes_back_to_where_it_was_ends(one, monkeypatch):
    """A further effect joins, although the odds are far below any evidence, and is found unnecessary each time."""
    monkeypatch.setattr(naming, "needed", lambda whitened, data, found, threshold, kept: found[:1])
    data = one.whitened.reduce(one.linear.response[:, None])
    limit = replace(OneThreshold().given, value=-100.0)
    assert len(naming.find(one.whitened, data, limit)) == 1


def test_the_smallest_size_that_shows_is_that_of_the_best_channel(one):
    """An equal size in all channels shows better, but no one knows before that the sizes are equal."""
    limit = OneThreshold().given
    apart = Whitened.of(
        one.whitened.grid,
        replace_variants(one.candidates, [v for v in one.candidates.variants if not v.own]),
    )
    told = smallest(one.whitened, limit, 2)
    assert told == smallest(apart, limit, 2)
    assert "cross_coupling" in told


def test_the_odds_of_names_in_a_place_are_those_of_bayes(one):
    """Five families in one form each, about as likely: prior times marginal likelihood, over their sum."""
    families = (
        "quadratic_nonlinearity",
        "cross_quadratic",
        "cubic_nonlinearity",
        "free_by_pass",
        "bias_drift",
    )
    forms = [
        next(v for v in one.candidates.variants if v.family == f and v.channels == (1,)) for f in families
    ]
    some = Whitened.of(one.whitened.grid, replace_variants(one.candidates, forms))
    scored = Scored.beside(some, some.reduce(one.linear.response[:, None]), ())
    odds = {o.name: o.probability for o in in_place(scored, scored.best()).odds}
    kinds = np.array([0.96 / 4] * 5)
    kinds[families.index("free_by_pass")] = 0.01
    logs = np.log(kinds / kinds.sum()) + [dense_evidence(one, form.columns) for form in forms]
    expected = dict(zip(families, np.exp(logs - logsumexp(logs)), strict=True))
    assert sum(expected[name] for name in odds) > 0.995
    for name, probability in odds.items():
        assert probability == pytest.approx(expected[name], abs=2e-6)


def replace_variants(candidates, variants):
    return Candidates(candidates.columns, candidates.kinds, candidates.scale, tuple(variants))


def test_evidence_beside_a_known_effect(one):
    known = next(v for v in one.candidates.variants if v.family == "head_eccentricity").columns
    search = Search.beside(one.whitened, known)
    scores = search.score(one.whitened.reduce(one.linear.response[:, None]))
    number = next(i for i, v in enumerate(one.candidates.variants) if v.family == "quadratic_nonlinearity")
    expected = dense_evidence(one, one.candidates.variants[number].columns, known)
    assert scores.variants[number, 0] == pytest.approx(expected, abs=1e-5)


def test_many_data_sets_are_scored_as_each_alone(one):
    rng = np.random.default_rng(12)
    responses = one.linear.response[:, None] + rng.normal(0.0, NOISE_V, (len(one.linear), 3))
    search = Search.beside(one.whitened, ())
    together = search.score(one.whitened.reduce(responses)).variants
    for i in range(3):
        alone = search.score(one.whitened.reduce(responses[:, [i]])).variants[:, 0]
        np.testing.assert_allclose(together[:, i], alone, atol=1e-7)


def test_products_of_whitened_columns_are_those_of_the_dense_covariance():
    """C^T (R^-1 - R^-1 X (X^T R^-1 X)^-1 X^T R^-1) C, where an effect of the model reaches all mountings."""
    known = AppliedEffect(CATALOGUE["bias_drift"], {"rate": np.full(3, 1e-9)})
    one = set_up(paper_run(None), ForwardModel(MODEL.installations, (known,)))
    grid, linear = one.whitened.grid, one.linear
    columns = one.candidates.columns[:, ::20] / NOISE_V
    for ratio in (0, len(RATIOS) // 2, len(RATIOS) - 1):
        same = (linear.setting[:, None] == linear.setting[None, :]) & (linear.setting >= 0)[:, None]
        slope = grid.setting_rad_per_noise[ratio] * linear.slope
        covariance = np.eye(len(linear)) + np.where(same, np.outer(slope, slope), 0.0)
        covariance += (linear.random / NOISE_V) @ (linear.random / NOISE_V).T
        inverse = np.linalg.inv(covariance)
        weighed = inverse @ linear.fixed
        inside = np.linalg.inv(linear.fixed.T @ weighed)
        expected = columns.T @ (inverse - weighed @ inside @ weighed.T) @ columns
        white = grid.white[ratio] @ columns
        scale = np.sqrt(np.diag(columns.T @ inverse @ columns))
        scale = np.outer(scale, scale)
        np.testing.assert_allclose((white.T @ white) / scale, expected / scale, atol=1e-6)
        likelihood = -0.5 * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(inside)[1])
        assert grid.log_det[ratio] == pytest.approx(likelihood, abs=1e-6)
    assert grid.freedom == len(linear) - 12


def test_rows_of_the_modulus_follow_from_geometry():
    """K2 of channel x adds K_xx K2 a_x^2 to U_x; the modulus changes by a_x/|a| times K2 a_x^2, to first order."""
    one = set_up(paper_run(None))
    number = next(
        i
        for i, v in enumerate(one.candidates.variants)
        if v.family == "quadratic_nonlinearity" and v.channels == (0,)
    )
    column = one.candidates.columns[:, one.candidates.variants[number].columns[0]]
    modulus = one.linear.rows.channel == 3
    phi = np.radians([45.0, 135.0, 225.0, 315.0])
    a = np.stack([np.sin(phi) * np.cos(PSI), -np.sin(phi) * np.sin(PSI), np.cos(phi)], axis=1)
    by_signal = a @ np.linalg.inv(K)
    plausible = CATALOGUE["quadratic_nonlinearity"].parameters[0].plausible
    expected = by_signal[:, 0] * K[0, 0] * plausible * a[:, 0] ** 2 / np.linalg.norm(by_signal, axis=1)
    np.testing.assert_allclose(column[modulus], expected, rtol=1e-6)


def test_exact_readings_leave_nothing():
    one = set_up(paper_run(None))
    assert np.max(np.abs(one.linear.response)) < 1e-12
    assert SETTING_U_RAD > 0


# --- the map to white noise, whose blocks are small, against the whole covariance of all rows -----


def system(blocks):
    """Two short runs of one block, or of two."""
    rng = np.random.default_rng(71)
    tables = [paper_run(rng, directions=(1,)) for _ in range(2)]
    return make_system(
        together([JoinedPart(table, block=b) for table, b in zip(tables, blocks, strict=True)]),
        MODEL,
        STAND_U,
    )


@pytest.mark.parametrize("blocks", [(0, 0), (0, 1)])
@pytest.mark.parametrize("reaching_far", [0, 2])
def test_rows_are_weighed_as_by_the_whole_covariance(blocks, reaching_far):
    linear = system(blocks)
    rng = np.random.default_rng(72)
    wide = 1e-5 * rng.normal(size=(len(linear), reaching_far))
    linear = replace(linear, random=np.column_stack([linear.random, wide]))
    covariance = np.diag((NOISE_V * linear.relative) ** 2) + linear.random @ linear.random.T
    same = (linear.setting[:, None] == linear.setting) & (linear.setting >= 0)
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope, linear.slope), 0.0)
    factor = np.linalg.inv(np.linalg.cholesky(covariance))
    taken, _ = np.linalg.qr(factor @ (linear.fixed / np.linalg.norm(linear.fixed, axis=0)))
    white = factor - taken @ (taken.T @ factor)
    expected = NOISE_V**2 * white.T @ white
    found = make_whitener(linear, NOISE_V, SETTING_U_RAD)
    np.testing.assert_allclose(found.weigh(np.eye(len(linear))), expected, atol=1e-9)
    np.testing.assert_allclose(found.diagonal, np.diag(expected), atol=1e-9)
    y = rng.normal(size=(len(linear), 3))
    np.testing.assert_allclose((found @ y).T @ (found @ y), y.T @ expected @ y, atol=1e-7)
    # nothing is left of what coefficients explain
    explained = linear.fixed @ rng.normal(size=linear.fixed.shape[1])
    assert np.linalg.norm(found @ explained) < 1e-9 * np.linalg.norm(explained)


def test_parts_of_a_matrix_that_do_not_touch_are_found_in_any_order():
    rng = np.random.default_rng(73)
    matrix = np.zeros((11, 6))
    matrix[:4, :2] = rng.normal(size=(4, 2))
    matrix[4:9, 2:5] = rng.normal(size=(5, 3))
    rows, columns = rng.permutation(11), rng.permutation(6)
    parts = [(r.tolist(), c.tolist()) for r, c in coupled(matrix[np.ix_(rows, columns)])]
    where = [
        (sorted(np.flatnonzero(np.isin(rows, own_r))), sorted(np.flatnonzero(np.isin(columns, own_c))))
        for own_r, own_c in ((range(4), range(2)), (range(4, 9), range(2, 5)), ([], [5]))
    ]
    assert sorted(parts) == sorted((list(map(int, r)), list(map(int, c))) for r, c in where)


def test_gram_matrices_of_many_columns_need_little_memory():
    # effects of 20 runs have a value for each of 40 mountings
    rng = np.random.default_rng(5)
    columns, weight, taken = (rng.standard_normal(shape) for shape in ((60, 1000), (2, 1000), (60, 2, 3)))
    sets = np.array([rng.permutation(60)[:40] for _ in range(10)])
    tracemalloc.start()
    gram = ColumnProducts(columns, weight**2, taken).among(sets)
    peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    assert peak_mb < 4 * columns[sets].nbytes / 1e6
    for ratio in range(2):
        own, apart = columns[sets[7]] * weight[ratio], taken[sets[7], ratio]
        np.testing.assert_allclose(gram[ratio, 7], own @ own.T - apart @ apart.T, rtol=1e-9, atol=1e-9)
