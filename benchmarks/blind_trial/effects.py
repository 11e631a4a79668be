"""The trial's own vocabulary of effects, in the names of `bench diagnose`."""

from __future__ import annotations

from typing import Final

from benchmarks.blind_trial.block_effects import BLOCK
from benchmarks.blind_trial.outside_effects import OUTSIDE
from benchmarks.blind_trial.stand_effects import STAND
from benchmarks.blind_trial.truth import Draw
from benchmarks.blind_trial.voltmeter_effects import HIDDEN, VOLTMETER

SEEN_IN_VERIFICATION: Final = "mounting_roll"
CATALOGUE: Final[dict[str, Draw]] = {
    name: draw for name, draw in {**BLOCK, **STAND, **VOLTMETER}.items() if name != SEEN_IN_VERIFICATION
}
"""What residuals of a calibration can show, name to draw. `mounting_roll` needs the verification points."""

CLASSES: Final[dict[str, tuple[str, ...]]] = {
    "even": ("quadratic_nonlinearity", "cross_quadratic", "scale_asymmetry", "voltmeter_nonlinearity"),
    "odd": ("cubic_nonlinearity", "odd_quadratic_nonlinearity", "head_ellipticity"),
    "product": ("cross_coupling", "axis_wobble"),
    "time": (
        "warm_up",
        "bias_drift",
        "turn_on_shift",
        "thermal_bias",
        "voltmeter_drift",
        "bracket_tilt",
        "axis_tilt",
    ),
    "mount": (
        "mounting_error",
        "mounting_offset",
        "zero_offset",
        "backlash",
        "hysteresis",
        "foundation_tilt",
    ),
    "scale": ("scale_drift", "thermal_scale"),
    "head": ("head_eccentricity", "head_graduation"),
    "range": ("range_offset",),
    "memory": ("channel_crosstalk",),
}
"""Kinds whose members look alike in the paper's design; two effects of a pair are of different kinds."""

CLASS_OF: Final = {name: kind for kind, names in CLASSES.items() for name in names}

__all__ = [
    "BLOCK",
    "CATALOGUE",
    "CLASSES",
    "CLASS_OF",
    "HIDDEN",
    "OUTSIDE",
    "SEEN_IN_VERIFICATION",
    "STAND",
    "VOLTMETER",
]
