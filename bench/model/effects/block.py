"""Effects in the block: nonlinearity, hysteresis, temperature, supply.

In the formulas a_i is the specific force in g on the axis of channel i, and t a time. The value of a formula is in
g; `addition` multiplies it by the scale factor K_ii.
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from bench.base.arrays import HOUR, Floats
from bench.model.conditions import Conditions, HeadPath, head_path
from bench.model.effects.base import (
    BlockEffect,
    Parameter,
    Seen,
    Values,
    fading,
    lag_of,
    time_constant,
    warmth_behind,
)

# --- nonlinearity -----------------------------------------------------------------------------------
# The forms are those of the model equation in IEEE Std 1293-2018; i is a channel's own axis, j and k the
# next two in the order x, y, z, x.


def _size(name: str, unit: str, plausible: float) -> Parameter:
    """Return the parameter of an effect's amount in each channel, which a file states in `unit`.

    `plausible` is in SI, for example in g/g^2 if the `unit` is "ug/g^2".
    """
    return Parameter(name, unit, 1e-6, plausible, per_channel=True)


def _others(force: Floats) -> tuple[Floats, Floats]:
    """Return the specific forces a_j and a_k on the two other axes of each channel, shape (n, 3) each."""
    return np.roll(force, -1, axis=1), np.roll(force, -2, axis=1)


class QuadraticNonlinearity(BlockEffect):
    """Quadratic nonlinearity K2 a_i^2."""

    name = "quadratic_nonlinearity"
    parameters = (_size("K2", "ug/g^2", 30e-6),)
    sentence = "the output of the accelerometer has a part that grows with the square of the acceleration"
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.scale * values["K2"] * seen.signal**2


class CubicNonlinearity(BlockEffect):
    """Cubic nonlinearity K3 a_i^3."""

    name = "cubic_nonlinearity"
    parameters = (_size("K3", "ug/g^3", 20e-6),)
    sentence = (
        "the output of the accelerometer has a part that grows with the third power of the acceleration"
    )
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.scale * values["K3"] * seen.signal**3


class OddQuadraticNonlinearity(BlockEffect):
    """Odd quadratic nonlinearity Koq a_i |a_i|."""

    name = "odd_quadratic_nonlinearity"
    parameters = (_size("Koq", "ug/g^2", 20e-6),)
    sentence = "the output of the accelerometer has a part with the signed square of the acceleration"
    shown_by = "12 or more angles in a turn; a centrifuge above 1 g"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.scale * values["Koq"] * seen.signal * np.abs(seen.signal)


class ScaleAsymmetry(BlockEffect):
    """Asymmetry Kabs |a_i|: the scale factor differs between positive and negative input."""

    name = "scale_asymmetry"
    parameters = (_size("Kabs", "ug/g", 30e-6),)
    sentence = "the scale factor of the accelerometer is not the same for positive and negative acceleration"
    shown_by = "12 or more angles in a turn"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.scale * values["Kabs"] * np.abs(seen.signal)


class CrossCoupling(BlockEffect):
    """Products of the forces on two axes: Kip a_i a_j + Kio a_i a_k + Kpo a_j a_k."""

    name = "cross_coupling"
    parameters = tuple(_size(name, "ug/g^2", 20e-6) for name in ("Kip", "Kio", "Kpo"))
    sentence = "the output of the accelerometer has a part with the product of the accelerations on two axes"
    shown_by = "installations in which all three axes of the block feel gravity; a remount turned by 90 deg"

    def addition(self, values: Values, seen: Seen) -> Floats:
        a_j, a_k = _others(seen.signal)
        products = (
            values["Kip"] * seen.signal * a_j + values["Kio"] * seen.signal * a_k + values["Kpo"] * a_j * a_k
        )
        return seen.scale * products


class CrossQuadratic(BlockEffect):
    """Squares of the forces across the channel's axis: Kpp a_j^2 + Koo a_k^2."""

    name = "cross_quadratic"
    parameters = tuple(_size(name, "ug/g^2", 20e-6) for name in ("Kpp", "Koo"))
    sentence = (
        "the output of the accelerometer has a part with the square of the acceleration across its axis"
    )
    shown_by = "a third installation; at 1 g it is the same as a square along the own axis and a bias"

    def addition(self, values: Values, seen: Seen) -> Floats:
        a_j, a_k = _others(seen.signal)
        return seen.scale * (values["Kpp"] * a_j**2 + values["Koo"] * a_k**2)


ROUNDED_G: Final = 0.01
"""Half-width, g, over which a step at zero force is smoothed, so that tilts of arcseconds do not flip its sign."""


class BiasAsymmetry(BlockEffect):
    """Asymmetry (K0'/2) sign(a_i) of the bias, the sign smoothed over `ROUNDED_G`.

    A dead band of half-width w has the same effect outside the band as K0' = -2 w.
    """

    name = "bias_asymmetry"
    parameters = (_size("K0p", "ug", 20e-6),)
    sentence = "the bias of the accelerometer differs between positive and negative acceleration (dead band)"
    shown_by = "12 or more angles in a turn"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.scale * values["K0p"] / 2 * np.tanh(seen.signal / ROUNDED_G)


# --- hysteresis -------------------------------------------------------------------------------------
# Between two settings the head takes the shortest way; to approach from the other side it overshoots the setting
# first. Scale readings and nominal installations are used, so that small errors of the stand do not flip a
# branch of the loop.

SLOW: Final = 0.05
"""Rate of specific force with angle, g/rad, below which the step of the hysteresis is smoothed out."""


class Hysteresis(BlockEffect):
    """Dependence on the side from which the force came: a step (width 0), or a play of half-width `width_g`.

    `size` is the deviation after a large change of force.
    """

    name = "hysteresis"
    parameters = (
        Parameter("size", "ug", 1e-6, plausible=20e-6, per_channel=True),
        Parameter(
            "width_g", "g", 1.0, plausible=0.25, per_channel=False,
            grid=(0.0, 0.1, 0.16, 0.25, 0.35, 0.5, 0.63, 0.8), default=0.0,
        ),
        Parameter("start", "ug", 1e-6, plausible=20e-6, per_channel=True, start_of="size"),
    )  # fmt: skip
    sentence = (
        "the output of the accelerometer depends on the side from which the acceleration changes (hysteresis)"
    )
    shown_by = "both directions of approach"
    needs_history = True
    needs_path = True
    start_repeats = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii (size_i state_i + start_i change_i) in volts, shape (n, 3).

        `size` and `start` are parameters. `state` is this module's function for a start at 0; `change` is
        half the difference between its values for starts at 1 and at -1. Raises `ValueError` if
        `Conditions.turns` is None.
        """
        width_g = float(values["width_g"])
        added = values["size"] * state(seen.conditions, width_g)
        if np.any(start := values.get("start", 0.0)):
            risen, fallen = (state(seen.conditions, width_g, start) for start in (1.0, -1.0))
            added = added + start * (risen - fallen) / 2.0
        return np.asarray(seen.scale * added)

    def start_spread(self, conditions: Conditions) -> float:
        """Return the standard deviation of a state that is uniformly distributed from -1 to 1."""
        del conditions
        return float(1.0 / np.sqrt(3.0))


def state(conditions: Conditions, width_g: float, start: float = 0.0) -> Floats:
    """Return each channel's position in its hysteresis loop, (n, 3), from -1 (force has fallen) to 1 (risen).

    `start` is the position at the start of each mounting. Rows without an angle or in an unknown installation
    have 0 and do not affect later rows. The result is cached in the conditions.
    """
    kept, key = conditions.memory, ("hysteresis", width_g, start)
    if key not in kept:
        kept[key] = _state(head_path(conditions), len(conditions), width_g, start)
    known: Floats = kept[key]
    return known


def _state(path: HeadPath, count: int, width_g: float, start: float) -> Floats:
    result = np.zeros((count, 3))
    if len(path.rows) == 0:
        return result
    # nominal force on a channel: sine part times sin(phi) + cosine part times cos(phi)
    sine, cosine = np.moveaxis(path.sits[:, :, [0, 2]], 2, 0)
    if width_g > 0.0:
        result[path.rows] = _play(path, sine, cosine, width_g, start)
    else:
        end = path.end[:, None]
        rate = path.direction[:, None] * (sine * np.cos(end) - cosine * np.sin(end))
        result[path.rows] = np.tanh(rate / SLOW)
    return result


def _play(path: HeadPath, sine: Floats, cosine: Floats, width_g: float, start: float) -> Floats:
    """Return the state, -1 to 1, of a play of half-width `width_g` at the end of each of m paths, shape (m, 3).

    Each mounting starts in the state `start`.
    """
    stops = np.concatenate(
        [_extremes(path.start, path.turn, sine, cosine), _extremes(path.turn, path.end, sine, cosine)]
    )
    first = sine * np.sin(path.start)[:, None] + cosine * np.cos(path.start)[:, None]
    # one stop after the other confines the state to a range; together they do, too
    low, high = stops[0] - width_g, stops[0] + width_g
    for stop in stops[1:]:
        low, high = (np.clip(end, stop - width_g, stop + width_g) for end in (low, high))
    reached = np.empty_like(first)
    slack = first[0]
    for i, begins in enumerate(path.begins):
        slack = first[i] - start * width_g if begins else slack
        slack = np.minimum(np.maximum(slack, low[i]), high[i])
        reached[i] = slack
    return np.asarray((stops[-1] - reached) / width_g)


def _extremes(start: Floats, end: Floats, sine: Floats, cosine: Floats) -> Floats:
    """Return the forces at the turning points and the end of each rotation, in g, shape (3, m, 3).

    Between turning points the force is monotonic, so no other points are needed to follow a play. A rotation of
    slightly more than half a turn has at most two turning points; missing turning points are replaced by the end.
    """
    amplitude, phase = np.hypot(sine, cosine), np.arctan2(sine, cosine)
    sense = np.sign(end - start)[:, None]
    # number of half turns from an extreme, positive in the sense of rotation
    first = np.ceil(sense * (start[:, None] - phase) / np.pi)
    last = np.where(sense == 0.0, -np.inf, sense * (end[:, None] - phase) / np.pi)
    at_end = amplitude * np.cos(end[:, None] - phase)
    stops = [np.where(first + k <= last, amplitude * np.cos((first + k) * np.pi), at_end) for k in (0, 1)]
    return np.stack([*stops, at_end])


# --- temperature ------------------------------------------------------------------------------------


def _start(unit: str, plausible: float, start_of: str) -> Parameter:
    """Return the parameter for a lagged effect's deviation from equilibrium at the start of a mounting."""
    return Parameter("start", unit, 1e-6, plausible, per_channel=True, start_of=start_of)


class LaggedEffect(BlockEffect):
    """An effect proportional to T, the temperature after a first-order lag, minus the reference.

    The state of the lag at the start of a mounting is unknown. The first parameter is the effect per kelvin: a bias
    or, with `of_scale`, a relative change of the scale factor.
    """

    of_scale: ClassVar[bool] = False
    shows_on = ("chamber", "block")
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii (size_i T + start_i exp(-t / lag)), times a_i if `of_scale`, in volts, shape (n, 3).

        The time t is since the first reading of the mounting.
        """
        lag_s, acts = float(values["lag"]), seen.signal if self.of_scale else 1.0
        warmth = warmth_behind(seen.conditions, lag_s)
        added = warmth[:, None] * acts * (seen.scale * values[self.parameters[0].name])
        if np.any(start := values.get("start", 0.0)):
            added = added + fading(seen.conditions, lag_s)[:, None] * acts * (seen.scale * start)
        return np.asarray(added)

    def start_spread(self, conditions: Conditions) -> float:
        """Return the assumed spread of the starting temperature, K: the standard deviation over the run."""
        return float(np.std(conditions.warmth_k))


class ThermalBias(LaggedEffect):
    """Bias b_T T; T is the temperature, after a first-order lag, minus the reference."""

    name = "thermal_bias"
    parameters = (
        Parameter("b_T", "ug/K", 1e-6, plausible=60e-6, per_channel=True),
        lag_of(5, 10, 20, 30),
        _start("ug", 10e-6, "b_T"),
    )
    sentence = "the bias of the accelerometer follows the temperature, at once or behind a lag"
    shown_by = "the same settings at two temperatures; a step of temperature shows the lag"


class ThermalScale(LaggedEffect):
    """Scale-factor change k_T T a_i; T is the temperature, after a first-order lag, minus the reference."""

    name = "thermal_scale"
    of_scale = True
    parameters = (
        Parameter("k_T", "ppm/K", 1e-6, plausible=100e-6, per_channel=True),
        lag_of(5, 10, 20, 30),
        _start("ppm", 15e-6, "k_T"),
    )
    sentence = "the scale factor of the accelerometer follows the temperature, at once or behind a lag"
    shown_by = "the same settings at two temperatures; a step of temperature shows the lag"


class ThermalNonlinearity(BlockEffect):
    """Changes of K2 and K3 with T, the temperature minus the reference: (K2_T a_i^2 + K3_T a_i^3) T."""

    name = "thermal_nonlinearity"
    parameters = (_size("K2_T", "ug/g^2/K", 0.3e-6), _size("K3_T", "ug/g^3/K", 0.2e-6))
    sentence = "the nonlinearity of the accelerometer follows the temperature"
    shown_by = "12 or more angles in a turn at two temperatures; a centrifuge at two temperatures"

    def addition(self, values: Values, seen: Seen) -> Floats:
        a, warmth = seen.signal, seen.conditions.warmth_k[:, None]
        return warmth * (seen.scale * (values["K2_T"] * a**2 + values["K3_T"] * a**3))


class ThermalMisalignment(BlockEffect):
    """Input axes that turn with T, the temperature minus the reference: (m_j a_j + m_k a_k) T."""

    name = "thermal_misalignment"
    parameters = tuple(
        Parameter(name, "urad/K", 1e-6, plausible=1e-6, per_channel=True) for name in ("m_j", "m_k")
    )
    sentence = "the input axis of the accelerometer turns with the temperature"
    shown_by = "the same settings in both installations at two temperatures"

    def addition(self, values: Values, seen: Seen) -> Floats:
        a_j, a_k = _others(seen.signal)
        warmth = seen.conditions.warmth_k[:, None]
        return warmth * (seen.scale * (values["m_j"] * a_j + values["m_k"] * a_k))


class WarmUp(BlockEffect):
    """Decaying bias A exp(-t / tau), where t is the time since the unit was switched on.

    If that time is unknown, t is the time since the start of the run.
    """

    name = "warm_up"
    shows_on = ("supply", "block")
    parameters = (
        Parameter("A", "ug", 1e-6, plausible=150e-6, per_channel=True),
        time_constant(5, 10, 15, 20, 30, 45, 60, 80),
    )
    sentence = "the bias of the accelerometer settles after it was switched on"
    shown_by = "a return to installation 1 at the end; more passes; a longer soak makes it smaller"

    def addition(self, values: Values, seen: Seen) -> Floats:
        left = np.exp(-seen.conditions.switched_on_s / float(values["tau"]))
        return left[:, None] * (seen.scale * values["A"])


class BiasDrift(BlockEffect):
    """Linear drift r t of the bias, where t is the time since the start of the run."""

    name = "bias_drift"
    parameters = (Parameter("rate", "ug/h", 1e-6 / HOUR, plausible=30e-6 / HOUR, per_channel=True),)
    sentence = "the bias of the accelerometer drifts evenly with time"
    shown_by = "a return to installation 1 at the end; more passes"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.conditions.elapsed_s[:, None] * (seen.scale * values["rate"])


class ScaleDrift(BlockEffect):
    """Linear drift r t a_i of the scale factor, where t is the time since the start of the run."""

    name = "scale_drift"
    parameters = (Parameter("rate", "ppm/h", 1e-6 / HOUR, plausible=20e-6 / HOUR, per_channel=True),)
    sentence = "the scale factor of the accelerometer drifts evenly with time"
    shown_by = "a return to installation 1 at the end; a reference voltage at the inputs in each pass"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.conditions.elapsed_s[:, None] * seen.signal * (seen.scale * values["rate"])


class TurnOnShift(BlockEffect):
    """A step of bias at a remount or a power cycle; it lasts to the end of the run."""

    name = "turn_on_shift"
    shows_on = ("supply", "block")
    parameters = (Parameter("step", "ug", 1e-6, plausible=60e-6, per_channel=True),)
    sentence = "the bias of the accelerometer made a step when the block was mounted or switched on"
    shown_by = "a return to installation 1 at the end; a remount turned by 180 deg; power kept on at remounts"
    per_mount = True
    lasts = True
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.broadcast_to(seen.scale * values["step"], seen.signal.shape)


class ScaleStep(BlockEffect):
    """A step of a channel's scale factor, at a remount, after a pass, or in a single pass."""

    name = "scale_step"
    parameters = (Parameter("step", "ppm", 1e-6, plausible=50e-6, per_channel=True),)
    sentence = "the scale factor of the accelerometer, or of its channel, made a step between two passes"
    shown_by = "a return to installation 1 at the end; a reference voltage at the inputs in each pass"
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return seen.signal * (seen.scale * values["step"])


class ThermalSettling(BlockEffect):
    """Decaying bias A exp(-t / tau), where t is the time since the first reading of the mounting."""

    name = "thermal_settling"
    parameters = (
        Parameter("A", "ug", 1e-6, plausible=60e-6, per_channel=True),
        time_constant(10, 20, 40, 80),
    )
    sentence = (
        "the bias of the accelerometer settles after each mounting, warmed by the hand or by the platform"
    )
    shown_by = (
        "a longer wait after each mounting makes it smaller; a pass repeated at once in the same mounting"
    )
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        left = np.exp(-seen.conditions.since_mounting_s / float(values["tau"]))
        return left[:, None] * (seen.scale * values["A"])


# --- supply -----------------------------------------------------------------------------------------

MOST_RAILS: Final = 3
"""The largest number of supply rails."""


class SupplySensitivity(BlockEffect):
    """Bias and scale-factor change (b_S + k_S a_i) v; zero without a recorded rail voltage.

    v is the voltage of a supply rail minus its nominal voltage.
    """

    name = "supply_sensitivity"
    shows_on = ("supply", "block")
    parameters = (
        Parameter("b_S", "ug/V", 1e-6, plausible=20e-6, per_channel=True),
        Parameter("k_S", "ppm/V", 1e-6, plausible=20e-6, per_channel=True),
        Parameter(
            "rail", "1", 1.0, plausible=1.0, per_channel=False,
            grid=tuple(float(number) for number in range(1, MOST_RAILS + 1)), default=1.0,
        ),
    )  # fmt: skip
    sentence = "bias and scale factor of the accelerometer follow the voltage of a rail that feeds it"
    shown_by = "the same settings with the rail a little above and a little below its nominal voltage"

    def addition(self, values: Values, seen: Seen) -> Floats:
        number = round(float(values["rail"]))
        above_v = seen.conditions.above_nominal_v
        if not 1 <= number <= above_v.shape[1]:
            return np.zeros_like(seen.signal)
        return above_v[:, number - 1, None] * (seen.scale * (values["b_S"] + values["k_S"] * seen.signal))
