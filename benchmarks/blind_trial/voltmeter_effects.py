"""Effects of voltmeter and wiring: in V on what is read; and the hidden ones, which no reading shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.stand_effects import wobble
from benchmarks.blind_trial.truth import CHANNELS, Draw, Shift, Truth, channel_weights

MICROVOLT: Final = 1e-6
PPM: Final = 1e-6
FULL: Final = 2.5
AUTORANGE_BELOW_V: Final = 1.2


def _voltmeter_nonlinearity(rng: np.random.Generator, run: Run) -> Truth:
    """The same bow in every channel: a power, or half a period of a cosine or sine as real converters have."""
    shapes: dict[str, Callable[[Floats], Floats]] = {
        "square": lambda u: u**2,
        "cube": lambda u: u**3,
        "even bow": lambda u: 1 - np.cos(np.pi * u / 2),
        "odd bow": lambda u: np.sin(np.pi * u),
    }
    shape = str(rng.choice(list(shapes)))
    sign = rng.choice([-1.0, 1.0])
    bow = shapes[shape]

    def act(_: Run, volts: Floats, x: float) -> Floats:
        return np.asarray(sign * 10 * MICROVOLT * x * bow(volts / FULL))

    return Truth("voltmeter_nonlinearity", "voltmeter", act, channels=CHANNELS, shape=shape)


def _voltmeter_drift(rng: np.random.Generator, run: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])

    def act(r: Run, volts: Floats, x: float) -> Floats:
        return np.asarray(sign * 15 * MICROVOLT * x * r.time_s[:, None] / 3600 * np.ones_like(volts))

    return Truth("voltmeter_drift", "voltmeter", act, channels=CHANNELS)


def _range_offset(rng: np.random.Generator, run: Run) -> Truth:
    """One meter with autorange for all channels, or one of three meters."""
    offset, gain = rng.normal(size=2) * (40 * MICROVOLT, 20 * PPM)
    one = rng.random() < 0.5
    weights = np.eye(3)[rng.integers(3)] if one else np.ones(3)

    def act(_: Run, volts: Floats, x: float) -> Floats:
        return np.asarray(x * weights * (np.abs(volts) < AUTORANGE_BELOW_V) * (offset + gain * volts))

    return Truth(
        "range_offset",
        "voltmeter",
        act,
        channels=tuple(c for c, w in zip(CHANNELS, weights, strict=True) if w),
        shape="one meter of three" if one else "one meter for all",
        parameters={"offset_v": float(offset), "gain": float(gain)},
    )


def _channel_crosstalk(rng: np.random.Generator, run: Run) -> Truth:
    """The input has not quite settled from the reading before; the first one follows an open input."""
    sign = rng.choice([-1.0, 1.0])

    def act(r: Run, volts: Floats, x: float) -> Floats:
        order = np.where((r.scan == "zyx")[:, None], [2, 1, 0], [0, 1, 2])
        in_turn = np.take_along_axis(volts, order, axis=1).ravel()
        memory = (np.concatenate([[0.0], in_turn[:-1]]) - in_turn).reshape(-1, 3)
        return np.asarray(sign * 25 * PPM * x * np.take_along_axis(memory, np.argsort(order, axis=1), axis=1))

    return Truth("channel_crosstalk", "voltmeter", act, channels=CHANNELS)


VOLTMETER: Final[dict[str, Draw]] = {
    "voltmeter_nonlinearity": _voltmeter_nonlinearity,
    "voltmeter_drift": _voltmeter_drift,
    "range_offset": _range_offset,
    "channel_crosstalk": _channel_crosstalk,
}


def _common(name: str, size: float, power: int) -> Draw:
    """Return the draw of a common constant (power 0) or factor (power 1) of the readings."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        sign = rng.choice([-1.0, 1.0])
        return Truth(name, "voltmeter", lambda _, volts, x: sign * size * x * volts**power, channels=CHANNELS)

    return draw


def _thermal_emf(rng: np.random.Generator, run: Run) -> Truth:
    weights, channels = channel_weights(rng)
    return Truth(
        "thermal_emf",
        "voltmeter",
        lambda _, volts, x: 5 * MICROVOLT * x * weights * np.ones_like(volts),
        channels=channels,
    )


def _wrong_gravity(rng: np.random.Generator, run: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])
    return Truth("wrong_gravity", "stand", shift=lambda _, x: {"gravity": sign * 300 * PPM * x})


def _wobble_cosine(rng: np.random.Generator, run: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])

    def shift(r: Run, x: float) -> Shift:
        return {"tilt": sign * wobble(1, np.pi / 2, r, 5 * x)}

    return Truth("axis_wobble", "stand", shift=shift, shape="cosine once a turn")


def _common_turn(rng: np.random.Generator, run: Run) -> Truth:
    """All the axes turned together in the block's housing: the coefficients take it up."""
    axis = rng.normal(size=3)
    axis *= 90 * ARCSEC / np.linalg.norm(axis)

    def act(_: Run, force: Floats, x: float) -> Floats:
        return np.cross(force, x * axis)

    return Truth("common_turn", "block", act, channels=CHANNELS)


HIDDEN: Final[dict[str, Draw]] = {
    "voltmeter_gain": _common("voltmeter_gain", 30 * PPM, 1),
    "voltmeter_offset": _common("voltmeter_offset", 50 * MICROVOLT, 0),
    "thermal_emf": _thermal_emf,
    "wrong_gravity": _wrong_gravity,
    "axis_wobble": _wobble_cosine,
    "common_turn": _common_turn,
}
"""Nothing of them is left in the residuals of a calibration; `common_turn` has no name in the vocabulary."""
