"""The generator of the blind trial, against closed forms and dense linear algebra.

Random tests have fixed seeds; their bounds are four standard deviations of what is averaged.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

from bench.base.arrays import ARCSEC
from benchmarks.blind_trial.cases import Row, make_case, seal
from benchmarks.blind_trial.designs import DESIGNS, Weather, head_path, make_run
from benchmarks.blind_trial.effects import BLOCK, CATALOGUE, CLASS_OF, HIDDEN
from benchmarks.blind_trial.geometry import specific_force
from benchmarks.blind_trial.signals import SETTING_SIGMA, STAND_SIGMA, K, signals, signature, visibility
from tests.support import paper_bench

SEED = 20261122
NOISE_V = 15e-6


def test_geometry_is_the_papers_to_second_order():
    phi = np.radians(np.arange(0, 361, 15.0))
    rng = np.random.default_rng(SEED)
    a1, a3, a4 = rng.normal(0, 100 * ARCSEC, (3, len(phi)))
    s, c = np.sin(phi), np.cos(phi)
    paper = {
        "1": np.stack([s + a4 * c, a1 - a3 * s, c - a4 * s], axis=1),
        "2": np.stack([-s - a4 * c, c - a4 * s, a1 - a3 * s], axis=1),
    }
    second_order = 4 * np.max(np.abs([a1, a3, a4])) ** 2
    for label, expected in paper.items():
        got = specific_force(np.full(len(phi), label), phi + a4, a1, a3)
        assert np.max(np.abs(got - expected)) < second_order
        np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1, atol=1e-15)


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


def _dense_rho(design: str, change: np.ndarray, noise_v: float, setting: float) -> float:
    """ρ from the full covariance of all fitted readings, stand errors included."""
    run = make_run(design)
    rows = run.fitted
    force = specific_force(run.labels[rows], run.angle[rows])
    h = 1e-6
    slope = (signals(run, setting=h) - signals(run, setting=-h))[rows] / (2 * h)
    covariance = block_diag(
        *(noise_v**2 * np.eye(3) + setting**2 * np.outer(slope_, slope_) for slope_ in slope)
    )
    for mount in np.unique(run.mount[rows]):
        here = (run.mount[rows] == mount)[:, None]
        s = np.sin(run.angle[rows])[:, None]
        # the closed forms of (3)-(4): out of the plane α1 − α3·s; the axis that points there is y or z
        out = np.where(run.labels[rows] == "2", 2, 1)
        out_of_plane = K.T[out] * here
        for column, sigma in zip((out_of_plane, slope * here, -s * out_of_plane), STAND_SIGMA, strict=True):
            covariance += sigma**2 * np.outer(column.ravel(), column.ravel())
    x = np.zeros((len(force), 3, 12))
    for i in range(3):
        x[:, i, 3 * i : 3 * i + 3] = force
        x[:, i, 9 + i] = 1
    x = x.reshape(-1, 12)
    v = change[rows].ravel()
    weight = np.linalg.inv(covariance)
    left = v - x @ np.linalg.solve(x.T @ weight @ x, x.T @ weight @ v)
    return float(np.sqrt(left @ weight @ left))


@pytest.mark.parametrize(
    "row",
    [
        Row("single", rho=5),
        Row("single", "both", 10),
        Row("single", "turn-12", 20),
        Row("single", rho=8, noise_v=30e-6),
        Row("single", rho=8, noise_factor=1.3),
        Row("pair", rho=10),
        Row("outside", rho=12),
        Row("equal_k2", rho=15),
    ],
    ids=lambda row: row.key,
)
def test_rho_is_the_one_asked_for(row):
    for index in range(12):
        _, answer = make_case(SEED, row, index)
        for effect in answer.effects:
            dense = _dense_rho(
                row.design, effect.change, row.noise_v * row.noise_factor, SETTING_SIGMA * row.noise_factor
            )
            assert effect.rho == pytest.approx(row.rho, rel=1e-6)
            assert dense == pytest.approx(row.rho, rel=2e-3), effect


def test_every_effect_of_the_catalogue_is_asked_for_where_it_can_be_seen():
    asked = {
        make_case(SEED, Row("single", design, 5), index)[1].names[0]
        for design in ("both", "reordered")
        for index in range(len(CATALOGUE))
    }
    assert asked == set(CATALOGUE) == set(CLASS_OF)


def test_pairs_are_of_different_classes():
    for index in range(40):
        _, answer = make_case(SEED, Row("pair", rho=10), index)
        first, second = answer.names
        assert CLASS_OF[first] != CLASS_OF[second]


@pytest.mark.parametrize("factor", [1.0, 1.3])
def test_nulls_leave_the_noise_that_is_stated(factor):
    runs = 60
    run = make_run("paper")
    seen = visibility("paper", NOISE_V * factor, SETTING_SIGMA * factor)
    row = Row("null", noise_factor=factor)
    chi2 = [
        seen.rho(make_case(SEED, row, index)[0].readings.signal - signals(run)) ** 2 for index in range(runs)
    ]
    dof = 3 * 54 - 12
    assert np.mean(chi2) == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / runs))


def test_what_is_hidden_stands_in_the_readings():
    runs = 60
    run = make_run("both")
    seen = visibility("both", NOISE_V, SETTING_SIGMA)
    found = []
    for index in range(runs):
        case, answer = make_case(SEED, Row("single", "both", 10), index)
        template = seen.left(answer.effects[0].change)
        left = seen.left(case.readings.signal - signals(run))
        found.append(left @ template / np.linalg.norm(template))
    assert np.mean(found) == pytest.approx(10, abs=4 / np.sqrt(runs))
    assert np.std(found) == pytest.approx(1, abs=4 / np.sqrt(2 * runs))


@pytest.mark.parametrize("design", ["paper", "unverified"])
def test_hidden_effects_leave_nothing(design):
    names = set()
    for index in range(12):
        _, answer = make_case(SEED, Row("hidden", design), index)
        names.add(answer.names[0])
        assert answer.effects[0].rho < 0.05
        assert answer.effects[0].rho_with_verification < 0.05
        assert np.max(np.abs(answer.effects[0].change)) >= 25e-6  # thermal_emf: half of 10 × 5 µV
    assert names == set(HIDDEN) - ({"axis_wobble"} if design == "paper" else set())


def test_a_mounting_roll_is_seen_only_at_the_verification_points():
    _, answer = make_case(SEED, Row("mounting_roll", rho=10), 0)
    assert answer.effects[0].rho < 0.05
    assert answer.effects[0].rho_with_verification == pytest.approx(10)


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


def test_cases_are_the_same_for_the_same_seed_only():
    row = Row("pair", rho=10)
    first, again = make_case(3, row, 7), make_case(3, row, 7)
    assert seal(*first) == seal(*again)
    assert first[1] == again[1]
    for other in (make_case(4, row, 7), make_case(3, row, 8)):
        assert set(seal(*first).values()).isdisjoint(seal(*other).values())
    assert "pair" not in repr(first[0])


def test_cases_are_readings_files(tmp_path):
    from bench.readings.csv import read_csv, write_csv

    for design in DESIGNS:
        case, _ = make_case(SEED, Row("null", design), 0)
        write_csv(case.readings, tmp_path / "case.csv")
        back = read_csv(tmp_path / "case.csv", ["1", "2", "1T180", "2T180"])
        np.testing.assert_allclose(back.signal, case.readings.signal, atol=1e-9)
        assert back.extra["scan_order"].tolist() == case.readings.extra["scan_order"].tolist()


def _mistaken(name: str, wanted: str) -> tuple[np.ndarray, object, object]:
    """Readings less what a stand without errors gives, with the mistake whose place contains `wanted`."""
    for index in range(200):
        case, answer = make_case(SEED, Row(f"mistake:{name}"), index)
        if wanted in answer.place:
            return case.readings.signal, case, answer
    raise AssertionError(f"no {name} at {wanted}")


SMALL_V = 2e-3
"""Above what stand errors (5 σ of α3 are 1.6 mV) and noise do to a reading, below what a mistake does."""


def test_swapped_channels():
    signal, _, _ = _mistaken("swapped_channels", "x and z mounting 2")
    run = make_run("paper")
    plain = signals(run)
    second = run.mount == 1
    np.testing.assert_allclose(signal[second][:, [2, 1, 0]], plain[second], atol=SMALL_V)
    np.testing.assert_allclose(signal[~second], plain[~second], atol=SMALL_V)


def test_reversed_polarity_of_x_everywhere_may_be_called_reversed_rotation():
    signal, _, answer = _mistaken("reversed_polarity", "x everywhere")
    np.testing.assert_allclose(signal * [-1, 1, 1], signals(make_run("paper")), atol=SMALL_V)
    assert answer.accepted == ("reversed_polarity", "reversed_rotation")
    _, _, answer = _mistaken("reversed_polarity", "y everywhere")
    assert answer.accepted == ("reversed_polarity",)


def test_reversed_rotation():
    signal, case, _ = _mistaken("reversed_rotation", "")
    run = make_run("paper")
    np.testing.assert_allclose(signal, signals(run, true_angle=-run.angle), atol=SMALL_V)
    np.testing.assert_array_equal(case.readings.angle_rad, run.angle)


def test_swapped_installations():
    signal, case, _ = _mistaken("swapped_installations", "")
    run = make_run("paper")
    np.testing.assert_allclose(signal, signals(run), atol=SMALL_V)
    assert case.readings.installation.tolist() == ["2"] * 27 + ["1"] * 27 + ["V"] * 4


def test_shifted_points():
    signal, _, _ = _mistaken("shifted_points", "mounting 2")
    plain = signals(make_run("paper"))
    np.testing.assert_allclose(signal[28:54], plain[27:53], atol=SMALL_V)
    np.testing.assert_allclose(signal[:27], plain[:27], atol=SMALL_V)


@pytest.mark.parametrize(
    ("kind", "turned_deg"), [("1 deg", 1.0), ("10 arcmin", 1 / 6), ("1 arcmin", 1 / 60), ("reflected", None)]
)
def test_wrong_setting(kind, turned_deg):
    run = make_run("paper")
    _, case, answer = _mistaken("wrong_setting", kind)
    row = int(answer.place.split()[1].rstrip(",")) - 1
    signal = case.readings.signal
    others = np.arange(len(signal)) != row
    np.testing.assert_allclose(signal[others], signals(run)[others], atol=SMALL_V)
    assert run.fitted[row]
    turned = [
        -2 * run.angle[row] if turned_deg is None else sign * np.radians(turned_deg) for sign in (1, -1)
    ]
    # the same stop of the other passes has the same stand errors: what differs is the setting
    alike = others & (run.mount == run.mount[row]) & (run.point == run.point[row])
    off = signal[row] - signal[alike].mean(axis=0)
    # a reflected angle turns the sign of what α3 does, too
    bound = 2 * SMALL_V if turned_deg is None else 4 * np.sqrt(1.5) * np.hypot(NOISE_V, 2.2 * SETTING_SIGMA)
    errors = [np.max(np.abs(off - (signals(run, setting=t) - signals(run))[row])) for t in turned]
    assert min(errors) < bound


def test_outlier():
    signal, _, answer = _mistaken("outlier", "")
    off = np.abs(signal - signals(make_run("paper")))
    row, channel, size = answer.place.removesuffix(" V").split(", ")
    here = int(row.removeprefix("row ")) - 1, "xyz".index(channel)
    assert off[here] == pytest.approx(abs(float(size)), abs=SMALL_V)
    off[here] = 0
    assert off.max() < SMALL_V
