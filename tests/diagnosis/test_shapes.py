"""The shape of what was found is not known, and the u of the coefficients holds that."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from bench.diagnosis.naming import Found, Naming
from bench.diagnosis.posterior import NoiseSize, beside, fit_found, other_shapes, with_other_shapes
from bench.model import CATALOGUE
from tests.support.diagnosis_bench import NOISE_V, STAND, paper_run, set_up
from tests.support.paper_bench import TRUTH

MINUTES = 60.0


def test_other_shapes_are_those_of_the_grid_between_and_one_beyond_either_end():
    warm_up = [tau / MINUTES for ((_, tau),) in other_shapes(CATALOGUE["warm_up"], (("tau", 20 * MINUTES),))]
    assert warm_up == pytest.approx([5, 50**0.5, 10, 15, 30, 45, 60, 7200**0.5, 120])
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
    return Naming((Found(wanted, 100.0, 100.0, 30.0),), -1.0)


def settling(readings, sizes_v, taus_min):
    """What settles with several time constants, (n, 3)."""
    return sum(
        np.outer(np.exp(-readings.time_s / (tau * MINUTES)), size)
        for tau, size in zip(taus_min, sizes_v, strict=True)
    )


# the time constant found is the nearest of the catalogue: one between two of it, and two exponentials
@pytest.mark.slow
@pytest.mark.parametrize("taus_min", [(25.0, 25.0), (8.0, 45.0)])
def test_biases_after_a_fitted_warm_up_are_within_their_u(taus_min):
    pulls = {"sized": [], "whole": []}
    for seed in range(8):
        readings = paper_run(np.random.default_rng([81, seed]), directions=(1, -1, 1))
        sizes = (np.array([1.0, -0.7, 0.0]) * 400e-6, np.array([0.4, -0.5, 0.0]) * 400e-6)
        readings = replace(readings, signal=readings.signal + settling(readings, sizes, taus_min))
        ready = set_up(readings)
        noise = NoiseSize(NOISE_V, STAND["setting_error"], 120)
        naming = named(ready, (0, 1), 20)
        sized = fit_found(ready.linear, ready.candidates, naming, noise)
        (in_part,) = beside(ready.candidates, naming, sized)
        whole = fit_found(with_other_shapes(ready.linear, in_part), ready.candidates, naming, noise)
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
    naming = Naming((Found(drift, 100.0, 100.0, 30.0),), -1.0)
    sized = fit_found(ready.linear, ready.candidates, naming, NoiseSize(NOISE_V, STAND["setting_error"], 120))
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
    naming = Naming((Found(bent, 100.0, 100.0, 30.0),), -1.0)
    sized = fit_found(ready.linear, ready.candidates, naming, NoiseSize(NOISE_V, STAND["setting_error"], 120))
    ((gain,),) = beside(ready.candidates, naming, sized)
    cubic_v = abs(sized.amplitudes[0]) * ready.candidates.scale[bent.columns[0]]
    assert gain.effect.name == "voltmeter_gain"
    assert float(gain.u["gain"]) == pytest.approx(cubic_v / 2.5)
