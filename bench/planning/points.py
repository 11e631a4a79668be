"""Choice of test points for a bench (installations, angles, repeats), and the procedure file made from them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from bench.base.arrays import HOUR, Floats, Ints
from bench.base.computing import tracked
from bench.base.languages import message
from bench.base.text import APPROACH, exact_degrees, exact_duration
from bench.calibration.design import FIXED
from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import CalibrationError
from bench.config.procedure.plan import Plan, Read
from bench.model.conditions import Mounting
from bench.model.forward import ForwardModel
from bench.planning.optimal_design import (
    WITHOUT_NOISE,
    ExchangeDesign,
    Goal,
    Promise,
    SettingPool,
    Stand,
    best_of,
    checks_of,
    even,
    fewest,
    least_settings,
    parts_of_goals,
    repeats,
    whitened,
    worst,
)
from bench.planning.requirements import Cost, Setting, conditions_of
from bench.readings.table import VERIFICATION

_EVENLY_MOST: Final = 4
"""Largest even spread of settings that is tried, as a multiple of the number found by a search."""
_PARTS_TOLD: Final = 3
_PART_NAMED: Final = 0.01
"""Largest number of irreducible sources in an error message, and their least size relative to the largest."""
_ROUNDS: Final = 4
"""Greatest number of searches, each with tighter goals, to allow for noise estimated from the readings."""


class Sites:
    """All settings that may be chosen: each mounting of `mounts` at each head angle `angle_rad` (a,)."""

    def __init__(self, stand: Stand, mounts: Sequence[Mounting], angle_rad: Floats) -> None:
        self.mounts = tuple(mounts)
        self._kind = _kinds(stand.model, mounts, angle_rad)
        self.angle_rad = angle_rad
        self._rows, problem = whitened(stand, conditions_of(self.settings(range(len(mounts)))))
        self._mount_of_column = np.array([s.mount for s in problem.stand], dtype=np.int64)

    def settings(self, chosen: Iterable[int]) -> list[Setting]:
        """Return one setting at each angle in each chosen mounting; `chosen` are indices of `mounts`."""
        return [
            Setting(self.mounts[m], 1, point, angle, 1)
            for m in chosen
            for point, angle in enumerate(self.angle_rad, start=1)
        ]

    def candidates(self, chosen: Sequence[int]) -> SettingPool:
        """Return the candidate settings, by mounting in the order of `chosen` (indices of `mounts`)."""
        rows = np.concatenate([np.arange(len(self.angle_rad)) + m * len(self.angle_rad) for m in chosen])
        columns = np.concatenate(
            [np.arange(FIXED), FIXED + np.flatnonzero(np.isin(self._mount_of_column, chosen))]
        )
        return SettingPool(self._rows[np.ix_(rows, np.arange(3), columns)])

    def choices(self, most: int) -> Iterator[tuple[int, ...]]:
        """Yield sets of mountings, as tuples of indices, small sets first; of equivalent sets only the first.

        Two mountings are equivalent if the same block axes lie along and across the shaft, up to sign. The block
        then has the same orientations in both mountings, at different head angles.
        """
        for size in range(1, min(most, len(self.mounts)) + 1):
            for chosen in combinations(range(len(self.mounts)), size):
                if all(
                    m == 0 or self._kind[m] not in self._kind[:m] or self._before(m) in chosen for m in chosen
                ):
                    yield chosen

    def _before(self, mount: int) -> int:
        """Return the index of the nearest earlier mounting that is equivalent to `mount`."""
        return max(m for m in range(mount) if self._kind[m] == self._kind[mount])


def _kinds(model: ForwardModel, mounts: Sequence[Mounting], angle_rad: Floats) -> list[tuple[float, ...]]:
    """Return a key for each mounting, equal for equivalent mountings; with asymmetric angles, none are."""
    turned = np.exp(1j * np.concatenate([angle_rad, -angle_rad, np.pi - angle_rad]))
    if len(np.unique(np.round(turned, 6))) > len(angle_rad):
        return [(float(i),) for i in range(len(mounts))]
    turns = (model.installations[m.installation].block_from_platform for m in mounts)
    return [tuple((np.round(np.abs(turn), 6) + 0.0).ravel().tolist()) for turn in turns]


@dataclass(frozen=True)
class ChosenPoints:
    """Chosen test points: visits per mounting and angle (rad), and the uncertainty that a calibration will have."""

    visits: Mapping[Mounting, Mapping[float, int]]
    promise: Promise
    cost: Cost

    @property
    def covariance(self) -> Floats:
        """Covariance (12, 12) of the coefficients that a calibration will state."""
        return self.promise.combined

    @property
    def count(self) -> int:
        """The number of settings."""
        return sum(sum(angles.values()) for angles in self.visits.values())

    @property
    def time_s(self) -> float:
        """Expected bench time, s."""
        return self.cost.total_s(self.count, len(self.visits))

    @property
    def worst(self) -> Goal:
        """The goal that is furthest from being reached."""
        return worst(self.promise.goals, self.promise.readings)

    def u(self, goal: Goal) -> float:
        """Return the standard uncertainty that a calibration will state for a goal of the promise."""
        return goal.u(self.promise.readings)

    def worst_by_name(self) -> list[Goal]:
        """Return, for each goal name, the goal furthest from being reached; many directions share a name."""
        found: dict[str, Goal] = {}
        for goal in self.promise.goals:
            known = found.setdefault(goal.name, goal)
            if self.u(goal) / goal.asked > self.u(known) / known.asked:
                found[goal.name] = goal
        return list(found.values())

    @property
    def reached(self) -> bool:
        """Whether every goal is reached."""
        return self.worst.ratio(self.promise.readings) <= 1 + 1e-9

    @property
    def fit_is_tested(self) -> bool:
        """Whether there are enough repeats for the lack-of-fit test of a calibration."""
        return repeats(conditions_of(self.settings())) >= LEAST_REPEATS

    def settings(self) -> list[Setting]:
        """Return the settings in the order of measurement."""
        return [s for mount, angles in self.visits.items() for s in _in_order(mount, angles)]


@dataclass(frozen=True)
class Passes:
    """Points of one mounting, visited equally often and numbered from `first_point`."""

    first_point: int
    angle_rad: tuple[float, ...]
    directions: tuple[int, ...]


def passes(angles: Mapping[float, int]) -> list[Passes]:
    """Group angles by their number of visits, one group for each number; `angles` maps angles, rad, to visits.

    The first pass of a group has the direction opposite to the last pass of the group before.
    """
    found, first, direction = [], 1, 1
    for times in sorted(set(angles.values()), reverse=True):
        own = tuple(sorted(angle for angle, visits in angles.items() if visits == times))
        directions = tuple(direction * (-1) ** i for i in range(times))
        found.append(Passes(first, own, directions))
        first, direction = first + len(own), -directions[-1]
    return found


def _in_order(mount: Mounting, angles: Mapping[float, int]) -> Iterator[Setting]:
    for group in passes(angles):
        points = list(enumerate(group.angle_rad, start=group.first_point))
        for number, direction in enumerate(group.directions, start=1):
            for point, angle in points if direction > 0 else reversed(points):
                yield Setting(mount, number, point, angle, direction)


# --- the search -------------------------------------------------------------------------------------


_Found = tuple[tuple[int, ...], ExchangeDesign]


def cheapest(
    stand: Stand, sites: Sites, goals: Sequence[Goal], cost: Cost, most_settings: int, most_mounts: int
) -> ChosenPoints:
    """Return the points that reach all goals in the least expected time found.

    Raises `CalibrationError`, with the reason, if no choice of mountings reaches the goals.
    """
    goals, floored = _floored(stand, sites, goals)
    tightened, wider2 = floored, 1.0
    for _ in range(_ROUNDS):
        found = _cheapest(sites, tightened, cost, most_settings, most_mounts)
        if found is None:
            break
        chosen, design = found
        points = _points(stand, sites, chosen, design.counts, goals, cost)
        if not points.reached:
            most = min(_EVENLY_MOST * points.count, most_settings)
            points = _evenly(stand, sites, chosen, range(points.count, most + 1), goals, cost) or points
        if points.reached:
            return points
        wider2 *= max(
            (points.u(goal) ** 2 - least.floor) / (least.asked**2 - least.floor)
            for goal, least in zip(points.promise.goals, floored, strict=True)
        )
        tightened = [least.tightened(wider2) for least in floored]
    raise CalibrationError(_unreachable(stand, sites, floored, most_settings, most_mounts))


def _floored(stand: Stand, sites: Sites, goals: Sequence[Goal]) -> tuple[list[Goal], list[Goal]]:
    """Return the goals after `Goal.relaxed`, and the same goals with the floors for readings at all settings.

    Both lists are the given goals if all settings together do not determine the block.
    """
    everywhere = sites.settings(range(len(sites.mounts)))
    try:
        endless = stand.budget([*everywhere, *checks_of(goals)], WITHOUT_NOISE)
        parts = parts_of_goals(goals, endless)
        asked = [g.relaxed(sum(own.values())) for g, own in zip(goals, parts, strict=True)]
        return asked, list(stand.promise(everywhere, asked).goals)
    except CalibrationError:
        return list(goals), list(goals)  # all settings together do not determine the block, so no choice can


def _evenly(
    stand: Stand,
    sites: Sites,
    chosen: Sequence[int],
    settings: Iterable[int],
    goals: Sequence[Goal],
    cost: Cost,
) -> ChosenPoints | None:
    """Return the smallest even spread of settings that reaches all goals; None if none does.

    The search considers only errors that more readings lower. An even spread also reduces other errors, such as
    those of K2 and K3.
    """
    candidates = sites.candidates(chosen)
    made = (_points(stand, sites, chosen, even(candidates, len(chosen), n), goals, cost) for n in settings)
    return next((points for points in made if points.reached), None)


def _cheapest(
    sites: Sites, goals: Sequence[Goal], cost: Cost, most_settings: int, most_mounts: int
) -> _Found | None:
    best: tuple[float, _Found] | None = None
    for chosen in tracked(list(sites.choices(most_mounts)), "choices of mountings"):
        left = most_settings
        if best is not None:
            left = min(left, cost.settings_within(best[0], len(chosen)))
        design = fewest(sites.candidates(chosen), goals, len(chosen), left)
        if design is not None:
            time_s = cost.total_s(design.settings, len(chosen))
            if best is None or (time_s, design.largest) < (best[0], best[1][1].largest):
                best = time_s, (chosen, design)
    return None if best is None else best[1]


def best_within(
    stand: Stand, sites: Sites, goals: Sequence[Goal], cost: Cost, time_s: float, most_mounts: int
) -> ChosenPoints:
    """Return the points that come closest to the goals within `time_s`.

    Raises `CalibrationError` if the time is too short for a calibration.
    """
    best: tuple[float, _Found] | None = None
    least_s = math.inf
    goals, floored = _floored(stand, sites, goals)
    for chosen in tracked(list(sites.choices(most_mounts)), "choices of mountings"):
        candidates = sites.candidates(chosen)
        whole = ExchangeDesign(candidates, floored)
        if not whole.determines:
            continue
        least_s = min(least_s, cost.total_s(least_settings(candidates), len(chosen)))
        count = cost.settings_within(time_s, len(chosen))
        if count < least_settings(candidates) or (best is not None and whole.limit() >= best[0]):
            continue
        design = best_of(candidates, floored, len(chosen), count)
        if best is None or design.largest < best[0]:
            best = design.largest, (chosen, design)
    if best is None:
        raise CalibrationError(_too_short(time_s, least_s))
    chosen, design = best[1]
    spread = even(sites.candidates(chosen), len(chosen), design.settings)
    made = [_points(stand, sites, chosen, counts, goals, cost) for counts in (design.counts, spread)]
    return min(made, key=lambda points: points.u(points.worst) / points.worst.asked)


def _too_short(time_s: float, least_s: float) -> str:
    if math.isinf(least_s):
        return message(
            "no choice of these installations determines the coefficients; allow more installations or mountings"
        )
    return message(
        f"{time_s / HOUR:.3g} h are too short for a calibration: the shortest takes {least_s / HOUR:.3g} h, "
        "warm-up and verification points included"
    )


def _unreachable(
    stand: Stand, sites: Sites, goals: Sequence[Goal], most_settings: int, most_mounts: int
) -> str:
    designs = [
        (ExchangeDesign(sites.candidates(chosen), goals), chosen) for chosen in sites.choices(most_mounts)
    ]
    limits = [(design.limit(), chosen) for design, chosen in designs if design.determines]
    if not limits:
        return _too_short(0.0, math.inf)
    ratio, chosen = min(limits)
    names = ", ".join(str(sites.mounts[m]) for m in chosen)
    if ratio <= 1:
        return message(
            f"not reached with {most_settings} settings, though installations {names} could with more; "
            "allow more with --most-settings, or average more samples (a smaller voltmeter_error)"
        )
    budget = stand.budget([*sites.settings(chosen), *checks_of(goals)], WITHOUT_NOISE)
    left = zip(goals, parts_of_goals(goals, budget), strict=True)
    goal, parts = max(left, key=lambda one: sum(one[1].values()) / one[0].asked ** 2)
    largest = sorted(parts.items(), key=lambda part: -part[1])[:_PARTS_TOLD]
    told = ", ".join(
        f"{name.replace('_', ' ')} {1e6 * math.sqrt(variance):.3g} µ{goal.unit}"
        for name, variance in largest
        if variance > _PART_NAMED * largest[0][1]
    )
    return message(
        f"cannot be reached by any number of settings: in the best choice of mountings ({names}) the part "
        f"that no reading lowers is {ratio:.3g} times the goal; most of it for {goal.name}: {told}; "
        "reduce these errors, or allow more installations or --visits"
    )


def _points(
    stand: Stand, sites: Sites, chosen: Sequence[int], visited: Ints, goals: Sequence[Goal], cost: Cost
) -> ChosenPoints:
    """Return the chosen points in order, with the covariance that the estimator itself yields."""
    counts = visited.reshape(len(chosen), len(sites.angle_rad))
    visits = {
        sites.mounts[m]: {float(sites.angle_rad[i]): int(row[i]) for i in np.flatnonzero(row)}
        for m, row in zip(chosen, counts, strict=True)
        if row.any()
    }
    settings = [s for mount, angles in visits.items() for s in _in_order(mount, angles)]
    return ChosenPoints(visits, stand.promise(settings, goals), cost)


VERIFICATION_DEG: Final = (45, 135, 225, 315)
SAMPLES: Final = 10
NPLC: Final = 10.0
SETTLE_S: Final = 10.0
"""Verification angles, and samples, NPLC and settling time of a reading, as in the shipped procedures."""


@dataclass(frozen=True)
class Times:
    """Times of operator and bench, s: a turn of the head, a mounting, the soak after it, and the warm-up."""

    turn_s: float = 120.0
    mount_s: float = 1200.0
    soak_s: float = 600.0
    warm_up_s: float = HOUR

    def cost(self, line_hz: float, *, verified: bool) -> Cost:
        """Return the expected time of a setting, of a mounting, and of tasks done once.

        Those tasks are the warm-up and, if `verified`, the verification points at the end.
        """
        read = Read("", "", 1, 1, 1, None, None, SAMPLES, NPLC)
        setting_s = self.turn_s + SETTLE_S + Plan("", (), "").step_duration_s(read, line_hz)
        mount_s = self.mount_s + self.soak_s
        check_s = mount_s + len(VERIFICATION_DEG) * setting_s if verified else 0.0
        return Cost(setting_s, mount_s, self.warm_up_s + check_s)


def procedure_text(
    name: str, remarks: str, visits: Mapping[Mounting, Mapping[float, int]], times: Times, *, verified: bool
) -> str:
    """Return a procedure file: `remarks`, warm-up, mountings and, if `verified`, verification points.

    `visits` maps each mounting to the number of visits to each angle (rad).
    """
    lines = [f"# {line}".rstrip() for line in remarks.splitlines()]
    lines += [
        f"procedure: {name}",
        "title: Test points chosen by bench plan-points",
        "",
        f"reading: {{samples: {SAMPLES}, nplc: {NPLC:g}, settle: {exact_duration(SETTLE_S)}}}",
        "",
        "# For the estimate of the time only.",
        f"operator_time: {{turn: {exact_duration(times.turn_s)}, mount: {exact_duration(times.mount_s)}}}",
        "",
        "steps:",
    ]
    if times.warm_up_s:
        lines.append(
            f"  - wait: {{for: {exact_duration(times.warm_up_s)}, reason: warm-up of block and voltmeters}}"
        )
    for mount, angles in visits.items():
        lines += ["", *_installation(mount.installation, times)]
        for group in passes(angles):
            words = ", ".join(APPROACH[direction] for direction in group.directions)
            angles_text = ", ".join(exact_degrees(angle) for angle in group.angle_rad)
            first = f", first_point: {group.first_point}" if group.first_point > 1 else ""
            lines += [
                "        - repeat:",
                f"            directions: [{words}]",
                "            steps:",
                f"              - turn: {{angles: [{angles_text}]{first}}}",
            ]
    if verified:
        angles_text = ", ".join(f"{angle} deg" for angle in VERIFICATION_DEG)
        lines += ["", *_installation(VERIFICATION, times), f"        - turn: {{angles: [{angles_text}]}}"]
    return "\n".join(lines) + "\n"


def _installation(label: str, times: Times) -> list[str]:
    lines = ["  - installation:", f"      label: {label}", "      steps:"]
    if times.soak_s:
        lines.append(
            f"        - wait: {{for: {exact_duration(times.soak_s)}, reason: the block settles after mounting}}"
        )
    return lines
