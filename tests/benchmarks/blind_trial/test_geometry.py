"""The trial's own geometry, weather and hysteresis, against closed forms and integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.validation import paper_bench
from benchmarks.blind_trial.effects import BLOCK
from benchmarks.blind_trial.signals import K, signature
from benchmarks.blind_trial.stand import Weather, head_path, make_run, specific_force
from tests.support.blind_cases import SEED


def test_geometry_agrees_with_the_other_independent_one():
    phi = np.radians(np.tile(np.arange(0, 361, 45.0), 2))
    labels = ["1"] * 9 + ["2"] * 9
    angles = np.random.default_rng(SEED).normal(0, 0.01, (5, len(phi)))
    expected = paper_bench.specific_force(labels, phi, *angles)
    a1, a2, a3, a4, a5 = angles
    np.testing.assert_allclose(
        specific_force(np.array(labels), phi + a2 + a4, a1, a3, a5), expected, atol=1e-14
    )
    turned = paper_bench.specific_force(["1"] * len(phi), phi, *angles, psi=np.pi / 4)
    np.testing.assert_allclose(
        specific_force(np.full(len(phi), "V"), phi + a2 + a4, a1, a3, a5), turned, atol=1e-14
    )


def test_lag_is_the_answer_of_two_delays_in_a_row():
    weather, lag = Weather(phase=0.7, drift=2e-5, start=0.1), 800.0
    taus = 0.8 * lag, 0.2 * lag

    def follow(t: float, state: np.ndarray) -> list[float]:
        outside = float(weather.at(np.array([t]))[0])
        return [(outside - state[0]) / taus[0], (state[0] - state[1]) / taus[1]]

    end = 20 * lag
    solved = solve_ivp(follow, (0, end), [0.1, 0.1], rtol=1e-9, atol=1e-9).y[1, -1]
    assert float(weather.at(np.array([end]), lag)[0]) == pytest.approx(solved, abs=1e-6)


def test_the_head_comes_to_each_stop_in_the_direction_noted():
    force, stops, _ = head_path("both")
    run = make_run("both")
    rows = run.measured
    np.testing.assert_allclose(
        force[stops[rows]], specific_force(run.labels[rows], run.angle[rows]), atol=1e-12
    )
    first = run.labels == "1"
    way = np.unwrap(np.arctan2(force[:, 0], force[:, 2])[: stops[first].max() + 1])
    for row in np.flatnonzero(first)[1:]:
        begin, end = stops[row - 1], stops[row]
        if np.ptp(way[begin : end + 1]) > 1e-6:
            assert np.sign(way[end] - way[end - 1]) == run.direction[row]


@pytest.mark.parametrize("kind", ["two plays", "Bouc-Wen"])
def test_hysteresis_follows_where_the_force_came_from(kind):
    run = make_run("both")
    rng = np.random.default_rng(SEED)
    truth = next(
        t
        for t in (BLOCK["hysteresis"](rng, run) for _ in range(100))
        if t.shape == kind and t.channels == ("x",)
    )
    change = signature(run, truth)[:, 0] / K[0, 0]
    at_zero = (run.labels == "1") & (run.point == 5)
    rising, falling = (change[at_zero & (run.direction == d)] for d in (1, -1))
    # at 180° the force along x falls while the head rises
    assert np.sign(rising[0]) == -np.sign(falling[0])
    np.testing.assert_allclose(np.abs(rising), np.abs(falling[0]), rtol=0.05)
    assert np.max(np.abs(change)) <= 20e-6 * (1 + 1e-9)
