"""The Allan deviation and its degrees of freedom against published values, closed forms, allantools."""

import importlib
import sys

import allantools
import numpy as np
import pytest
from allantools.ci import edf_greenhall

from bench.calibration import CalibrationError
from bench.stats.allan import AllanCurve, allan_curve, fit_terms

WHITE, FLICKER, WALK = 0, -1, -2
LENGTHS = (32, 100, 1000, 4096, 19217)


def noise(alpha, n):
    """Noise (n,) whose spectrum goes as f^alpha."""
    fresh = np.fft.rfft(np.random.default_rng([31, -alpha, n]).normal(size=n))
    frequency = np.fft.rfftfreq(n)
    frequency[0] = frequency[1]
    return np.fft.irfft(fresh * frequency ** (alpha / 2), n)


def curve_of(multiples, samples):
    nothing = np.ones(len(multiples))
    return AllanCurve(nothing, nothing, np.asarray(multiples), samples)


def test_the_published_data_set_has_its_published_deviations():
    """W. J. Riley's 1000 points (NIST SP 1065): a portable generator, averages of 1, 10, 100."""
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    curve = allan_curve(np.array(numbers) / 2147483647, 1.0, [1, 10, 100])
    assert curve.tau_s.tolist() == [1.0, 10.0, 100.0]
    assert [f"{value:.6e}" for value in curve.deviation] == ["2.922319e-01", "9.159953e-02", "3.241343e-02"]


def test_a_drift_has_the_deviation_of_a_straight_line():
    """a tau/sqrt(2)."""
    curve = allan_curve(3e-6 * 0.5 * np.arange(5000.0) - 2.5, 0.5)
    assert curve.deviation == pytest.approx(3e-6 * curve.tau_s / np.sqrt(2), rel=1e-9)


def test_a_signal_in_microvolts_has_the_noise_terms_of_one_in_volts():
    """Seed 34: units change the terms by their factor alone, and neither their number nor the test of the fit."""
    rng = np.random.default_rng(34)
    signal = rng.normal(size=4000) + np.cumsum(0.05 * rng.normal(size=4000))
    large, small = (fit_terms(allan_curve(size * signal, 0.2)) for size in (1.0, 1e-6))
    np.testing.assert_allclose(small.values, 1e-6 * large.values, rtol=1e-6)
    np.testing.assert_allclose(small.u, 1e-6 * large.u, rtol=1e-6)
    assert small.p == pytest.approx(large.p, rel=1e-6)


def test_a_large_mean_takes_no_digits_from_the_noise():
    """The noise has steps of 2^-20, so that 2^30 can be added without a rounding."""
    fresh = np.round(np.random.default_rng(32).normal(size=2**16) * 2**20) / 2**20
    assert allan_curve(fresh + 2.0**30, 1.0).deviation == pytest.approx(
        allan_curve(fresh, 1.0).deviation, rel=1e-9
    )


@pytest.mark.parametrize("alpha", [WHITE, FLICKER, WALK])
@pytest.mark.parametrize("n", LENGTHS)
def test_the_deviation_is_that_of_allantools(alpha, n):
    signal, interval_s = noise(alpha, n) + 7.0, 0.37
    for multiples in (None, [1, 3, 5, 7, n // 3, (n - 1) // 2]):
        curve = allan_curve(signal, interval_s, multiples)
        tau, deviation, _, _ = allantools.oadev(
            signal, rate=1 / interval_s, data_type="freq", taus=curve.multiples * interval_s
        )
        assert curve.tau_s == pytest.approx(tau, rel=1e-12)
        assert curve.deviation == pytest.approx(deviation, rel=1e-12)


@pytest.mark.parametrize("alpha", [2, WHITE, FLICKER, WALK])
@pytest.mark.parametrize("n", [*LENGTHS, 137, 10**6])
def test_the_degrees_of_freedom_are_those_of_allantools(alpha, n):
    """Up to a quarter of the record; beyond it, too, where allantools knows them."""
    share = 4 if alpha == 2 else 2
    multiples = [m for m in (*range(1, 41), 64, 90, 128, 256, 1024, 4096, 2**17) if share * m < n]
    by_theirs = [max(edf_greenhall(alpha, 2, m, n + 1, overlapping=True), 1.0) for m in multiples]
    ours = curve_of(multiples, n).freedom(np.full(len(multiples), alpha))
    assert ours == pytest.approx(by_theirs, rel=1e-12)


def exact_freedom(m, samples, alpha):
    """tr(C)^2/tr(C^2) with the covariance C of all windows: of white phase (2), of white noise (0)."""
    one = np.concatenate([np.ones(m), -np.ones(m)]) if alpha == WHITE else np.zeros(2 * m + 1)
    if alpha == 2:
        one[[0, m, 2 * m]] = 1.0, -2.0, 1.0
    windows = samples + 1 - 2 * m
    filters = np.array([np.pad(one, (k, windows - 1 - k)) for k in range(windows)])
    covariance = filters @ filters.T
    return np.trace(covariance) ** 2 / np.sum(covariance**2)


@pytest.mark.parametrize(
    ("alpha", "multiples", "within"),
    [
        (2, [1, 2, 5, 16, 33, 60, 90, 120, 160, 199], 1e-12),
        # by the table, summed over some of the windows, and over all
        (WHITE, [40, 64, 90, 120, 160, 180], 1e-3),
        # Greenhall and Riley average the phase over each sample, this covariance does not
        (WHITE, [2, 5, 16, 33], 0.12),
    ],
)
def test_the_degrees_of_freedom_are_those_of_the_exact_covariance(alpha, multiples, within):
    exact = [max(exact_freedom(m, 400, alpha), 1.0) for m in multiples]
    ours = curve_of(multiples, 400).freedom(np.full(len(multiples), alpha))
    assert ours == pytest.approx(exact, rel=within)


def test_averages_that_the_record_has_not_twice_are_left_out():
    curve = allan_curve(noise(WHITE, 100), 1.0, [49, 7, 50, 0, 7, 1000])
    assert curve.multiples.tolist() == [7, 49]
    with pytest.raises(CalibrationError, match="100 samples are too few"):
        allan_curve(noise(WHITE, 100), 1.0, [50])


@pytest.mark.parametrize("hole", [np.nan, np.inf])
def test_a_hole_in_a_signal_is_refused(hole):
    with pytest.raises(CalibrationError, match="a record without gaps"):
        allan_curve(np.append(noise(WHITE, 100), hole), 1.0)


def test_a_bench_finds_the_deviation_without_the_tools_of_tests(monkeypatch):
    monkeypatch.delitem(sys.modules, "bench.stats.allan")
    for name in ("allantools", "pytest", "sphinx", "numpydoc"):
        monkeypatch.setitem(sys.modules, name, None)
    anew = importlib.import_module("bench.stats.allan")
    assert anew.fit_terms(anew.allan_curve(np.random.default_rng(33).normal(size=500), 1.0)).shown[1]


def test_gaps_hardly_change_the_deviation():
    whole = noise(WHITE, 4000)
    holes = whole.copy()
    holes[np.random.default_rng(36).random(4000) < 0.05] = np.nan
    holes[1000:1300] = np.nan
    a, b = allan_curve(whole, 1.0), allan_curve(holes, 1.0, gaps=True)
    near = a.multiples <= 64
    assert b.deviation[near] == pytest.approx(a.deviation[near], rel=0.15)
    assert b.samples == np.isfinite(holes).sum()
    # without a gap both ways of computing agree
    assert allan_curve(whole, 1.0, gaps=True).deviation == pytest.approx(a.deviation, rel=1e-12)
