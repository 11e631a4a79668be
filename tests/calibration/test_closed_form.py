"""The paper's (7)-(8) against its page, and what is derived from coefficients."""

import GTC
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.calibration import CalibrationError, Noise, calibrate
from bench.calibration.closed_form import closed_form
from bench.calibration.result import INVERSE, MISALIGNMENTS, inverse, misalignments
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS, INSTALLATION_1, INSTALLATION_2, Block
from bench.readings.table import make_readings
from bench.validation.paper_bench import STAND_U, TRUTH, U0, K, design, simulate, specific_force
from tests.support.honest_runs import MODEL
from tests.support.specific_force import specific_force_covariance

X, Y, Z = range(3)
ROOT2 = np.sqrt(2.0)

# weights of the test points in (7): {coefficient of an installation: (channel, {point: weight}, divisor)}
SINE = {3: 1, 7: -1, 2: 1, 4: 1, 6: -1, 8: -1}
COSINE = {1: 1, 9: 1, 5: -2, 2: ROOT2, 8: ROOT2, 4: -ROOT2, 6: -ROOT2}
UP_DOWN = {1: 1, 9: 1, 5: -2}
LEVEL = {1: 1, 9: 1, 5: 2}
TURN = dict.fromkeys(range(1, 9), 1)
EQUATION_7 = {
    1: {
        "Kxx": (X, SINE, 2 * (1 + ROOT2)),
        "Kzz": (Z, COSINE, 8),
        "Kxz": (X, UP_DOWN, 4),
        "Kyz": (Y, UP_DOWN, 4),
        "Kyx": (Y, {3: 1, 7: -1}, 2),
        "Kzx": (Z, {3: 1, 7: -1}, 2),
        "U0x": (X, LEVEL, 4),
        "U0y": (Y, TURN, 8),
        "U0z": (Z, {3: 1, 7: 1}, 2),
    },
    2: {
        "Kxx": (X, {point: -weight for point, weight in SINE.items()}, 2 * (1 + ROOT2)),
        "Kyy": (Y, COSINE, 8),
        "Kxy": (X, UP_DOWN, 4),
        "Kzy": (Z, UP_DOWN, 4),
        "Kyx": (Y, {7: 1, 3: -1}, 2),
        "Kzx": (Z, {7: 1, 3: -1}, 2),
        "U0x": (X, LEVEL, 4),
        "U0y": (Y, {3: 1, 7: 1}, 2),
        "U0z": (Z, TURN, 8),
    },
}
ANGLES = ("alpha1", "alpha2", "alpha3")


def page(signals: np.ndarray) -> dict[str, float]:
    """Equations (7) by the weights above, then (8): the mean where both installations give a coefficient."""
    result = {}
    for name in COEFFICIENTS:
        found = []
        for installation, formulas in EQUATION_7.items():
            if name in formulas:
                channel, weights, divisor = formulas[name]
                terms = (w * signals[installation - 1, channel, point - 1] for point, w in weights.items())
                found.append(sum(terms) / divisor)
        result[name] = np.mean(found)
    return result


def one_pass(**angles_rad):
    """Noise-free readings of one pass with the same stand angles in both installations, or (first, second)."""
    installation, pass_number, point, phi = design(1)
    second = np.array([i == "2" for i in installation])
    angles = {
        name: np.where(second, *(pair[1], pair[0])) if isinstance(pair, tuple) else pair
        for name, pair in angles_rad.items()
    }
    signal = specific_force(installation, phi, **angles) @ K.T + U0
    return make_readings(installation, pass_number, point, phi, signal)


def by_closed_form(readings):
    return calibrate(readings, MODEL, STAND_U, 9.81, "closed-form")


def test_formulas_are_those_of_the_page():
    """For arbitrary signals, which no model made: every weight counts."""
    signals = np.random.default_rng(1).normal(size=(2, 3, 9))
    expected = page(signals)
    np.testing.assert_allclose(closed_form(signals), [expected[n] for n in COEFFICIENTS], atol=1e-15)


@pytest.mark.parametrize("estimator", ["closed-form", "gls"])
@pytest.mark.parametrize("passes", [1, 3])
def test_without_errors_the_papers_11_comes_back(estimator, passes):
    result = calibrate(simulate(None, 0.0, passes=passes), MODEL, STAND_U, 9.81, estimator)
    np.testing.assert_allclose(result.block.vector, TRUTH, atol=1e-9, rtol=0)
    assert np.abs(result.residuals).max() < 1e-9


def test_passes_are_averaged_first():
    readings = simulate(np.random.default_rng(3), 1e-3)
    signals = readings.signal.reshape(2, 3, 9, 3).mean(axis=1).transpose(0, 2, 1)
    expected = page(signals)
    np.testing.assert_allclose(
        by_closed_form(readings).block.vector, [expected[n] for n in COEFFICIENTS], atol=1e-14
    )


def first_order_errors(installation: int, a1: float, a2: float, a3: float) -> dict[str, float]:
    """What the angles of one installation put into (7), to first order, from (3)-(4) by hand."""
    Kxx, Kxy, Kxz, Kyx, Kyy, Kyz, Kzx, Kzy, Kzz = K.ravel()
    if installation == 1:
        return {
            "Kxx": -Kxy * a3 - Kxz * a2,
            "Kyx": -Kyy * a3 - Kyz * a2,
            "Kzx": -Kzy * a3 - Kzz * a2,
            "Kxz": Kxx * a2,
            "Kyz": Kyx * a2,
            "Kzz": Kzx * a2,
            "U0x": Kxy * a1,
            "U0y": Kyy * a1,
            "U0z": Kzy * a1,
        }
    return {
        "Kxx": Kxy * a2 + Kxz * a3,
        "Kyx": Kyy * a2 + Kyz * a3,
        "Kzx": Kzy * a2 + Kzz * a3,
        "Kxy": -Kxx * a2,
        "Kyy": -Kyx * a2,
        "Kzy": -Kzx * a2,
        "U0x": Kxz * a1,
        "U0y": Kyz * a1,
        "U0z": Kzz * a1,
    }


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("installation", [1, 2])
def test_first_order_errors_of_8(installation, angle):
    """Each angle of each installation alone, 1e-6 rad: K1yx carries -Kyy alpha3, K2yx +Kyy alpha2, …"""
    size = 1e-6
    pair = (size, 0.0) if installation == 1 else (0.0, size)
    error = by_closed_form(one_pass(**{angle: pair})).block.vector - TRUTH
    carried = first_order_errors(installation, *(size if a == angle else 0.0 for a in ANGLES))
    expected = [
        carried.get(name, 0.0) / sum(name in formulas for formulas in EQUATION_7.values())
        for name in COEFFICIENTS
    ]
    # the second order of 1e-6 rad is 1e-12
    np.testing.assert_allclose(error, expected, atol=5e-12)
    assert np.abs(expected).max() > 1e-7


def test_missing_points_are_named():
    readings = simulate(None, 0.0)
    keep = ~((readings.installation == "2") & (readings.point == 4)) & ~(
        (readings.installation == "1") & (readings.point == 9)
    )
    with pytest.raises(
        CalibrationError, match=r"missing \(installation/point\): 1/9, 2/4;.*default estimator"
    ):
        by_closed_form(readings.select(keep))


def test_one_pass_may_lack_a_point_that_another_has():
    readings = simulate(None, 0.0)
    keep = ~((readings.pass_number == 2) & (readings.point == 4))
    np.testing.assert_allclose(by_closed_form(readings.select(keep)).block.vector, TRUTH, atol=1e-14)


@pytest.mark.parametrize("point", [0, 10])
def test_points_that_the_paper_does_not_have_are_refused(point):
    readings = simulate(None, 0.0)
    readings.point[30] = point
    with pytest.raises(CalibrationError, match=f"installation 2, point {point}; use the default"):
        by_closed_form(readings)


def test_another_installation_is_refused():
    readings = simulate(None, 0.0)
    readings.installation[5] = "3"
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2, "3": INSTALLATION_1})
    with pytest.raises(CalibrationError, match="installation 3, point 6"):
        calibrate(readings, model, STAND_U, 9.81, "closed-form")


def test_angles_that_are_not_the_nominal_ones_are_refused():
    """(8) takes 45 degrees for granted; five minutes off would be 3 mV."""
    readings = simulate(None, 0.0)
    readings.angle_rad[10] += np.radians(5 / 60)
    with pytest.raises(CalibrationError, match=r"needs point 2 of installation 1 at 45°.*stood at 45\.0833°"):
        by_closed_form(readings)


def test_deviations_read_back_count_as_setting_error():
    """(8) ignores the angle that was read; its uncertainty must not."""
    rng = np.random.default_rng(8)
    installation, pass_number, point, phi = design()
    read_back = phi + rng.normal(0, 30 / 206265, len(phi))
    signal = specific_force(installation, read_back) @ K.T + U0 + rng.normal(0, 2e-5, (len(phi), 3))
    readings = make_readings(installation, pass_number, point, read_back, signal)
    closed = by_closed_form(readings)
    assert closed.noise.setting_rad * 206265 == pytest.approx(30, rel=0.4)
    assert np.all(np.abs(closed.block.vector - TRUTH) < 4 * closed.u)
    assert calibrate(readings, MODEL, STAND_U, 9.81).noise.setting_rad * 206265 < 5


def test_covariance_is_that_of_the_weights():
    """u of (8) from its weights on the page and sizes of noise that are given: setting error through dU/dphi."""
    readings = simulate(None, 0.0)
    sizes = Noise(3e-4, 5e-5, np.inf, "given")
    result = calibrate(readings, MODEL, {"mounting_error": 4e-4}, 9.81, "closed-form", sizes)
    installation, _, _, phi = design(1)
    units = np.eye(54).reshape(54, 2, 3, 9)
    gain = np.array([[page(unit)[n] for unit in units] for n in COEFFICIENTS])

    def signals(step_alpha3=(0.0, 0.0), step_phi=0.0):
        second = np.array(installation) == "2"
        a = specific_force(
            installation, phi + step_phi, alpha3=np.where(second, step_alpha3[1], step_alpha3[0])
        )
        return (a @ K.T).reshape(2, 9, 3).transpose(0, 2, 1)

    h = 1e-6
    slope = (signals(step_phi=h) - signals(step_phi=-h)) / (2 * h)
    variance = sizes.reading**2 / 3 * gain @ gain.T
    for m in range(2):
        mounted = np.zeros(2)
        mounted[m] = h
        fixed = gain @ (signals(mounted) - signals(-mounted)).ravel() / (2 * h)
        variance += (4e-4) ** 2 * np.outer(fixed, fixed)
        for point in range(9):
            alone = np.zeros((2, 3, 9))
            alone[m, :, point] = slope[m, :, point]
            set_wrong = gain @ alone.ravel()
            variance += sizes.setting_rad**2 / 3 * np.outer(set_wrong, set_wrong)
    np.testing.assert_allclose(result.covariance, variance, rtol=1e-6, atol=1e-16)


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
    assert ours.names == INVERSE
    assert ours.values == pytest.approx([GTC.value(one) for one in theirs], rel=1e-12)
    assert ours.u == pytest.approx([GTC.uncertainty(one) for one in theirs], rel=1e-9)
    r = [[GTC.get_correlation(a, b) if a is not b else 1.0 for b in theirs] for a in theirs]
    assert ours.covariance / np.outer(ours.u, ours.u) == pytest.approx(np.array(r), abs=1e-9)


def test_accelerations_by_drawn_coefficients_scatter_as_the_covariance_says(covariance):
    """Seed 11, 40,000 draws: standard deviations within 2.5 % (7 standard errors), correlations within 0.03."""
    rng = np.random.default_rng(11)
    drawn = rng.multivariate_normal(TRUTH, covariance, 40_000)
    signal = np.array([[1.3, -0.4, 0.9]])
    N = np.linalg.inv(drawn[:, :9].reshape(-1, 3, 3))
    a = np.einsum("nij,nj->ni", N, signal - drawn[:, 9:])
    claimed = specific_force_covariance(inverse(BLOCK, covariance), signal)[0]
    u = np.sqrt(np.diag(claimed))
    assert np.std(a, axis=0) / u == pytest.approx(np.ones(3), abs=0.025)
    assert np.abs(np.corrcoef(a.T) - claimed / np.outer(u, u)).max() < 0.03


def test_noise_of_the_signals_adds_to_the_covariance_of_a(covariance):
    derived = inverse(BLOCK, covariance)
    signal = np.array([[1.3, -0.4, 0.9], [0.1, 0.2, 0.3]])
    more = specific_force_covariance(derived, signal, 1e-4) - specific_force_covariance(derived, signal)
    N = np.linalg.inv(K)
    assert more == pytest.approx(np.stack([1e-8 * N @ N.T] * 2), rel=1e-9)
