"""Nonlinearities of an accelerometer: its output in terms of the specific force on its own and other axes.

The forms are those of the model equation in IEEE Std 1293-2018; i is a channel's own axis, j and k the
next two in the order x, y, z, x.
"""

from __future__ import annotations

import numpy as np

from bench.base.arrays import Floats
from bench.model.effects.base import BlockEffect, Parameter, Seen, Values


def _size(name: str, unit: str, plausible: float) -> Parameter:
    """A coefficient of each channel, in ug per some power of g."""
    return Parameter(name, unit, 1e-6, plausible, per_channel=True)


def _others(force: Floats) -> tuple[Floats, Floats]:
    """Return a_j and a_k of each channel, (n, 3) each."""
    return np.roll(force, -1, axis=1), np.roll(force, -2, axis=1)


class QuadraticNonlinearity(BlockEffect):
    """K2 a_i^2: the output grows with the square of the input along the own axis."""

    name = "quadratic_nonlinearity"
    parameters = (_size("K2", "ug/g^2", 30e-6),)
    sentence = "the output of the accelerometer has a part that grows with the square of the acceleration"
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii K2_i a_i^2 in volts, shape (n, 3)."""
        return seen.scale * values["K2"] * seen.signal**2


class CubicNonlinearity(BlockEffect):
    """K3 a_i^3."""

    name = "cubic_nonlinearity"
    parameters = (_size("K3", "ug/g^3", 20e-6),)
    sentence = (
        "the output of the accelerometer has a part that grows with the third power of the acceleration"
    )
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii K3_i a_i^3 in volts, shape (n, 3)."""
        return seen.scale * values["K3"] * seen.signal**3


class OddQuadraticNonlinearity(BlockEffect):
    """Koq a_i |a_i|."""

    name = "odd_quadratic_nonlinearity"
    parameters = (_size("Koq", "ug/g^2", 20e-6),)
    sentence = "the output of the accelerometer has a part like the square of the acceleration with its sign"
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii Koq_i a_i |a_i| in volts, shape (n, 3)."""
        return seen.scale * values["Koq"] * seen.signal * np.abs(seen.signal)


class ScaleAsymmetry(BlockEffect):
    """Kabs |a_i|: another scale factor for positive than for negative input."""

    name = "scale_asymmetry"
    parameters = (_size("Kabs", "ug/g", 30e-6),)
    sentence = "the scale factor of the accelerometer is not the same for positive and negative acceleration"
    shown_by = "12 or more angles in a turn"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii Kabs_i |a_i| in volts, shape (n, 3)."""
        return seen.scale * values["Kabs"] * np.abs(seen.signal)


class CrossCoupling(BlockEffect):
    """Kip a_i a_j + Kio a_i a_k + Kpo a_j a_k."""

    name = "cross_coupling"
    parameters = tuple(_size(name, "ug/g^2", 20e-6) for name in ("Kip", "Kio", "Kpo"))
    sentence = "the output of the accelerometer has a part with the product of the accelerations on two axes"
    shown_by = "installations in which all three axes of the block feel gravity; a remount turned by 90 deg"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii (Kip_i a_i a_j + Kio_i a_i a_k + Kpo_i a_j a_k) in volts, shape (n, 3)."""
        a_j, a_k = _others(seen.signal)
        products = (
            values["Kip"] * seen.signal * a_j + values["Kio"] * seen.signal * a_k + values["Kpo"] * a_j * a_k
        )
        return seen.scale * products


class CrossQuadratic(BlockEffect):
    """Kpp a_j^2 + Koo a_k^2."""

    name = "cross_quadratic"
    parameters = tuple(_size(name, "ug/g^2", 20e-6) for name in ("Kpp", "Koo"))
    sentence = (
        "the output of the accelerometer has a part with the square of the acceleration across its axis"
    )
    shown_by = "a third installation; at 1 g it is the same as a square along the own axis and a bias"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii (Kpp_i a_j^2 + Koo_i a_k^2) in volts, shape (n, 3)."""
        a_j, a_k = _others(seen.signal)
        return seen.scale * (values["Kpp"] * a_j**2 + values["Koo"] * a_k**2)
