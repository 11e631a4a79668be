"""The generator of the blind trial, against closed forms and dense linear algebra.

Random tests have fixed seeds; their bounds are four standard deviations of what is averaged.
"""

import numpy as np
import pytest
from scipy.linalg import block_diag

from benchmarks.blind_trial.cases import Row, make_case, seal
from benchmarks.blind_trial.effects import CATALOGUE, CLASS_OF, HIDDEN
from benchmarks.blind_trial.signals import SETTING_SIGMA, STAND_SIGMA, K, signals, visibility
from benchmarks.blind_trial.stand import DESIGNS, make_run, specific_force
from tests.support.blind_cases import NOISE_V, SEED


def dense_rho(design: str, change: np.ndarray, noise_v: float, setting: float) -> float:
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


@pytest.mark.slow
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
            dense = dense_rho(
                row.design, effect.change, row.noise_v * row.noise_factor, SETTING_SIGMA * row.noise_factor
            )
            assert effect.rho == pytest.approx(row.rho, rel=1e-6)
            assert dense == pytest.approx(row.rho, rel=2e-3), effect


@pytest.mark.slow
def test_every_effect_of_the_catalogue_is_asked_for_where_it_can_be_seen():
    asked = {
        make_case(SEED, Row("single", design, 5), index)[1].names[0]
        for design in ("both", "reordered", "oven")
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
