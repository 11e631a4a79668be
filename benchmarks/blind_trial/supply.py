"""A block that is fed by two rails whose voltages are recorded: one that follows them, and one that drifts beside.

The supply is a poor one: each rail is off by some 50 mV, goes up and down with what else hangs on the mains, and
wanders. What is recorded is rounded to a millivolt, with a millivolt of noise.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from benchmarks.blind_trial.block_effects import BLOCK
from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.truth import Truth, channel_weights

SENSITIVE: Final = "supply"
DRIFTING: Final = "supply:drift"
SUPPLIED: Final = (SENSITIVE, DRIFTING)
NOMINAL_V: Final = (15.0, -15.0)
NAMES: Final = ("p15", "n15")


def courses(rng: np.random.Generator, run: Run) -> Floats:
    """Return the voltages of the two rails less their nominal ones, V, shape (n, 2)."""
    apart_h = np.diff(run.time_s, prepend=run.time_s[0]) / 3600.0
    rails = []
    for _ in NOMINAL_V:
        wandered = np.cumsum(rng.normal(0, 0.05, len(run.time_s)) * np.sqrt(apart_h))
        period_s, phase = rng.uniform(40, 120) * 60, rng.uniform(0, 2 * np.pi)
        cycle = rng.uniform(0.05, 0.2) * np.sin(2 * np.pi * run.time_s / period_s + phase)
        rails.append(rng.normal(0, 0.05) + cycle + wandered)
    return np.stack(rails, axis=1)


def sensitive(rng: np.random.Generator, run: Run, above_v: Floats) -> Truth:
    """Bias, scale factor or both follow one of the rails."""
    weights, channels = channel_weights(rng)
    rail = int(rng.integers(len(NAMES)))
    bias, scale = ((1.0, 0.0), (0.0, 1.0), (0.7, -0.7))[int(rng.integers(3))]

    def act(_: Run, force: Floats, x: float) -> Floats:
        return x * 20e-6 * weights * above_v[:, rail, None] * (bias + scale * force)

    return Truth("supply_sensitivity", "block", act, channels=channels, shape=NAMES[rail])


def drifting(rng: np.random.Generator, run: Run, above_v: Floats) -> Truth:
    """A drift of the bias in time, whatever the rails do."""
    return BLOCK["bias_drift"](rng, run)


def recorded(rng: np.random.Generator, above_v: Floats) -> dict[str, Any]:
    """Return the columns of a readings table."""
    columns: dict[str, Any] = {}
    for name, nominal_v, above in zip(NAMES, NOMINAL_V, above_v.T, strict=True):
        measured = np.round(nominal_v + above + rng.normal(0, 1e-3, len(above)), 3)
        columns[f"rail_{name}_v"] = np.array([f"{v:.3f}" for v in measured])
        columns[f"rail_{name}_nominal_v"] = np.array([f"{nominal_v:g}"] * len(above))
    return columns


def judge_supply(kind: str, diagnosis: dict[str, Any]) -> dict[str, bool]:
    """Return what can be said of a diagnosis of one of these kinds."""
    verdict = diagnosis["verdict"]
    own, other = "supply_sensitivity", "bias_drift"
    if kind == DRIFTING:
        own, other = other, own
    sets = [{e["name"], *e.get("cannot_tell_from", ())} for e in diagnosis["effects"]]
    said = set().union(*sets)
    marks = {
        "detected": verdict != "agrees",
        "in the set": own in said,
        f"told from {other}": own in said and other not in said,
        "alone given": verdict == "named",
    }
    if verdict == "named":
        marks["alone right"] = said == {own}
    return marks
