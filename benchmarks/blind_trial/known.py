"""What is known of a bench, and what comes after a mistake: cases that other rows do not have.

`other_psi`: nothing is missing, and the bench file states another angle of the verification points than they have.
`common_volts`: a voltage that the three channels share settles with two time constants. `hand_set`: six positions
set by hand, each off by its own half a degree, and nothing else. `repaired`: an outlier beside an effect.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.truth import Shift, Truth

OTHER_PSI: Final = "other_psi"
COMMON_VOLTS: Final = "common_volts"
HAND_SET: Final = "hand_set"
REPAIRED: Final = "repaired"
KNOWN: Final = (OTHER_PSI, COMMON_VOLTS, HAND_SET, REPAIRED)
TILT_RAD: Final = float(np.radians(0.5))
ELECTRICS: Final = frozenset({"voltmeter_warm_up", "voltmeter_drift"})
NOT_TOLD: Final = frozenset({"voltmeter_gain", "wrong_gravity"})


def stated_psi_deg(rng: np.random.Generator) -> float:
    """Draw what a bench file says of the verification points, which stand at 45°."""
    return float(rng.choice([rng.uniform(5, 35), rng.uniform(55, 85)]))


def common_volts(rng: np.random.Generator, run: Run) -> Truth:
    """The same voltage in all channels: two thirds of it are gone in 8 to 15 min, the rest in 25 to 50."""
    fast, slow = rng.uniform(8, 15) * 60, rng.uniform(25, 50) * 60
    part = 0.67 * np.exp(-run.time_s / fast) + 0.33 * np.exp(-run.time_s / slow)
    sign = rng.choice([-1.0, 1.0])

    def act(_: Run, volts: Floats, x: float) -> Floats:
        return np.broadcast_to(sign * 100e-6 * x * part[:, None], volts.shape)

    return Truth("voltmeter_warm_up", "voltmeter", act, channels=("x", "y", "z"))


def hand_set(rng: np.random.Generator, run: Run) -> Truth:
    """Each setting off by its own angles, in the plane of the head and out of it."""
    off = rng.normal(0, TILT_RAD, (3, len(run.mount)))

    def shift(_: Run, x: float) -> Shift:
        return {"angle": x * off[0], "skew": x * off[1], "roll": x * off[2]}

    return Truth("hand_set", "stand", shift=shift)


def judge_known(kind: str, truth: tuple[str, ...], diagnosis: dict[str, Any]) -> dict[str, bool]:
    """Return what can be said of a diagnosis of one of these kinds."""
    verdict = diagnosis["verdict"]
    names = [{e["name"], *e.get("cannot_tell_from", ())} for e in diagnosis["effects"]]
    if kind == OTHER_PSI:
        told = diagnosis["verification_orientation"]
        return {
            "agrees": verdict == "agrees",
            "contradiction told": bool(told) and told["contradicts_bench_file"],
            "hidden listed": set(diagnosis["hidden"]) >= NOT_TOLD,
        }
    if kind == HAND_SET:
        return {"no mistake alleged": verdict != "mistake"}
    if kind == COMMON_VOLTS:
        found = verdict != "agrees"
        return {"detected": found, "points at the electrics": any(one & ELECTRICS for one in names)}
    return {
        "mistake found": verdict == "mistake",
        "the effect in the set": any(truth[0] in one for one in names),
    }
