"""The paper's case in another library's arithmetic: uncertain angles and readings, exact rotations, (7)-(8).

GTC carries every uncertain number with its sensitivities; nothing of the program but the numbers (11) is used
on its side, and it must agree to 1e-6.
"""

import GTC
import numpy as np
import pytest

from bench.calibration.budget.assessment import measured
from bench.calibration.budget.coefficients import make_budget
from tests.support.budget_bench import ONE_SIGMA, paper_setup, stand
from tests.support.paper_bench import U0, K

PASSES = 3


def turned(phi, tilt, yaw):
    """Upward unit vector on the platform: tilted, turned about y, turned about z."""
    x, y, z = GTC.sin(phi) * GTC.cos(tilt), GTC.sin(tilt), GTC.cos(phi) * GTC.cos(tilt)
    return GTC.cos(yaw) * x + GTC.sin(yaw) * y, GTC.cos(yaw) * y - GTC.sin(yaw) * x, z


def simulated(u):
    """Uncertain signals [installation][channel][point], the mean of the passes."""
    signals = []
    for installation in (1, 2):
        tilt, offset, yaw = (GTC.ureal(0.0, u[n]) for n in ("axis_tilt", "zero_offset", "mounting_error"))
        rows = [[0.0] * 9 for _ in range(3)]
        for point in range(9):
            for _ in range(PASSES):
                phi = point * np.pi / 4 + offset + GTC.ureal(0.0, u["setting_error"])
                x, y, z = turned(phi, tilt, yaw)
                force = (x, y, z) if installation == 1 else (-x, z, y)
                for i in range(3):
                    reading = sum(float(K[i, j]) * force[j] for j in range(3)) + float(U0[i])
                    rows[i][point] += (reading + GTC.ureal(0.0, u["voltmeter_error"])) / PASSES
        signals.append(rows)
    return signals


def paper_estimate(U1, U2):
    """(7)-(8) as printed, in the order of the coefficients."""
    root = float(np.sqrt(2.0))

    def sine(u):
        return (u[2] - u[6] + u[1] + u[3] - u[5] - u[7]) / (2 * (1 + root))

    def cosine(u):
        return (u[0] + u[8] - 2 * u[4] + root * (u[1] + u[7] - u[3] - u[5])) / 8

    def across(u):
        return (u[0] + u[8] - 2 * u[4]) / 4

    def level(u):
        return (u[0] + u[8] + 2 * u[4]) / 4

    x, y, z = 0, 1, 2
    return [
        (sine(U1[x]) - sine(U2[x])) / 2, across(U2[x]), across(U1[x]),
        ((U1[y][2] - U1[y][6]) / 2 + (U2[y][6] - U2[y][2]) / 2) / 2, cosine(U2[y]), across(U1[y]),
        ((U1[z][2] - U1[z][6]) / 2 + (U2[z][6] - U2[z][2]) / 2) / 2, across(U2[z]), cosine(U1[z]),
        (level(U1[x]) + level(U2[x])) / 2,
        (sum(U1[y][:8]) / 8 + (U2[y][2] + U2[y][6]) / 2) / 2,
        ((U1[z][2] + U1[z][6]) / 2 + sum(U2[z][:8]) / 8) / 2,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def theirs():
    return paper_estimate(*simulated(ONE_SIGMA))


@pytest.fixture(scope="module")
def ours():
    return make_budget(paper_setup(), stand(), "closed-form")


def test_standard_uncertainties_agree(theirs, ours):
    np.testing.assert_allclose(ours.combined.u, [GTC.uncertainty(one) for one in theirs], rtol=1e-6)
    np.testing.assert_allclose(ours.combined.value, [GTC.value(one) for one in theirs], atol=1e-12)


def test_correlations_agree(theirs, ours):
    matrix = [[GTC.get_correlation(a, b) for b in theirs] for a in theirs]
    np.testing.assert_allclose(ours.combined.correlation, matrix, atol=1e-6)
    assert np.max(np.abs(np.array(matrix) - np.eye(12))) > 0.2


@pytest.mark.parametrize("force", [(0.6, -0.2, 0.77), (3.0, 0.0, -4.0)])
def test_a_measured_acceleration_agrees(theirs, ours, force):
    """a = N (U - U0) and |a| from one more reading, in GTC's arithmetic (Cramer's rule)."""
    signal = K @ np.array(force) + U0
    u = [
        GTC.ureal(float(s), ONE_SIGMA["voltmeter_error"]) - b for s, b in zip(signal, theirs[9:], strict=True)
    ]
    k = [theirs[0:3], theirs[3:6], theirs[6:9]]
    whole = det3(k)
    a = [det3([[u[i] if j == c else k[i][j] for j in range(3)] for i in range(3)]) / whole for c in range(3)]
    modulus = GTC.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    found = measured(ours, np.array([force]))
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance[0])), [GTC.uncertainty(one) for one in a], rtol=1e-6
    )
    assert found.u_modulus[0] == pytest.approx(GTC.uncertainty(modulus), rel=1e-6)


def det3(m):
    return (
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    )
