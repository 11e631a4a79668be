"""Effects of temperature and time on the block, per channel, in units of its scale factor."""

from __future__ import annotations

import numpy as np

from bench.base.arrays import HOUR, MINUTE, Floats
from bench.model.effects.base import BlockEffect, Parameter, Seen, Values


def lagged(signal: Floats, time_s: Floats, lag_s: float) -> Floats:
    """Return a sequence (n,) behind a first-order lag, which was in equilibrium at its first value.

    Exact for a signal that runs straight from one time to the next. Where time does not go on, the value
    stays; where it goes back, another run begins.
    """
    if lag_s <= 0.0 or len(signal) == 0:
        return signal
    behind = np.empty_like(signal)
    behind[0] = signal[0]
    for i in range(1, len(signal)):
        elapsed = time_s[i] - time_s[i - 1]
        if elapsed < 0.0:
            behind[i] = signal[i]
        elif elapsed == 0.0:
            behind[i] = behind[i - 1]
        else:
            rise = (signal[i] - signal[i - 1]) * lag_s / elapsed
            behind[i] = signal[i] - rise + (behind[i - 1] - signal[i - 1] + rise) * np.exp(-elapsed / lag_s)
    return behind


def _lag(*minutes: int) -> Parameter:
    """A lag behind the temperature: none, or about so many minutes."""
    grid = (0.0, *(m * MINUTE for m in minutes))
    return Parameter("lag", "min", MINUTE, plausible=10 * MINUTE, per_channel=False, grid=grid)


class ThermalBias(BlockEffect):
    """b_T T, T the temperature less the reference behind a first-order lag."""

    name = "thermal_bias"
    parameters = (Parameter("b_T", "ug/K", 1e-6, plausible=60e-6, per_channel=True), _lag(5, 10, 20, 30))
    sentence = "the bias of the accelerometer follows the temperature, at once or behind a lag"
    shown_by = "the same settings at two temperatures; a step of temperature shows the lag"
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii b_T_i T in volts, shape (n, 3)."""
        warmth = lagged(seen.conditions.warmth_k, seen.conditions.elapsed_s, float(values["lag"]))
        return warmth[:, None] * (seen.scale * values["b_T"])


class ThermalScale(BlockEffect):
    """k_T T K_ii a_i, T the temperature less the reference behind a first-order lag."""

    name = "thermal_scale"
    parameters = (Parameter("k_T", "ppm/K", 1e-6, plausible=100e-6, per_channel=True), _lag(5, 10, 20))
    sentence = "the scale factor of the accelerometer follows the temperature, at once or behind a lag"
    shown_by = "the same settings at two temperatures; a step of temperature shows the lag"
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii k_T_i T a_i in volts, shape (n, 3)."""
        warmth = lagged(seen.conditions.warmth_k, seen.conditions.elapsed_s, float(values["lag"]))
        return warmth[:, None] * seen.signal * (seen.scale * values["k_T"])


class WarmUp(BlockEffect):
    """A exp(-t / tau), t since the unit was switched on: since the start of the run where that is not known."""

    name = "warm_up"
    parameters = (
        Parameter("A", "ug", 1e-6, plausible=150e-6, per_channel=True),
        Parameter(
            "tau", "min", MINUTE, plausible=20 * MINUTE, per_channel=False,
            grid=tuple(minutes * MINUTE for minutes in (10, 15, 20, 30, 45, 60)), default=20 * MINUTE,
        ),
    )  # fmt: skip
    sentence = "the bias of the accelerometer settles after it was switched on"
    shown_by = "a return to installation 1 at the end; more passes; a longer soak makes it smaller"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii A_i exp(-t / tau) in volts, shape (n, 3)."""
        left = np.exp(-seen.conditions.switched_on_s / float(values["tau"]))
        return left[:, None] * (seen.scale * values["A"])


class BiasDrift(BlockEffect):
    """r t, t since the start of the run."""

    name = "bias_drift"
    parameters = (Parameter("rate", "ug/h", 1e-6 / HOUR, plausible=30e-6 / HOUR, per_channel=True),)
    sentence = "the bias of the accelerometer drifts evenly with time"
    shown_by = "a return to installation 1 at the end; more passes"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii r_i t in volts, shape (n, 3)."""
        return seen.conditions.elapsed_s[:, None] * (seen.scale * values["rate"])


class ScaleDrift(BlockEffect):
    """r t K_ii a_i, t since the start of the run."""

    name = "scale_drift"
    parameters = (Parameter("rate", "ppm/h", 1e-6 / HOUR, plausible=20e-6 / HOUR, per_channel=True),)
    sentence = "the scale factor of the accelerometer drifts evenly with time"
    shown_by = "a return to installation 1 at the end; a reference voltage at the inputs in each pass"

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii r_i t a_i in volts, shape (n, 3)."""
        return seen.conditions.elapsed_s[:, None] * seen.signal * (seen.scale * values["rate"])


class TurnOnShift(BlockEffect):
    """A step of bias at a remount or a power cycle: from the first row of the mountings named on."""

    name = "turn_on_shift"
    parameters = (Parameter("step", "ug", 1e-6, plausible=60e-6, per_channel=True),)
    sentence = "the bias of the accelerometer made a step when the block was mounted or switched on"
    shown_by = "a return to installation 1 at the end; a remount turned by 180 deg; power kept on at remounts"
    per_mount = True
    lasts = True
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return K_ii times the step in volts, shape (n, 3)."""
        return np.broadcast_to(seen.scale * values["step"], seen.signal.shape)
