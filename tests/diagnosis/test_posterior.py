"""Estimates beside what was found, averaged over the sizes that it may have, against a mixture by another way."""

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from bench.diagnosis.naming import Found, Naming
from bench.diagnosis.posterior import NoiseSize, fit_found, posterior, whiten_rows
from tests.support.diagnosis_bench import NOISE_V, STAND, paper_run, set_up

NOISE = NoiseSize(NOISE_V, STAND["setting_error"], 120)
SIZES, WEIGHTS = (1.0, 4.0, 20.0), (0.6, 0.28, 0.12)
"""The prior of an effect's size, in plausible sizes: what docs and code of the search say."""


@pytest.fixture(scope="module")
def ready():
    return set_up(paper_run(np.random.default_rng(17), directions=(1, -1, 1)))


def found(ready, *wanted):
    """A naming with the first variant of each family that has so many columns."""
    variants = [
        next(v for v in ready.candidates.variants if v.family == family and len(v.columns) == columns)
        for family, columns in wanted
    ]
    return Naming(tuple(Found(v, 100.0, 100.0, 30.0) for v in variants), -1.0)


def mixture(ready, naming):
    """Mean and covariance of the amplitudes: each mixture component conditioned on the readings, in their space."""
    linear = ready.linear
    columns = ready.candidates.columns[:, list(naming.columns)]
    everything = np.column_stack([linear.fixed, linear.random, columns, linear.response])
    white = whiten_rows(linear, NOISE, everything, np.ones(len(linear), dtype=bool))
    free, rest = np.split(white, [linear.fixed.shape[1]], axis=1)
    # what coefficients of any size cannot explain
    seen = null_space((free / np.linalg.norm(free, axis=0)).T).T @ rest
    stand, effects, y = np.split(seen, [linear.random.shape[1], seen.shape[1] - 1], axis=1)
    parts = [mine for _, mine in naming.parts()]
    means, covariances, logs = [], [], []
    for index in np.ndindex(*[len(SIZES)] * len(parts)):
        variance = np.empty(columns.shape[1])
        for k, mine in zip(index, parts, strict=True):
            variance[mine] = SIZES[k] ** 2
        of_data = np.eye(len(y)) + stand @ stand.T + (effects * variance) @ effects.T
        gain = np.linalg.solve(of_data, effects * variance).T
        means.append(gain @ y[:, 0])
        covariances.append(np.diag(variance) - gain @ (effects * variance))
        log = multivariate_normal(cov=of_data, allow_singular=False).logpdf(y[:, 0])
        logs.append(log + sum(np.log(WEIGHTS[k]) for k in index))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    mean = weight @ np.array(means)
    square = sum(w * (c + np.outer(m, m)) for w, c, m in zip(weight, covariances, means, strict=True))
    return mean, square - np.outer(mean, mean)


@pytest.mark.parametrize("wanted", [[("mounting_roll", 2)], [("mounting_roll", 2), ("axis_tilt", 2)]])
def test_amplitudes_are_those_of_the_mixture_over_sizes(ready, wanted):
    naming = found(ready, *wanted)
    fitted = fit_found(ready.linear, ready.candidates, naming, NOISE)
    mean, covariance = mixture(ready, naming)
    scale = np.sqrt(np.diag(covariance))
    assert fitted.amplitudes / scale == pytest.approx(mean / scale, abs=1e-5)
    assert fitted.amplitude_covariance / np.outer(scale, scale) == pytest.approx(
        covariance / np.outer(scale, scale), abs=1e-5
    )


def test_what_no_reading_shows_of_an_effect_is_in_the_coefficients_as_all_its_sizes_leave_it(ready):
    naming = found(ready, ("mounting_roll", 2))
    fitted = fit_found(ready.linear, ready.candidates, naming, NOISE)
    # a turn of the block common to both mountings: nothing but the prior says how large it is, and Kyz, Kzy follow
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    only_the_least = 1.0 / np.sqrt(2.0)
    assert np.all(u > 1.5 * only_the_least)
    columns = ready.candidates.columns[:, list(naming.columns)]
    held = posterior(ready.linear, columns[:, :0], NOISE)
    grown = np.sqrt(np.diag(fitted.covariance)[:12] / np.diag(held.covariance)[:12])
    assert np.count_nonzero(grown > 5.0) >= 2


def test_of_many_finds_the_least_sure_have_all_their_sizes(ready, monkeypatch):
    """What the readings determine has one size all the same; three to the power of twelve are not gone through."""
    families = dict.fromkeys(v.family for v in ready.candidates.variants if v.named and len(v.columns) == 1)
    naming = found(ready, *((family, 1) for family in list(families)[:12]))
    assert len(naming.found) == 12
    many, own = [], np.linalg.slogdet
    monkeypatch.setattr(np.linalg, "slogdet", lambda matrix: many.append(1) or own(matrix))
    fitted = fit_found(ready.linear, ready.candidates, naming, NOISE)
    assert len(many) == 3 * 12 + 3**5
    assert np.all(np.linalg.eigvalsh(fitted.amplitude_covariance) > 0.0)
    # none of them is there: all are within their u of nothing, which is less than the largest size
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    assert np.all(np.abs(fitted.amplitudes) < 5.0 * u)
    assert np.all(u < 20.0)


def test_nothing_found_is_the_estimate_without_effects(ready):
    nothing = fit_found(ready.linear, ready.candidates, Naming((), -1.0), NOISE)
    plain = posterior(ready.linear, ready.candidates.columns[:, :0], NOISE)
    assert nothing.mean == pytest.approx(plain.mean, rel=1e-9, abs=1e-15)
    assert nothing.covariance == pytest.approx(plain.covariance, rel=1e-9)
    assert nothing.effects == 0
