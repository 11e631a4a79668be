"""The view of a tumble: known terms come back, and their uncertainties are what the estimates scatter by."""

import numpy as np
import pytest

from bench.calibration import CalibrationError, Noise, calibrate
from bench.calibration.tumble import tumble_view
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from tests.support.paper_bench import SETTING_U_RAD, STAND_U, K
from tests.support.tumble_bench import Terms, truth, tumble

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
G = 9.81
KNOWN = Terms(np.array([20, -30, 10]) * 1e-6, np.array([10, 5, -20]) * 1e-6, np.array([-15, 25, 8]) * 1e-6)


def expected(view, terms):
    """The truth of what is estimated: the sum with what cannot be separated from it, per scale factor as seen."""
    alone = truth(terms)
    found = []
    for channel, own in view.axes.items():
        parts = [sum(share * alone[f"{channel}.{term}"] for term, share in q.contains.items()) for q in own]
        seen = 1 + parts[[q.name for q in own].index("K1")]
        for q, part in zip(own, parts, strict=True):
            value = alone[f"{channel}.{q.name}"]
            found.append(value * seen if q.name == "K1" else (value + part) / seen)
    return np.array(found)


def values(view):
    return np.array([q.value for own in view.axes.values() for q in own])


@pytest.mark.parametrize("points", [8, 12, 24])
def test_readings_without_errors_give_the_terms_back(points):
    view = tumble_view(tumble(None, 0.0, KNOWN, points=points), MODEL, STAND_U, G)
    assert values(view) == pytest.approx(expected(view, KNOWN), abs=2e-9)
    assert len(view.names) == (18 if points == 8 else 21)


def test_on_eight_points_the_odd_square_is_not_estimated_and_what_is_says_so():
    view = tumble_view(tumble(None, 0.0, KNOWN, points=8), MODEL, STAND_U, G)
    words = {q.name: q.words for q in view.axes["y"]}
    assert words["K3"] == "K3 + 0.586 Koq"
    assert words["K1"] == "K1 (1 + 0.414 Koq)"
    assert words["K2"] == "K2"
    assert "Koq" not in words


def test_without_nonlinear_terms_it_is_the_calibration():
    readings = tumble(np.random.default_rng(2), 1e-4, Terms())
    noise = Noise(1e-4, SETTING_U_RAD, np.inf, "given")
    view = tumble_view(readings, MODEL, STAND_U, G, (), noise)
    found = calibrate(readings, MODEL, STAND_U, G, noise=noise)
    assert view.block.vector == pytest.approx(found.block.vector, abs=1e-9)
    scale = {q.name: q for q in view.axes["z"]}["K1"]
    assert scale.value == pytest.approx(found.block.K[2, 2], abs=1e-9)
    assert scale.u == pytest.approx(found.u[8], rel=1e-4)


def z_scores(points, runs, seed, noise_v=1e-4):
    """Error over u of every quantity in so many runs, their own terms and stand drawn for each."""
    rows = []
    for rng in np.random.default_rng(seed).spawn(runs):
        terms = Terms.drawn(rng)
        view = tumble_view(tumble(rng, noise_v, terms, points=points), MODEL, STAND_U, G)
        rows.append((values(view) - expected(view, terms)) / view.u)
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("points", [8, 12])
def test_estimates_scatter_by_their_uncertainties(points):
    """Seed 21, 40 runs: the rms over all quantities; `benchmarks.tumble_statistics` has each, of 300 runs."""
    z = z_scores(points, 40, 21)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.12)
    assert np.sqrt(np.mean(z**2, axis=0)).max() < 1.5
    assert np.abs(z).max() < 5.5


def test_what_a_term_that_was_left_out_moves_is_what_it_moves():
    """Readings with 0.1 mg/g^2 of a term that is not asked for, less those without; the noise is given."""
    noise = Noise(1e-4, SETTING_U_RAD, np.inf, "given")
    plain = tumble_view(tumble(None, 0.0, Terms()), MODEL, STAND_U, G, noise=noise)
    size = 1e-4
    for term in ("Kpp", "Koo", "Kip"):
        for at, channel in enumerate("xyz"):
            there = Terms(**{term: size * np.eye(3)[at]})
            view = tumble_view(tumble(None, 0.0, there), MODEL, STAND_U, G, noise=noise)
            moved = dict(zip(view.names, (values(view) - values(plain)) / size, strict=True))
            told = plain.left_out[channel][term]
            for q in plain.axes[channel]:
                by = moved[f"{channel}.{q.name}"] / (K[at, at] if q.name == "K1" else 1.0)
                assert by == pytest.approx(told.get(q.name, 0.0), abs=0.011), (channel, q.name, term)


@pytest.mark.parametrize("terms", [("K4",), ("K2", "K2")])
def test_terms_that_are_none_are_refused(terms):
    with pytest.raises(CalibrationError, match="each once, of K2, K3, Koq"):
        tumble_view(tumble(None, 0.0, Terms()), MODEL, STAND_U, G, terms)
