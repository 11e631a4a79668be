"""What each error of a bench does to the signals, and which signals share a draw of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.calibration.budget.error_source import NAME as FOUNDATION
from bench.calibration.budget.error_source import ErrorSource, tilt_patterns
from bench.calibration.budget.setup import Setup
from bench.model.conditions import Conditions
from bench.model.geometry import STAND_ANGLES, Block


@dataclass(frozen=True)
class Influence:
    """What one unit of an error does to the signals of n readings.

    `pattern` (n, 3) is in V per unit of the error; entries with the same number in `group` (n, 3), counted
    from 0 to `draws` - 1, share one draw of it.
    """

    pattern: Floats
    group: Ints
    draws: int

    @classmethod
    def of(cls, pattern: Floats, group: Ints) -> Influence:
        """Build from a pattern (n, 3) and labels that broadcast to it: equal labels share a draw."""
        labels, numbers = np.unique(np.broadcast_to(group, pattern.shape), return_inverse=True)
        return cls(pattern, numbers.reshape(pattern.shape), len(labels))

    def through(self, functionals: Floats) -> Floats:
        """Return what each draw, one unit large, adds to m linear functionals (m, n, 3) of the readings.

        Shape (m, draws).
        """
        m = len(functionals)
        flat: Floats = (functionals * self.pattern).reshape(m, -1)
        group = self.group.ravel()
        if self.draws == flat.shape[1] and np.array_equal(group, np.arange(self.draws)):
            return flat
        shared = np.zeros((flat.shape[1], self.draws))
        shared[np.arange(len(group)), group] = 1.0
        return flat @ shared

    def on_readings(self, drawn: Floats) -> Floats:
        """Return the errors (…, n, 3) of the readings for drawn errors (…, draws)."""
        return drawn[..., self.group] * self.pattern


class Seen(Protocol):
    """What an error needs to know of n readings."""

    @property
    def signal(self) -> Floats:
        """The signals, V, shape (n, 3)."""

    @property
    def force(self) -> Floats:
        """The specific forces on the block, g, shape (n, 3)."""

    @property
    def setting_slope(self) -> Floats:
        """du/dphi, V/rad, shape (n, 3)."""

    @property
    def orientation(self) -> Ints:
        """A number for each reading, shape (n,): the same where the specific force is the same."""

    @property
    def conditions(self) -> Conditions:
        """Where, when and how warm each reading is."""

    @property
    def block(self) -> Block:
        """The block that they are of."""

    @property
    def meters(self) -> tuple[int, int, int]:
        """The number of the voltmeter of x, y and z."""


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
    elif isinstance(setup, Setup) and source.name == FOUNDATION:
        tilts = tilt_patterns(setup.conditions, setup.block, setup.setting_slope, setup.model.installations)
        patterns = [(tilt, _EVERYTHING) for tilt in tilts]
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
    return _off_and_known(source, seen, seen.conditions.warmth_k)


def _supply(source: ErrorSource, seen: Seen) -> _Patterns:
    rail, above_v = int((source.factors or {})["rail"]) - 1, seen.conditions.above_nominal_v
    return _off_and_known(
        source, seen, above_v[:, rail] if rail < above_v.shape[1] else np.zeros(len(above_v))
    )


def _off_and_known(source: ErrorSource, seen: Seen, recorded: Floats) -> _Patterns:
    """Return what is off within the limits and nobody knows, and the course that was `recorded` (n,)."""
    courses = list(_unknown(seen.conditions.elapsed_s, source.correlation_s).T)
    known = recorded - recorded.mean()
    if source.u > 0 and np.any(known):
        courses.append(known / source.u)
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


HARDLY_ANY: Final = 1e-3
"""Shapes of a course that are this part of it together with others are left out."""


def _unknown(time_s: Floats, correlation_s: float) -> Floats:
    """Return the shapes (n, q) of a stationary process of unit variance; one shape where it is an offset.

    Limits alone say nothing of a course within them, and passes average no offset (GUM, 4.3.7).
    """
    if math.isinf(correlation_s):
        return np.ones((len(time_s), 1))
    apart = np.abs(time_s[:, None] - time_s)
    size, shapes = np.linalg.eigh(np.exp(-apart / correlation_s))
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
    "thermometer": lambda own, s: _warmed(own, s, np.ones(len(s.signal))),
    "supply_voltage": _supply,
    "turn_on": _turn_on,
    "K2": _power(2),
    "K3": _power(3),
}
