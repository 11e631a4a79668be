"""Geometry of the two installations against the paper's page and against rotations by scipy."""

from pathlib import Path

import numpy as np
import pytest

from bench.base.units import QuantityKind, parse_quantity
from bench.model import AppliedEffect, Block, Conditions, ForwardModel, Installation, effects, stand_errors
from bench.model.conditions import PAST_RAD, head_path
from bench.model.effects import Parameter
from bench.model.effects.base import StandEffect
from bench.model.effects.stand import into
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, axes_matrix, frame_rotation
from bench.validation.paper_bench import specific_force

PHI = np.radians(45.0) * np.arange(9)
BLOCK = Block(np.eye(3), np.zeros(3))
MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


def force(label, phi=PHI, alpha4=0.0, model=MODEL, **stand):
    conditions = Conditions.of([label] * len(phi), phi)
    return model.specific_force(conditions, stand_errors(**stand)[None, :], BLOCK, alpha4)


def first_order(label, phi, a1, a2, a3, a4, a5=0.0):
    """Paper (3) and (4) as printed, with +g, alpha2 beside alpha4, and the third mounting angle's c*a5."""
    s, c = np.sin(phi), np.cos(phi)
    across = a1 - a3 * s + a5 * c
    if label == "1":
        return np.stack([s + (a2 + a4) * c, across, c - (a2 + a4) * s], axis=1)
    return np.stack([-s - (a2 + a4) * c, c - (a2 + a4) * s, across], axis=1)


@pytest.mark.parametrize("label", ["1", "2"])
def test_exact_model_is_the_papers_to_second_order(label):
    """Halving all angles divides the difference to (3)/(4) by four: the first orders are the same."""
    angles = np.array([0.031, -0.023, 0.042, 0.017, 0.011])

    def gap(scale):
        a1, a2, a3, a4, a5 = angles * scale
        exact = force(label, alpha4=a4, axis_tilt=a1, zero_offset=a2, mounting_error=a3, mounting_roll=a5)
        return np.abs(exact - first_order(label, PHI, a1, a2, a3, a4, a5)).max()

    gaps = [gap(0.5**k) for k in range(5)]
    assert gaps[0] > 1e-4
    assert np.array(gaps[:-1]) / np.array(gaps[1:]) == pytest.approx([4.0] * 4, rel=0.05)


@pytest.mark.parametrize("label", ["1", "2"])
def test_exact_model_equals_rotations_by_scipy(label):
    """Large angles, every one of the five: the same as turning the axes as vectors (bench.validation)."""
    rng = np.random.default_rng(11)
    for a1, a2, a3, a4, a5, a6 in rng.uniform(-0.5, 0.5, (20, 6)):
        ours = force(
            label,
            alpha4=a4,
            axis_tilt=a1,
            zero_offset=a2,
            mounting_error=a3,
            mounting_offset=a6,
            mounting_roll=a5,
        )
        theirs = specific_force([label] * 9, PHI, a1, a2 + a6, a3, a4, a5)
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


def test_installation_matrices_are_the_names_of_the_axes():
    np.testing.assert_array_equal(INSTALLATION_1.block_from_platform, np.eye(3))
    np.testing.assert_array_equal(INSTALLATION_2.block_from_platform, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_array_equal(axes_matrix(("+y", "-x", "z")), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    "axes", [("x", "z", "y"), ("-x", "y", "z"), ("x", "y"), ("x", "x", "y"), ("x", "y", "z", "z")]
)
def test_axes_that_are_not_right_handed_are_refused(axes):
    with pytest.raises(ValueError, match="right-handed"):
        axes_matrix(axes)


@pytest.mark.parametrize("name", ["w", "--x", "", "xy"])
def test_a_name_that_is_no_axis_is_refused(name):
    with pytest.raises(ValueError, match="state an axis"):
        axes_matrix((name, "y", "z"))


def test_a_verification_installation_is_turned_by_psi_about_z():
    """Turned by psi about the platform's z: x and y share s as cos and -sin, z keeps c."""
    psi = np.radians(30.0)
    turned = Installation.from_axes("V", ("x", "y", "z"), psi)
    a = force("V", model=ForwardModel({"V": turned}))
    s, c = np.sin(PHI), np.cos(PHI)
    np.testing.assert_allclose(a, np.stack([s * np.cos(psi), -s * np.sin(psi), c], axis=1), atol=1e-15)
    np.testing.assert_allclose(a, specific_force(["V"] * 9, PHI, psi=psi), atol=1e-15)


def test_turned_about_another_axis():
    """About x by 90 degrees, block y lies along platform z."""
    turned = Installation.from_axes("V", ("x", "y", "z"), np.pi / 2, "x")
    a = force("V", np.zeros(1), model=ForwardModel({"V": turned}))
    np.testing.assert_allclose(a, [[0.0, 1.0, 0.0]], atol=1e-15)


def test_names_that_are_not_known_are_refused():
    with pytest.raises(KeyError, match="alpha9"):
        stand_errors(alpha9=1.0)
    with pytest.raises(ValueError, match="'w'"):
        frame_rotation("w", 0.1)


def test_stand_angles_belong_to_their_mounting():
    """Two mountings in one table: each row takes the angles of its own."""
    conditions = Conditions.of(["1", "2", "1"], np.full(3, np.pi / 2), series=[1, 1, 2])
    stand = np.stack([stand_errors(axis_tilt=t) for t in (1e-4, 2e-4, 3e-4)])
    a = MODEL.specific_force(conditions, stand, BLOCK)
    np.testing.assert_allclose([a[0, 1], a[1, 2], a[2, 1]], [1e-4, 2e-4, 3e-4], rtol=1e-7)
    assert [str(m) for m in conditions.mounts] == ["1", "2", "1/2"]


# --- head path --------------------------------------------------------------------------------------
# The path of the head as an effect sees it, by one that is not in the catalogue: the torque of a cable.

INSTALLATIONS = {label: Installation(label, np.eye(3)) for label in ("1", "2")}


class CableTorque(StandEffect):
    """A tilt that grows with the turns of the head since the block was mounted."""

    name = "cable_torque"
    parameters = (Parameter("tilt", "arcsec/rev", 1.0, 1.0, per_channel=False),)
    sentence = shown_by = ""
    needs_history = needs_path = True

    def addition(self, values, seen):
        path = head_path(seen.conditions)
        turned = np.cumsum(path.end - path.start)
        begun = np.maximum.accumulate(np.where(path.begins, np.arange(len(turned)), 0))
        wound = np.zeros(len(seen.conditions))
        wound[path.rows] = turned - turned[begun]
        return into("zero_offset", values["tilt"] * wound, seen.signal)


def test_a_cable_is_wound_up_until_the_block_is_mounted_anew():
    """Through 360° the head goes on, not back; a row without an angle leaves the cable as it is."""
    degrees = np.array([0, 90, 180, 270, 350, 10, np.nan, 350, 90, 80])
    labels = ["1"] * 8 + ["2"] * 2
    conditions = Conditions.of(labels, np.radians(degrees))
    tilt = 1e-4
    model = ForwardModel(INSTALLATIONS, (AppliedEffect(CableTorque(), {"tilt": np.array(tilt)}),))
    got = model.readings(BLOCK, conditions, np.zeros((2, 5)))
    wound = np.radians([0, 90, 180, 270, 350, 370, 0, 350, 0, -10])
    known = np.isfinite(degrees)
    angle = (np.radians(degrees) + tilt * wound)[known]
    np.testing.assert_allclose(got[known][:, 0], np.sin(angle), rtol=0, atol=1e-14)
    np.testing.assert_allclose(got[known][:, 2], np.cos(angle), rtol=0, atol=1e-14)


def test_the_head_turns_past_a_setting_to_come_to_it_from_the_other_side():
    conditions = Conditions.of(["1"] * 3, np.radians([0, 90, 45]), direction=[1, -1, -1])
    model = ForwardModel(INSTALLATIONS)
    with pytest.raises(ValueError, match="turns"):
        head_path(conditions)
    seen = []

    class Probe(CableTorque):
        def addition(self, values, seen_now):
            seen.append(head_path(seen_now.conditions))
            return np.zeros_like(seen_now.signal)

    ForwardModel(model.installations, (AppliedEffect(Probe(), {}),)).readings(
        BLOCK, conditions, np.zeros((1, 5))
    )
    (path,) = seen
    np.testing.assert_allclose(path.start, [-PAST_RAD, 0, np.pi / 2], atol=1e-15)
    np.testing.assert_allclose(path.turn, [-PAST_RAD, np.pi / 2 + PAST_RAD, np.pi / 2], atol=1e-15)
    np.testing.assert_array_equal(path.begins, [True, False, False])


NO_EFFECTS = {"__init__", "base", "formula"}


def test_every_module_of_effects_is_in_the_catalogue():
    folder = Path(effects.__file__).parent
    assert {path.stem for path in folder.glob("*.py")} - NO_EFFECTS == set(effects.MODULES)


def test_a_revolution_is_a_unit():
    kind = QuantityKind("a tilt by the turns", "3 arcsec/rev", "rad/rad")
    assert parse_quantity("360 deg/rev", kind) == pytest.approx(1.0)
