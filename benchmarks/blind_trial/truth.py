"""A hidden effect of the trial: where it acts, how large, and in which form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.geometry import Floats

Stage = Literal["stand", "block", "voltmeter"]
Act = Callable[[Run, Floats, float], Floats]
Shift = dict[str, Floats | float]
CHANNELS: Final = ("x", "y", "z")


@dataclass(frozen=True)
class Truth:
    """One effect with drawn parameters, ready to act on a run.

    `amplitude` is in units of the plausible size (1 σ of `effects.md`). What acts is one of:
    `shift(run, amplitude)` for the stand: rad (n,) to add to `angle`, `tilt` (α1), `skew` (α3) or `roll` (α5),
    or `gravity` as a relative change; `act(run, force, amplitude)` for the block: g (n, 3), scaled by K_ii;
    `act(run, volts, amplitude)` for the voltmeter: V (n, 3). `shape` names what does not enter linearly.
    """

    name: str
    stage: Stage
    act: Act | None = None
    shift: Callable[[Run, float], Shift] | None = None
    amplitude: float = 1.0
    channels: tuple[str, ...] = ()
    mounts: tuple[str, ...] = ()
    shape: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)

    def scaled(self, amplitude: float) -> Truth:
        return replace(self, amplitude=amplitude)


Draw = Callable[[np.random.Generator, Run], Truth]
"""Draws the parameters of an effect for a run."""


def channel_weights(rng: np.random.Generator) -> tuple[Floats, tuple[str, ...]]:
    """Draw one, two or three channels with signed weights of 0.5 to 1; the rest is zero."""
    count = int(rng.choice([1, 2, 3], p=[0.5, 0.25, 0.25]))
    chosen = np.sort(rng.choice(3, count, replace=False))
    weights = np.zeros(3)
    weights[chosen] = rng.choice([-1.0, 1.0], count) * rng.uniform(0.5, 1.0, count)
    return weights, tuple(CHANNELS[i] for i in chosen)


def mount_weights(
    rng: np.random.Generator, run: Run, *, after_remount: bool = False
) -> tuple[Floats, tuple[str, ...]]:
    """Draw one or more mountings of the calibration with signed weights of 0.5 to 1.

    With `after_remount` the first mounting is what the others are compared with and stays zero. Returns the
    weights for the rows (n,) and the labels of the mountings.
    """
    mounts = run.calibration_mounts[1 if after_remount else 0 :]
    count = int(rng.integers(1, len(mounts) + 1))
    chosen = np.sort(rng.choice(mounts, count, replace=False))
    weights = np.zeros(int(run.mount.max()) + 1)
    weights[chosen] = rng.choice([-1.0, 1.0], count) * rng.uniform(0.5, 1.0, count)
    return weights[run.mount], tuple(str(run.labels[(run.mount == m) & run.measured][0]) for m in chosen)
