"""Effects of the voltmeters, of the wiring, and of the bench's stated local gravity."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import HOUR, Floats
from bench.model.effects.base import (
    Effect,
    Parameter,
    Seen,
    Stage,
    Subsystem,
    Values,
    VoltmeterEffect,
    lag_of,
    lagged,
    play,
    time_constant,
)

NORMAL_V: Final = 2.5
"""The voltage for which the sizes of the nonlinearity are stated."""

LOW_RANGE_V: Final = 1.2
"""Below this voltage a 34401A with autorange uses its 1 V range (120 % of range, User's Guide, chapter 8)."""


class VoltmeterNonlinearity(VoltmeterEffect):
    """Nonlinearity q2 (U / 2.5 V)^2 + q3 (U / 2.5 V)^3, common to all channels."""

    name = "voltmeter_nonlinearity"
    parameters = tuple(Parameter(name, "uV", 1e-6, 10e-6, per_channel=False) for name in ("q2", "q3"))
    sentence = "the voltmeters are not linear: a part of the reading grows with its square or third power"
    shown_by = "a ladder of reference voltages at the inputs, such as 0, 1 and 2 V of both signs"

    def addition(self, values: Values, seen: Seen) -> Floats:
        part = seen.signal / NORMAL_V
        return values["q2"] * part**2 + values["q3"] * part**3


class VoltmeterDrift(VoltmeterEffect):
    """A linear drift of the zero, common to all channels; t is the time since the start of the run."""

    name = "voltmeter_drift"
    parameters = (Parameter("rate", "uV/h", 1e-6 / HOUR, plausible=15e-6 / HOUR, per_channel=False),)
    sentence = "the zero of the voltmeters drifts evenly with time, equally in all channels"
    shown_by = "a shorted input in each pass"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.broadcast_to((values["rate"] * seen.conditions.elapsed_s)[:, None], seen.signal.shape)


class VoltmeterWarmUp(VoltmeterEffect):
    """Decaying zero A exp(-t / tau), common to all channels; t is the time since the start of the run."""

    name = "voltmeter_warm_up"
    parameters = (
        Parameter("A", "uV", 1e-6, plausible=100e-6, per_channel=False),
        time_constant(5, 10, 15, 20, 30, 45, 60, 80),
    )
    sentence = (
        "a voltage that all channels share, such as the zero of the voltmeters, settles after switching on"
    )
    shown_by = "a shorted input in each pass; a longer warm-up of the meters makes it smaller"

    def addition(self, values: Values, seen: Seen) -> Floats:
        left = values["A"] * np.exp(-seen.conditions.elapsed_s / float(values["tau"]))
        return np.broadcast_to(left[:, None], seen.signal.shape)


_SHAPES: Final = (
    lag_of(5, 10, 15, 20, 30, 45, 60, 75, 90, 105, 120, 150, 180),
    Parameter("width", "K", 1.0, plausible=1.0, per_channel=False, grid=(0.0, 0.5, 1.0, 2.0, 4.0)),
)
"""Shape parameters: a lag (90 to 110 min were measured on a 34420A in an air bath), or a hysteresis of half-width
`width`.
"""


def _followed(values: Values, seen: Seen) -> Floats:
    """Return the meters' temperature minus the reference, after the effect's lag and hysteresis, K, shape (n,).

    The effects of temperature on gain and zero are proportional to this difference.
    """
    conditions = seen.conditions
    behind = lagged(conditions.meter_warmth_k, conditions.elapsed_s, float(values["lag"]))
    return play(behind, float(values["width"]))


class VoltmeterThermalGain(VoltmeterEffect):
    """Gain change g T of each channel's meter; g is its temperature coefficient.

    T is the meter's temperature minus 23 °C, after a lag or with hysteresis.
    """

    name = "voltmeter_thermal_gain"
    parameters = (Parameter("gain", "ppm/K", 1e-6, plausible=2e-6, per_channel=True), *_SHAPES)
    sentence = (
        "the gain of the voltmeter follows the temperature of the meter, at once, late, or with hysteresis"
    )
    shown_by = "two reference voltages, such as 0 and 10 V, at two temperatures of the meter"
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return _followed(values, seen)[:, None] * seen.signal * values["gain"]


class VoltmeterThermalOffset(VoltmeterEffect):
    """Zero change o T of each channel's meter; o is its temperature coefficient.

    T is the meter's temperature minus 23 °C, after a lag or with hysteresis.
    """

    name = "voltmeter_thermal_offset"
    parameters = (Parameter("offset", "uV/K", 1e-6, plausible=1e-6, per_channel=True), *_SHAPES)
    sentence = (
        "the zero of the voltmeter follows the temperature of the meter, at once, late, or with hysteresis"
    )
    shown_by = "a shorted input at two temperatures of the meter"
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return _followed(values, seen)[:, None] * np.broadcast_to(values["offset"], seen.signal.shape)


class VoltmeterMove(VoltmeterEffect):
    """A step of the zero of each channel's meter, as from a move, at the time `at` since the run began."""

    name = "voltmeter_move"
    parameters = (
        Parameter("step", "uV", 1e-6, plausible=10e-6, per_channel=True),
        Parameter(
            "at", "h", HOUR, plausible=HOUR, per_channel=False,
            grid=(HOUR, 2 * HOUR, 4 * HOUR, 8 * HOUR), default=HOUR,
        ),
    )  # fmt: skip
    sentence = "the readings jumped, as where a meter or its leads are moved, or a junction is touched"
    shown_by = "a shorted input before and after the move"

    def addition(self, values: Values, seen: Seen) -> Floats:
        after = seen.conditions.elapsed_s >= float(values["at"])
        return np.where(after[:, None], values["step"], np.zeros_like(seen.signal))


class ReferenceSupply(VoltmeterEffect):
    """A change s v of the reference voltage at the inputs, caused by the supply of the reference.

    s is the sensitivity, v the voltage of that supply rail minus its nominal voltage.
    """

    name = "reference_supply"
    parameters = (
        Parameter("sensitivity", "uV/V", 1e-6, plausible=1e-6, per_channel=False),
        Parameter("rail", "1", 1.0, plausible=1.0, per_channel=False, grid=(1.0, 2.0, 3.0), default=1.0),
    )
    sentence = "the reference at the inputs follows the voltage that supplies it"
    shown_by = "the supply of the reference swept up and down, twice"

    def addition(self, values: Values, seen: Seen) -> Floats:
        conditions, number = seen.conditions, round(float(values["rail"]))
        if not 1 <= number <= conditions.above_nominal_v.shape[1]:
            return np.zeros_like(seen.signal)
        at_reference = np.array([mount.installation == "R" for mount in conditions.mounts])[conditions.mount]
        change = np.where(
            at_reference, values["sensitivity"] * conditions.above_nominal_v[:, number - 1], 0.0
        )
        return np.broadcast_to(change[:, None], seen.signal.shape)


class RangeOffset(VoltmeterEffect):
    """Additional errors of zero and gain of each channel's meter on its lower range.

    A meter with autorange uses the lower range below 1.2 V.
    """

    name = "range_offset"
    parameters = (
        Parameter("offset", "uV", 1e-6, plausible=40e-6, per_channel=True),
        Parameter("gain", "ppm", 1e-6, plausible=20e-6, per_channel=True),
    )
    sentence = "zero and gain of the voltmeters differ on the range used below 1.2 V"
    shown_by = "a fixed range; a reference voltage below 1.2 V, read on both ranges"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.where(
            np.abs(seen.signal) < LOW_RANGE_V, values["offset"] + values["gain"] * seen.signal, 0.0
        )


class ChannelCrosstalk(VoltmeterEffect):
    """Crosstalk from the voltage scanned before: a fraction of U_before - U is added to U.

    U_before is the voltage scanned just before U, possibly in the row before; the very first reading has none.
    """

    name = "channel_crosstalk"
    parameters = (Parameter("fraction", "ppm", 1e-6, plausible=25e-6, per_channel=False),)
    sentence = "a reading keeps a part of the previous channel's voltage"
    shown_by = "the scan order of the channels reversed once; a longer delay after a channel is switched"
    needs_history = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        order = seen.conditions.scan_order
        scanned = np.take_along_axis(seen.signal, order, axis=1).ravel()
        step = np.diff(-scanned, prepend=-scanned[:1]).reshape(seen.signal.shape)
        added = np.empty_like(seen.signal)
        np.put_along_axis(added, order, values["fraction"] * step, axis=1)
        return added


class VoltmeterGain(VoltmeterEffect):
    """A common gain error, which the readings cannot distinguish from the scale factors."""

    name = "voltmeter_gain"
    parameters = (Parameter("gain", "ppm", 1e-6, plausible=30e-6, per_channel=False),)
    sentence = "the voltmeters read too much by a common factor"
    shown_by = "a reference voltage at the inputs; the voltmeters' calibration"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return values["gain"] * seen.signal


class ReferenceStep(VoltmeterEffect):
    """A step of the gain, equal in all channels: from a remount or pass onwards, or in a single pass."""

    name = "reference_step"
    parameters = (Parameter("step", "ppm", 1e-6, plausible=20e-6, per_channel=False),)
    sentence = (
        "all voltages changed by a common factor between two passes: the reference of the meters made a step, "
        "or gravity changed"
    )
    shown_by = "a reference voltage at the inputs in each pass; all passes on one day"
    per_mount = True
    per_pass = True
    outlasts_mount = True

    def addition(self, values: Values, seen: Seen) -> Floats:
        return values["step"] * seen.signal


class VoltmeterOffset(VoltmeterEffect):
    """A common zero error, which the readings cannot distinguish from the biases."""

    name = "voltmeter_offset"
    parameters = (Parameter("offset", "uV", 1e-6, plausible=50e-6, per_channel=False),)
    sentence = "the voltmeters have a zero error, equally in all channels"
    shown_by = "a shorted input"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.full_like(seen.signal, values["offset"])


class ThermalEmf(Effect):
    """A constant voltage in the leads of each channel; shorting the meter's inputs does not reveal it."""

    name = "thermal_emf"
    shows_on = ("voltmeters",)
    stage = Stage.BLOCK_OUTPUT
    subsystem = Subsystem.VOLTMETER
    parameters = (Parameter("emf", "uV", 1e-6, plausible=5e-6, per_channel=True),)
    sentence = "the junctions of the wiring add a constant thermal voltage"
    shown_by = "the polarity of the leads reversed at block and meter"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return np.broadcast_to(values["emf"], seen.signal.shape)


class WrongGravity(Effect):
    """Local gravity greater than stated in the bench file; not distinguishable from the scale factors."""

    name = "wrong_gravity"
    shows_on = ("building",)
    stage = Stage.SPECIFIC_FORCE
    subsystem = Subsystem.SITE
    parameters = (Parameter("excess", "ppm", 1e-6, plausible=300e-6, per_channel=False),)
    sentence = "local gravity is not what the bench file says"
    shown_by = "a gravimeter, or a survey's value for the place"

    def addition(self, values: Values, seen: Seen) -> Floats:
        return values["excess"] * seen.signal
