"""What the orientations of a tumble tell apart: ranks known from algebra, columns written out again."""

import numpy as np
import pytest

from bench.calibration.tumble import DEFAULT, HOMES, LINEAR, columns, separable
from bench.model.conditions import Conditions
from tests.support.paper_bench import ARCSEC, specific_force
from tests.support.tumble_bench import design

SQUARES = ("K2", "Kip", "Kio", "Kpo", "Kpp", "Koo")


def orientations(points, error_rad=0.0, third=False):
    """Nominal forces of a turn in installations 1 and 2, and of a third with all axes in gravity if asked."""
    installation, _, _, phi = design(points, 3)
    phi = phi + error_rad * np.random.default_rng(1).normal(size=len(phi))
    force = specific_force(installation, phi)
    conditions = Conditions.of(installation, phi)
    if third:
        more = specific_force(["1"] * len(phi), phi, psi=0.7)
        force, conditions = np.concatenate([force, more]), Conditions.of(installation * 2, np.tile(phi, 2))
    return force, conditions


def judged(points, channel, terms, **options):
    force, conditions = orientations(points, **options)
    return separable(force, channel, terms, conditions)


def test_the_columns_are_the_standards_terms():
    force, conditions = orientations(12)
    for channel in range(3):
        i, j, k = (np.roll(force, -channel, axis=1)[:, m] for m in range(3))
        expected = [i, j, k, 1 + 0 * i, i**2, i**3, i * abs(i), i * j, i * k, j * k, j**2, k**2]
        found = columns(force, channel, tuple(HOMES), conditions)
        assert found == pytest.approx(np.stack(expected, axis=1), abs=1e-15)


@pytest.mark.parametrize("channel", range(3))
@pytest.mark.parametrize("points", [8, 12, 16, 24, 36])
def test_ranks_per_axis(points, channel):
    """Linear 4/4; own square and cube 6/6; odd square, too, 6/7 on 8 points, 7/7 on more; squares 8/10."""
    cases = {(): 4, ("K2", "K3"): 6, DEFAULT: 6 if points == 8 else 7, SQUARES: 8}
    for terms, rank in cases.items():
        own = judged(points, channel, terms)
        assert (own.rank, len(own.asked)) == (rank, 4 + len(terms)), terms
        whole = columns(*orientations(points)[:1], channel, terms, orientations(points)[1])
        assert np.linalg.matrix_rank(whole, tol=1e-6) == rank


@pytest.mark.parametrize("channel", range(3))
def test_what_eight_points_cannot_separate_is_said_with_its_shares(channel):
    """sin^2 = 1/2 at the odd points: a|a| = (sqrt 2 - 1) a + (2 - sqrt 2) a^3."""
    own = judged(8, channel, DEFAULT)
    assert own.kept == (*LINEAR, "K2", "K3")
    assert own.inseparable == {
        "Koq": {"K1": pytest.approx(np.sqrt(2) - 1), "K3": pytest.approx(2 - np.sqrt(2))}
    }
    assert own.part_in("K3") == {"Koq": pytest.approx(2 - np.sqrt(2))}
    assert "6 of 7 terms are determined" in own.sentence()
    assert "Koq cannot be separated: 1 of it looks like +0.414 K1 and +0.586 K3" in own.sentence()


def test_angles_that_are_a_few_arcsec_off_separate_nothing():
    for error in (10 * ARCSEC, 300 * ARCSEC):
        assert judged(8, 0, DEFAULT, error_rad=error).kept == (*LINEAR, "K2", "K3")
        assert judged(12, 0, DEFAULT, error_rad=error).rank == 7


@pytest.mark.parametrize("points", [8, 36])
def test_the_product_of_the_cross_axes_needs_a_third_installation(points):
    for channel in (0, 1, 2):
        hidden = {0: "Kpo", 1: "Kip", 2: "Kio"}[channel]  # a_y a_z: no installation has both
        assert judged(points, channel, (hidden,)).inseparable == {hidden: {}}
        assert "shows in no reading" in judged(points, channel, (hidden,)).sentence()
        assert judged(points, channel, (hidden,), third=True).rank == 5


def test_the_last_square_is_a_bias_less_the_others():
    """a_x^2 + a_y^2 + a_z^2 = 1."""
    own = judged(12, 1, ("K2", "Kpp", "Koo"))
    assert own.inseparable == {
        "Koo": {"K0": pytest.approx(1), "K2": pytest.approx(-1), "Kpp": pytest.approx(-1)}
    }
