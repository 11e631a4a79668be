"""The block and the effects of the forward model, against closed forms typed here."""

from typing import ClassVar

import numpy as np
import pytest

from bench.model import AppliedEffect, Block, Conditions, Distribution, Effect, ForwardModel, Stage
from bench.model.effects.base import EffectMistake
from bench.model.geometry import COEFFICIENTS, INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import TRUTH, U0, K, design, specific_force

BLOCK = Block(K, U0)
INSTALLATIONS = {"1": INSTALLATION_1, "2": INSTALLATION_2}


def readings(effects=(), setting=0.0):
    installation, pass_number, point, phi = design(1)
    conditions = Conditions.of(installation, phi, pass_number=pass_number, point=point)
    return ForwardModel(INSTALLATIONS, effects).readings(BLOCK, conditions, np.zeros((2, 5)), setting)


def test_block_by_hand_and_back():
    """Paper (1) written out for one force; (2) undoes it."""
    a = np.array([[0.3, -0.5, 0.8]])
    ux = -2.177087 * 0.3 - 0.018243 * -0.5 + 0.025027 * 0.8 + 0.071469
    assert BLOCK.output(a)[0, 0] == pytest.approx(ux, abs=1e-15)
    np.testing.assert_allclose(BLOCK.specific_force(BLOCK.output(a)), a, atol=1e-15)


def test_block_vector_has_the_promised_order():
    assert dict(zip(COEFFICIENTS, BLOCK.vector, strict=True))["Kyx"] == 0.026542
    assert dict(zip(COEFFICIENTS, BLOCK.vector, strict=True))["U0z"] == -0.411789
    np.testing.assert_array_equal(Block.from_vector(TRUTH).K, K)
    np.testing.assert_array_equal(Block.from_vector(TRUTH).U0, U0)


def test_singular_block_has_no_inverse():
    with pytest.raises(np.linalg.LinAlgError):
        Block(np.zeros((3, 3)), U0).specific_force(np.zeros((1, 3)))


def test_readings_without_effects():
    """The 18 readings by the rotations of bench/validation/paper_bench.py."""
    installation, _, _, phi = design(1)
    force = specific_force(installation, phi, alpha4=2e-3)
    np.testing.assert_allclose(readings(setting=2e-3), force @ K.T + U0, atol=1e-14)


class Probe(Effect):
    """Adds a constant at its stage and keeps what it was shown."""

    name: ClassVar[str] = "probe"
    parameters = ()
    sentence = shown_by = ""

    def __init__(self, stage, constant):
        self.stage = stage
        self.constant = constant
        self.seen = None

    def addition(self, values, seen):
        self.seen = seen.signal.copy()
        return np.full_like(seen.signal, self.constant)


@pytest.mark.parametrize("wrong", [np.zeros(18), np.zeros((1, 5)), np.zeros((18, 3)), 1.0, None, "0"])
def test_an_addition_of_another_shape_is_refused_and_never_spread_over_rows(wrong):
    class Wrong(Probe):
        def addition(self, values, seen):
            return wrong

    with pytest.raises(
        EffectMistake, match=r"^effect probe: its addition returns .*\(18, 5\); correct its class$"
    ):
        readings([AppliedEffect(Wrong(Stage.STAND, 0.0), {})])


def test_stages_act_in_the_order_of_the_chain():
    """Each stage sees what the one before made, whatever the order in which the effects are listed."""
    stand, angle, force, output, meter = (
        Probe(stage, constant) for stage, constant in zip(Stage, (0, 0.1, 0.01, 0.002, 0.0005), strict=True)
    )
    got = readings([AppliedEffect(p, {}) for p in (meter, output, force, angle, stand)])
    installation, _, _, phi = design(1)
    a = specific_force(installation, phi + 0.1)
    np.testing.assert_array_equal(stand.seen, np.zeros((18, 5)))
    np.testing.assert_allclose(angle.seen, phi, atol=1e-15)
    np.testing.assert_allclose(force.seen, a, atol=1e-14)
    np.testing.assert_allclose(output.seen, a + 0.01, atol=1e-14)
    volts = (a + 0.01) @ K.T + U0 + 0.002
    np.testing.assert_allclose(meter.seen, volts, atol=1e-14)
    np.testing.assert_allclose(got, volts + 0.0005, atol=1e-14)


def test_conditions_left_out_are_not_known():
    conditions = Conditions.of(["1", "2"], [0.0, 1.0])
    assert len(conditions) == 2
    assert conditions.point.tolist() == [1, 2]
    assert conditions.pass_number.tolist() == [1, 1]
    assert conditions.direction.tolist() == [0, 0]
    assert np.isnan(conditions.time_s).all()
    assert np.isnan(conditions.temperature_c).all()


def test_distributions():
    """JCGM 100, 4.3: k sigma of a normal one; limits of a rectangular one over the root of three."""
    assert Distribution(9.0, k=3).u == 3.0
    assert Distribution(3.0, "rectangular").u == pytest.approx(3**0.5)
    rng = np.random.default_rng(2)
    drawn = np.array([Distribution(3.0, "rectangular").draw(rng) for _ in range(4000)])
    assert np.abs(drawn).max() <= 3.0
    # four standard errors of a standard deviation; kurtosis of a rectangle is 1.8
    assert drawn.std() == pytest.approx(3**0.5, rel=4 * np.sqrt(0.8 / 4 / 4000))
    drawn = np.array([Distribution(6.0, k=3).draw(rng) for _ in range(4000)])
    assert drawn.std() == pytest.approx(2.0, rel=4 / np.sqrt(2 * 4000))
