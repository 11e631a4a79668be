"""N = K^-1 and the misalignment angles: against differences, Monte Carlo, GTC, and axes turned by hand."""

import GTC
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.calibration.result import (
    INVERSE,
    MISALIGNMENTS,
    inverse,
    inverse_jacobian,
    misalignments,
    specific_force_covariance,
)
from bench.model.geometry import COEFFICIENTS, Block
from tests.support.paper_bench import TRUTH, U0, K

BLOCK = Block(K, U0)
AXES = "xyz"


@pytest.fixture(scope="module")
def covariance():
    """Of no structure: every coefficient correlated with every other, u about 50 uV."""
    root = np.random.default_rng(3).normal(size=(12, 12))
    return 2.5e-9 * root @ root.T / 12


def by_differences(function, step=1e-6):
    def column(j):
        shift = step * np.eye(12)[j]
        return (function(TRUTH + shift) - function(TRUTH - shift)) / (2 * step)

    return np.stack([column(j) for j in range(12)], axis=1)


def numbers(vector):
    return np.concatenate([np.linalg.inv(vector[:9].reshape(3, 3)).ravel(), vector[9:]])


def angles(vector):
    """The paper's sentence, word by word: alpha_ji = (-1)^n K_ij / K_ii."""
    matrix = dict(zip(COEFFICIENTS, vector, strict=True))
    found = {}
    for i in AXES:
        for j in AXES:
            if i != j:
                n = 2 if i + j in {"xy", "yz", "zx"} else 1
                found[f"alpha_{j}{i}"] = (-1) ** n * matrix[f"K{i}{j}"] / matrix[f"K{i}{i}"]
    return np.array([found[name] for name in MISALIGNMENTS])


def test_the_inverse_and_its_covariance(covariance):
    found = inverse(BLOCK, covariance)
    assert found.names == INVERSE
    assert found.values[:9].reshape(3, 3) @ K == pytest.approx(np.eye(3), abs=1e-15)
    jacobian = by_differences(numbers)
    assert inverse_jacobian(np.linalg.inv(K)) == pytest.approx(jacobian, abs=1e-8)
    assert found.covariance == pytest.approx(jacobian @ covariance @ jacobian.T, rel=1e-6, abs=1e-18)


def test_the_angles_are_the_papers_and_have_a_covariance(covariance):
    found = misalignments(BLOCK, covariance)
    assert found.values == pytest.approx(angles(TRUTH), rel=1e-14)
    jacobian = by_differences(angles)
    assert found.covariance == pytest.approx(jacobian @ covariance @ jacobian.T, rel=1e-6, abs=1e-18)


@pytest.mark.parametrize("name", MISALIGNMENTS)
def test_an_angle_is_a_right_hand_turn_of_its_input_axis_about_the_third(name):
    """Turn the input axis of channel i by hand, and read K off where it points then."""
    j, i = (AXES.index(letter) for letter in name[-2:])
    axis = np.zeros(3)
    axis[3 - i - j] = 1e-6
    turned = -2.1 * np.eye(3)
    turned[i] = -2.1 * Rotation.from_rotvec(axis).apply(np.eye(3)[i])
    found = misalignments(Block(turned, U0), np.zeros((12, 12)))
    assert dict(zip(found.names, found.values, strict=True))[name] == pytest.approx(1e-6, rel=1e-6)
    assert np.sum(np.abs(found.values)) == pytest.approx(1e-6, rel=1e-6)


def test_gtc_finds_the_same_uncertainties_and_correlations(covariance):
    u = np.sqrt(np.diag(covariance))
    given = GTC.multiple_ureal(TRUTH.tolist(), u.tolist(), np.inf, COEFFICIENTS)
    for j in range(12):
        for k in range(j):
            GTC.set_correlation(covariance[j, k] / (u[j] * u[k]), given[j], given[k])
    k = np.array(given[:9], dtype=object).reshape(3, 3)
    cofactors = np.array(
        [
            [
                k[(j + 1) % 3, (i + 1) % 3] * k[(j + 2) % 3, (i + 2) % 3]
                - k[(j + 1) % 3, (i + 2) % 3] * k[(j + 2) % 3, (i + 1) % 3]
                for j in range(3)
            ]
            for i in range(3)
        ],
        dtype=object,
    )
    determinant = sum(k[0, m] * cofactors[m, 0] for m in range(3))
    theirs = [entry / determinant for entry in cofactors.ravel()] + list(given[9:])
    ours = inverse(BLOCK, covariance)
    assert ours.values == pytest.approx([GTC.value(one) for one in theirs], rel=1e-12)
    assert ours.u == pytest.approx([GTC.uncertainty(one) for one in theirs], rel=1e-9)
    r = [[GTC.get_correlation(a, b) if a is not b else 1.0 for b in theirs] for a in theirs]
    assert ours.covariance / np.outer(ours.u, ours.u) == pytest.approx(np.array(r), abs=1e-9)


def test_drawn_coefficients_scatter_as_the_covariances_say(covariance):
    """Seed 11, 40,000 draws: standard deviations within 2.5 % (7 standard errors), correlations within 0.03."""
    rng = np.random.default_rng(11)
    drawn = rng.multivariate_normal(TRUTH, covariance, 40_000)
    signal = np.array([[1.3, -0.4, 0.9]])
    N = np.linalg.inv(drawn[:, :9].reshape(-1, 3, 3))
    a = np.einsum("nij,nj->ni", N, signal - drawn[:, 9:])
    derived = inverse(BLOCK, covariance)
    cases = (
        (np.hstack([N.reshape(-1, 9), drawn[:, 9:]]), derived.covariance),
        (np.stack([angles(row) for row in drawn[:4000]]), misalignments(BLOCK, covariance).covariance),
        (a, specific_force_covariance(derived, signal)[0]),
    )
    for values, claimed in cases:
        u = np.sqrt(np.diag(claimed))
        width = 0.025 * np.sqrt(40_000 / len(values))
        assert np.std(values, axis=0) / u == pytest.approx(np.ones(len(u)), abs=width)
        r = np.corrcoef(values.T) - claimed / np.outer(u, u)
        assert np.abs(r).max() < 0.03 * np.sqrt(40_000 / len(values))


def test_noise_of_the_signals_adds_to_the_covariance_of_a(covariance):
    derived = inverse(BLOCK, covariance)
    signal = np.array([[1.3, -0.4, 0.9], [0.1, 0.2, 0.3]])
    more = specific_force_covariance(derived, signal, 1e-4) - specific_force_covariance(derived, signal)
    N = np.linalg.inv(K)
    assert more == pytest.approx(np.stack([1e-8 * N @ N.T] * 2), rel=1e-9)
