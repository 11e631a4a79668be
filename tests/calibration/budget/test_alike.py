"""What learned differences leave of the errors of meters: more alike, none of them smaller, certificates alone."""

import numpy as np
import pytest

from bench.calibration.budget.meters import LearnedDifferences, joint_errors

PRIOR = np.array([20e-6, 20e-6, 20e-6])
NONE = np.zeros(3, dtype=bool)
VALUES = np.array([10e-6, -4e-6, -6e-6])


def told(u=1e-6, group=(0, 0, 0), values=VALUES):
    centred = np.eye(3) - np.ones((3, 3)) / 3
    return LearnedDifferences(values, u**2 * centred, group)


def of_difference(covariance, a, b):
    return np.sqrt(covariance[a, a] + covariance[b, b] - 2 * covariance[a, b])


def test_every_meter_stays_as_uncertain_as_it_was_and_their_difference_is_the_learned():
    found = joint_errors(told(), [0, 1, 2], PRIOR, NONE, 1.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), PRIOR)
    assert of_difference(found.covariance, 0, 1) == pytest.approx(np.sqrt(2) * 1e-6, rel=0.01)
    assert found.mean[0] - found.mean[1] == pytest.approx(14e-6, rel=0.01)
    assert found.mean.sum() == pytest.approx(0.0, abs=1e-12)
    root = found.u * np.array(found.root)
    np.testing.assert_allclose(root @ root.T, found.covariance, rtol=1e-9, atol=1e-20)


def test_differences_hardly_known_leave_the_limits_as_they_were():
    found = joint_errors(told(u=1e-3), [0, 1, 2], PRIOR, NONE, 1.0)
    np.testing.assert_allclose(found.covariance, np.diag(PRIOR**2), atol=1e-3 * PRIOR[0] ** 2)
    np.testing.assert_allclose(found.mean, 0.0, atol=1e-8)


def test_they_age():
    fresh, old = (joint_errors(told(), [0, 1, 2], PRIOR, NONE, kept) for kept in (1.0, 0.5))
    assert of_difference(old.covariance, 0, 1) > 10 * of_difference(fresh.covariance, 0, 1)
    assert of_difference(old.covariance, 0, 1) < np.sqrt(2) * PRIOR[0]
    np.testing.assert_allclose(np.sqrt(np.diag(old.covariance)), PRIOR)


def test_a_certificate_is_never_touched_and_the_others_follow_it():
    prior = np.array([3e-6, 20e-6, 20e-6])
    found = joint_errors(told(), [0, 1, 2], prior, np.array([True, False, False]), 1.0)
    assert found.mean[0] == 0.0
    assert found.covariance[0, 0] == pytest.approx(prior[0] ** 2)
    assert found.mean[1] == pytest.approx(-14e-6, rel=0.02)
    assert np.sqrt(found.covariance[1, 1]) == pytest.approx(np.hypot(3e-6, np.sqrt(2) * 1e-6), rel=0.02)
    everyone = joint_errors(told(), [0, 1, 2], prior, ~NONE, 1.0)
    assert everyone == "certificates state all of it"


def test_no_covariance_is_negative_and_no_difference_surer_than_by_bayes():
    """Seed 9: any sizes, groups and certificates: the plain conditional covariance is never undercut."""
    rng = np.random.default_rng(9)
    tried = 0
    for _ in range(200):
        prior = rng.uniform(2e-6, 3e-5, 3)
        certified = rng.random(3) < 0.3
        group = ((0, 0, 0), (0, 0, 1))[int(rng.integers(2))]
        apart = np.array([[a == b for b in group] for a in group])
        centre = np.eye(3) - apart / apart.sum(axis=0)
        spread = centre @ np.diag(rng.uniform(1e-7, 2e-5, 3) ** 2) @ centre
        found = joint_errors(LearnedDifferences(np.zeros(3), spread, group), [0, 1, 2], prior, certified, 1.0)
        if isinstance(found, str):
            continue
        tried += 1
        C = found.covariance
        assert np.min(np.linalg.eigvalsh(C)) > -1e-18
        assert np.all(np.diag(C) <= prior**2 * (1 + 1e-6))
        size, axes = np.linalg.eigh(centre)
        Q = axes[:, size > 0.5]
        P = np.diag(prior**2)
        bayes = P - P @ Q @ np.linalg.inv(Q.T @ P @ Q + Q.T @ spread @ Q) @ Q.T @ P
        for a, b in ((0, 1), (0, 2), (1, 2)):
            assert of_difference(C, a, b) > of_difference(bayes, a, b) * (1 - 1e-6)
    assert tried > 100


def test_limits_that_are_contradicted_are_told():
    said = joint_errors(told(values=20 * VALUES), [0, 1, 2], PRIOR, NONE, 1.0)
    assert "contradict what certificates or makers' limits allow" in said
    assert joint_errors(told(), [0, None, None], PRIOR, NONE, 1.0) == "no two of these meters were compared"
