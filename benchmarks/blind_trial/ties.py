"""Can the data tell an effect from every other? By the table of ties, or by the signatures themselves."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np

from benchmarks.blind_trial.cases import MOST_TIMES_PLAUSIBLE, Answer, Case
from benchmarks.blind_trial.designs import Weather, make_run
from benchmarks.blind_trial.effects import CATALOGUE
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.signals import SETTING_SIGMA, Visibility, signature, visibility

CanTell = Callable[[Case, Answer], bool]

_DIRECTION_TIES: Final = frozenset({"backlash", "zero_offset"})
_SHAPE_TIES: Final = frozenset({"quadratic_nonlinearity", "scale_asymmetry", "odd_quadratic_nonlinearity"})
_TIED: Final = frozenset(
    {
        "cross_quadratic",
        "cubic_nonlinearity",
        "head_ellipticity",
        "axis_wobble",
        "cross_coupling",
        "mounting_error",
        "mounting_offset",
        "hysteresis",
        "turn_on_shift",
        "bracket_tilt",
        "axis_tilt",
        "warm_up",
        "bias_drift",
        "thermal_bias",
        "voltmeter_nonlinearity",
        "voltmeter_drift",
        "foundation_tilt",
        *_DIRECTION_TIES,
        *_SHAPE_TIES,
    }
)
"""Effects with a rival of cosine 0.95 or more in the paper's design (`effects.md`, table of ties)."""

_BROKEN: Final[dict[str, frozenset[str]]] = {
    "both": _DIRECTION_TIES | {"hysteresis"},
    "turn-12": _SHAPE_TIES | {"cubic_nonlinearity"},
    "return": frozenset({"warm_up", "turn_on_shift", "bracket_tilt"}),
    "remount-180": frozenset({"mounting_error", "mounting_offset", "bracket_tilt", "axis_tilt"}),
    "reordered": _DIRECTION_TIES
    | {"hysteresis", "mounting_error", "mounting_offset", "bracket_tilt", "axis_tilt", "voltmeter_drift"},
}
"""What a design tells all the same."""

PLAINER_THAN: Final[dict[str, frozenset[str]]] = {
    "head_eccentricity": frozenset({"head_graduation"}),
    "head_ellipticity": frozenset({"head_graduation"}),
    "quadratic_nonlinearity": frozenset({"cross_quadratic"}),
}
"""Larger families of the same subsystem that contain an effect: the plainer one is to be named first."""

LEFT_TO_TELL: Final = 4.0
"""In units of noise: what the nearest rival must leave, so that the nearer of the two is the true one in 98 %."""
DRAWS: Final = 48


def can_tell_by_table(case: Case, answer: Answer) -> bool:
    """Say by the static table of ties whether the effect of a case has no rival in its design."""
    tied = _TIED - _BROKEN.get(case.design, frozenset())
    return not tied.intersection(answer.names)


def can_tell_by_signature(case: Case, answer: Answer) -> bool:
    """Say whether every other effect of the trial's vocabulary leaves `LEFT_TO_TELL` of the hidden one."""
    return all(
        effect.rho * np.sqrt(max(0.0, 1 - nearest_rival(answer, which) ** 2)) >= LEFT_TO_TELL
        for which, effect in enumerate(answer.effects)
    )


def nearest_rival(answer: Answer, which: int = 0) -> float:
    """Return the largest cosine between what is left of a hidden effect and any other effect's, 0 to 1.

    The other effect may have any weights of its channels and mountings, but one shape at a time; effects
    that would have to be implausibly large are no rivals, nor are larger families that contain the effect.
    """
    row, effect = answer.row, answer.effects[which]
    seen = _seen(row.design, row.noise_v * row.noise_factor, row.noise_factor)
    left = seen.left(effect.change)
    left /= np.linalg.norm(left)
    without = {effect.name, *PLAINER_THAN.get(effect.name, ())}
    cosines = [
        float(np.linalg.norm(basis.T @ left))
        for name in CATALOGUE
        if name not in without
        for basis in _subspaces(name, row.design, row.noise_v * row.noise_factor, row.noise_factor)
    ]
    return min(1.0, max(cosines))


def _seen(design: str, noise_v: float, factor: float) -> Visibility:
    return visibility(design, noise_v, SETTING_SIGMA * factor)


@cache
def _subspaces(name: str, design: str, noise_v: float, factor: float) -> tuple[Floats, ...]:
    """Orthonormal bases of what is left of an effect, one for each of its shapes, in a typical weather."""
    rng = np.random.default_rng(0)
    run = make_run(design).with_weather(Weather(phase=1.0))
    seen = _seen(design, noise_v, factor)
    by_shape: dict[str, list[Floats]] = {}
    for _ in range(DRAWS):
        truth = CATALOGUE[name](rng, run)
        left = seen.left(signature(run, truth))
        size = float(np.linalg.norm(left))
        if size * MOST_TIMES_PLAUSIBLE >= LEFT_TO_TELL:
            by_shape.setdefault(truth.shape, []).append(left / size)
    bases = []
    for members in by_shape.values():
        u, s, _ = np.linalg.svd(np.array(members).T, full_matrices=False)
        bases.append(u[:, s > 1e-3 * s[0]])
    return tuple(bases)
