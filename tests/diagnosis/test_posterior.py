"""Estimates beside what was found, averaged over the sizes that it may have, against a mixture by another way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from bench.diagnosis.naming import FoundEffect, Naming
from bench.diagnosis.posterior import (
    NoiseSize,
    beside,
    fit_found,
    other_shapes,
    posterior,
    whiten_rows,
    with_other_shapes,
)
from bench.model import CATALOGUE
from bench.validation.paper_bench import TRUTH
from tests.support.diagnosis_bench import NOISE_V, STAND, paper_run, set_up

NOISE = NoiseSize(NOISE_V, STAND["setting_error"], 120)
SIZES, WEIGHTS = (1.0, 4.0, 20.0, 80.0), (0.6, 0.28, 0.1, 0.02)
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
    return Naming(tuple(FoundEffect(v, 100.0, 100.0, 30.0) for v in variants))


def mixture(ready, naming):
    """Mean and covariance of the amplitudes: each mixture component conditioned on the readings, in their space."""
    linear = ready.linear
    columns = ready.candidates.columns[:, list(naming.columns)]
    everything = np.column_stack([linear.fixed, linear.random, columns, linear.response])
    white = whiten_rows(linear, NOISE, everything)
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
    """What the readings determine has one size all the same; four to the power of twelve are not gone through."""
    families = dict.fromkeys(v.family for v in ready.candidates.variants if v.named and len(v.columns) == 1)
    naming = found(ready, *((family, 1) for family in list(families)[:12]))
    assert len(naming.found) == 12
    many, own = [], np.linalg.slogdet
    monkeypatch.setattr(np.linalg, "slogdet", lambda matrix: many.append(1) or own(matrix))
    fitted = fit_found(ready.linear, ready.candidates, naming, NOISE)
    assert len(many) == len(SIZES) * 12 + len(SIZES) ** 5
    assert np.all(np.linalg.eigvalsh(fitted.amplitude_covariance) > 0.0)
    # none of them is there: all are within their u of nothing, which is less than the largest size
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    assert np.all(np.abs(fitted.amplitudes) < 5.0 * u)
    assert np.all(u < 20.0)


def test_nothing_found_is_the_estimate_without_effects(ready):
    nothing = fit_found(ready.linear, ready.candidates, Naming(()), NOISE)
    plain = posterior(ready.linear, ready.candidates.columns[:, :0], NOISE)
    assert nothing.mean == pytest.approx(plain.mean, rel=1e-9, abs=1e-15)
    assert nothing.covariance == pytest.approx(plain.covariance, rel=1e-9)
    assert nothing.effects == 0


# --- the shape of what was found is not known, and the u of the coefficients holds that -----------


MINUTES = 60.0


def test_other_shapes_are_those_of_the_grid_between_and_one_beyond_either_end():
    warm_up = [tau / MINUTES for ((_, tau),) in other_shapes(CATALOGUE["warm_up"], (("tau", 20 * MINUTES),))]
    assert warm_up == pytest.approx([2.5, 12.5**0.5, 5, 50**0.5, 10, 15, 30, 45, 60, 80, 12800**0.5, 160])
    lag = [tau / MINUTES for ((_, tau),) in other_shapes(CATALOGUE["thermal_bias"], (("lag", 0.0),))]
    assert lag == pytest.approx([2.5, 12.5**0.5, 5, 50**0.5, 10, 200**0.5, 20, 30, 1800**0.5, 60])
    # once or twice a turn: there is nothing between
    assert list(other_shapes(CATALOGUE["axis_wobble"], (("harmonic", 2.0),))) == []


def named(ready, channels, tau_min):
    """A naming that found a warm-up of these channels with this time constant."""
    shape = (("tau", tau_min * MINUTES),)
    wanted = next(
        v
        for v in ready.candidates.variants
        if v.family == "warm_up" and v.channels == channels and v.shape == shape
    )
    return Naming((FoundEffect(wanted, 100.0, 100.0, 30.0),))


def settling(readings, sizes_v, taus_min):
    """What settles with several time constants, (n, 3)."""
    return sum(
        np.outer(np.exp(-readings.time_s / (tau * MINUTES)), size)
        for tau, size in zip(taus_min, sizes_v, strict=True)
    )


@pytest.mark.slow
def test_biases_after_a_fitted_warm_up_are_within_their_u():
    """The time constant lies between two of the catalogue; two exponentials are in `test_open_parts`."""
    pulls = {"sized": [], "whole": []}
    for seed in range(8):
        readings = paper_run(np.random.default_rng([81, seed]), directions=(1, -1, 1))
        sizes = (np.array([1.0, -0.7, 0.0]) * 400e-6, np.array([0.4, -0.5, 0.0]) * 400e-6)
        readings = replace(readings, signal=readings.signal + settling(readings, sizes, (25.0, 25.0)))
        ready = set_up(readings)
        naming = named(ready, (0, 1), 20)
        sized = fit_found(ready.linear, ready.candidates, naming, NOISE)
        (in_part,) = beside(ready.candidates, naming, sized)
        whole = fit_found(with_other_shapes(ready.linear, in_part), ready.candidates, naming, NOISE)
        for name, fit in (("sized", sized), ("whole", whole)):
            off = ready.linear.block.vector + fit.mean[:12] - TRUTH
            pulls[name].append((off / np.sqrt(np.diag(fit.covariance)[:12]))[9:11])
    count = 2 * len(pulls["whole"])
    square = {name: float(np.sum(np.square(values))) for name, values in pulls.items()}
    # with the shape held the pulls are no noise at all; with it free their squares are at most chi-square
    assert special.chdtrc(count, square["sized"]) < 1e-6
    assert special.chdtrc(count, square["whole"]) > 1e-3


def test_what_some_channels_have_another_may_have_as_far_as_that_is_plausible():
    ready = set_up(paper_run(np.random.default_rng(5), directions=(1, -1, 1)))
    drift = next(v for v in ready.candidates.variants if v.family == "scale_drift" and v.channels == (0, 2))
    naming = Naming((FoundEffect(drift, 100.0, 100.0, 30.0),))
    sized = fit_found(ready.linear, ready.candidates, naming, NOISE)
    largest = max(abs(sized.amplitudes)) * ready.candidates.scale[drift.columns[0]]
    ((one,),) = beside(ready.candidates, naming, sized, {0: np.array([1.0, 0.25, 1.0])})
    assert one.channels == ("y",)
    assert one.u["rate"] == pytest.approx([0.0, 0.5 * largest, 0.0])
    assert beside(ready.candidates, naming, sized, {0: np.array([1.0, 0.0, 1.0])}) == ((),)


def test_a_voltmeter_that_is_not_linear_has_no_gain_that_could_be_told():
    ready = set_up(paper_run(np.random.default_rng(5), directions=(1, -1, 1)))
    bent = next(
        v
        for v in ready.candidates.variants
        if v.family == "voltmeter_nonlinearity" and ready.candidates.kinds[v.columns[0]].parameter == "q3"
    )
    naming = Naming((FoundEffect(bent, 100.0, 100.0, 30.0),))
    sized = fit_found(ready.linear, ready.candidates, naming, NOISE)
    ((gain,),) = beside(ready.candidates, naming, sized)
    cubic_v = abs(sized.amplitudes[0]) * ready.candidates.scale[bent.columns[0]]
    assert gain.effect.name == "voltmeter_gain"
    assert float(gain.u["gain"]) == pytest.approx(cubic_v / 2.5)


def test_size_u_and_probability_of_an_effect_are_one_statement(ready):
    """Of one number rho is |value|/u and p the two tails of a normal; of several their chi-square."""
    naming = found(ready, ("quadratic_nonlinearity", 1), ("bias_drift", 2))
    fitted = fit_found(ready.linear, ready.candidates, naming, NOISE)
    (_, one), (_, two) = naming.parts()
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    rho, p = fitted.significance(one)
    assert rho == pytest.approx(abs(fitted.amplitudes[0]) / u[0])
    assert p == pytest.approx(special.erfc(rho / np.sqrt(2)))
    rho, p = fitted.significance(two)
    covariance = fitted.amplitude_covariance[two, two]
    square = fitted.amplitudes[two] @ np.linalg.solve(covariance, fitted.amplitudes[two])
    assert (rho, p) == (pytest.approx(np.sqrt(square)), pytest.approx(np.exp(-square / 2)))
