"""Effects that a user states as formulas (`own-effects.yaml`), in forms of the trial's own."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.truth import Draw, Shift, Truth, channel_weights

FORMULAS: Final = Path(__file__).with_name("own-effects.yaml")
"""What the diagnosis is given; the truths below know nothing of it."""


def _turns(run: Run) -> Floats:
    """Whole turns since the block was mounted, of a head that goes on in its direction and is never unwound."""
    return (run.pass_number - 1) + run.head_angle / (2 * np.pi)


def _cable_pull(rng: np.random.Generator, _: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])

    def shift(run: Run, x: float) -> Shift:
        return {"skew": sign * x * 20 * ARCSEC * _turns(run)}

    return Truth("cable_pull", "stand", shift=shift)


def _fourth_power(rng: np.random.Generator, _: Run) -> Truth:
    weights, channels = channel_weights(rng)

    def act(_: Run, force: Floats, x: float) -> Floats:
        return np.asarray(x * 20e-6 * weights * np.square(np.square(force)))

    return Truth("fourth_power", "block", act, channels=channels)


def _after_effect(rng: np.random.Generator, _: Run) -> Truth:
    """A relaxation of two lengths, neither of which is one that is tried."""
    weights, channels = channel_weights(rng)
    length = float(rng.choice([0.35, 0.7, 1.4]))

    def act(run: Run, _: Floats, x: float) -> Floats:
        turns = _turns(run)
        left = 0.8 * np.exp(-turns / length) + 0.2 * np.exp(-turns / (0.3 * length))
        return np.asarray(x * 100e-6 * weights * left[:, None])

    return Truth("after_effect", "block", act, channels=channels, shape=f"{length:g} turns")


def _rectified_crosstalk(rng: np.random.Generator, _: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])

    def act(_: Run, volts: Floats, x: float) -> Floats:
        size = np.abs(volts)
        return np.asarray(sign * x * 25e-6 * (np.roll(size, 1, axis=1) + np.roll(size, 2, axis=1)))

    return Truth("rectified_crosstalk", "voltmeter", act)


OWN: Final[dict[str, Draw]] = {
    "cable_pull": _cable_pull,
    "fourth_power": _fourth_power,
    "after_effect": _after_effect,
    "rectified_crosstalk": _rectified_crosstalk,
}
