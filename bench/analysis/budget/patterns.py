"""What each error of a bench does to the signals, and which of them share a draw of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.budget.influence import Influence
from bench.analysis.budget.seen import Seen
from bench.analysis.budget.setup import Setup
from bench.base.arrays import Floats, Ints
from bench.model import STAND_ANGLES

_Patterns = Sequence[tuple[Floats, Ints]]
"""What a unit of a source does to the signals, V (n, 3), and what shares a draw of it, as `Influence.of`."""

_SAME_ANGLE_RAD: Final = math.radians(0.05)
"""Settings no further apart than this have the error of one angle of the head."""

_EVERYTHING: Final = np.zeros((1, 1), dtype=np.int64)


def influences(source: ErrorSource, setup: Seen) -> tuple[Influence, ...]:
    """Return how a unit of the source acts on readings; parts of it are independent.

    Those of the stand and of effects act on a `Setup` alone: on readings that were taken a fit has them.
    """
    if isinstance(setup, Setup) and source.effect is not None:
        column = setup.effect_problem.effects.index(source.effect)
        patterns: _Patterns = [(setup.effect_columns[:, :, column], _EVERYTHING)]
    elif isinstance(setup, Setup) and (source.name in STAND_ANGLES or source.angles):
        mount = setup.conditions.mount[:, None]
        patterns = [(setup.stand_slope(name), mount) for name in source.angles or (source.name,)]
    else:
        patterns = _PATTERNS[source.kind](source, setup)
    return tuple(Influence.of(pattern, group) for pattern, group in patterns)


def _linearity(source: ErrorSource, setup: Seen) -> _Patterns:
    # the same voltage gives the same error: repeats do not average it; channels have voltages of their own
    return [(np.ones_like(setup.signal) * source.on_channels, 3 * setup.orientation[:, None] + np.arange(3))]


def _same_angle(setup: Seen) -> Ints:
    """Return a number for each reading, shape (n,): the same where the head stands at one angle of its scale."""
    angle_rad = np.mod(setup.conditions.angle_rad + _SAME_ANGLE_RAD, math.tau)
    order = np.argsort(angle_rad, kind="stable")
    numbers = np.empty(len(order), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(np.diff(angle_rad[order]) > _SAME_ANGLE_RAD)])
    return numbers


def _temperature(source: ErrorSource, seen: Seen) -> _Patterns:
    """A course that nobody knows, within the limits, and beside it the one that was recorded."""
    courses = list(_wandering(seen.conditions.elapsed_s).T)
    known = seen.conditions.warmth_k - seen.conditions.warmth_k.mean()
    if source.u > 0 and np.any(known):
        courses.append(known / source.u)
    return [pattern for course in courses for pattern in _warmed(source, seen, course)]


def _thermometer(source: ErrorSource, seen: Seen) -> _Patterns:
    return _warmed(source, seen, np.ones(len(seen.signal)))


def _supply(source: ErrorSource, seen: Seen) -> _Patterns:
    """A course that nobody knows, within the limits; of one that was recorded, it and what it is off throughout."""
    rail, above_v = int((source.factors or {})["rail"]) - 1, seen.conditions.above_nominal_v
    if source.u > 0 and rail < above_v.shape[1]:
        courses = [np.ones(len(seen.signal)), (above_v[:, rail] - above_v[:, rail].mean()) / source.u]
    else:
        courses = list(_wandering(seen.conditions.elapsed_s).T)
    return [pattern for course in courses for pattern in _warmed(source, seen, course)]


def _turn_on(source: ErrorSource, seen: Seen) -> _Patterns:
    # all of a run alike: another switching-on of the block moves each bias by as much
    return [
        (
            np.broadcast_to(np.diag(seen.block.K) * source.on_channels, seen.signal.shape),
            np.arange(3)[None, :],
        )
    ]


def _warmed(source: ErrorSource, seen: Seen, course: Floats) -> _Patterns:
    # the coefficients' signs are not known, so that bias and scale of each channel move on their own
    factors = source.factors or {}
    group = np.arange(3)[None, :]
    sensed = seen.force @ seen.block.K.T
    sensed = sensed * source.on_channels
    bias = np.broadcast_to(np.diag(seen.block.K) * source.on_channels, sensed.shape)
    return [(factors[of] * acts * course[:, None], group) for of, acts in (("bias", bias), ("scale", sensed))]


WANDERS_S: Final = 3600.0
"""In so long a temperature that nobody knows becomes another one, within its limits."""
HARDLY_ANY: Final = 1e-3
"""Shapes of a course that are this part of it together with others are left out."""


def _wandering(time_s: Floats) -> Floats:
    """Return the shapes (n, q) of a stationary process of unit variance that forgets itself in `WANDERS_S`."""
    apart = np.abs(time_s[:, None] - time_s)
    size, shapes = np.linalg.eigh(np.exp(-apart / WANDERS_S))
    kept = size > HARDLY_ANY * size.sum()
    return np.asarray(shapes[:, kept] * np.sqrt(size[kept]))


def _power(exponent: int) -> Callable[[ErrorSource, Seen], _Patterns]:
    def act(source: ErrorSource, setup: Seen) -> _Patterns:
        factor = np.diag(setup.block.K) * source.on_channels
        return [(factor * setup.force**exponent, np.arange(3)[None, :])]

    return act


_PATTERNS: Final[Mapping[str, Callable[[ErrorSource, Seen], _Patterns]]] = {
    "voltmeter_error": lambda own, s: [
        (np.ones_like(s.signal) * own.on_channels, np.arange(s.signal.size).reshape(-1, 3))
    ],
    "setting_error": lambda _, s: [(s.setting_slope, np.arange(len(s.conditions))[:, None])],
    "voltmeter_gain": lambda own, s: [(s.signal * own.on_channels, np.array(s.meters)[None, :])],
    "voltmeter_offset": lambda own, s: [
        (np.ones_like(s.signal) * own.on_channels, np.array(s.meters)[None, :])
    ],
    "head_table": lambda _, s: [(s.setting_slope, _same_angle(s)[:, None])],
    "voltmeter_linearity": _linearity,
    "gravity": lambda _, s: [(s.force @ s.block.K.T, _EVERYTHING)],
    "temperature": _temperature,
    "thermometer": _thermometer,
    "supply_voltage": _supply,
    "turn_on": _turn_on,
    "K2": _power(2),
    "K3": _power(3),
}
