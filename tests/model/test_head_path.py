"""The path of the head as an effect sees it, by one that is not in the catalogue: the torque of a cable."""

from pathlib import Path

import numpy as np
import pytest

from bench.base.units import QuantityKind, parse_quantity
from bench.model import AppliedEffect, Block, Conditions, ForwardModel, Installation, effects
from bench.model.conditions import PAST_RAD, head_path
from bench.model.effects import Parameter
from bench.model.effects.base import StandEffect
from bench.model.effects.stand import into

BLOCK = Block(np.eye(3), np.zeros(3))
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


NO_EFFECTS = {"__init__", "base", "catalogue", "expression", "formula", "in_part"}


def test_every_module_of_effects_is_in_the_catalogue():
    folder = Path(effects.__file__).parent
    assert {path.stem for path in folder.glob("*.py")} - NO_EFFECTS == set(effects.MODULES)


def test_a_revolution_is_a_unit():
    kind = QuantityKind("a tilt by the turns", "3 arcsec/rev", "rad/rad")
    assert parse_quantity("360 deg/rev", kind) == pytest.approx(1.0)
