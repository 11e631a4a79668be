"""Settings of the head that a plan foresees, and what would show that which they leave open."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from bench.calibration.design import make_problem
from bench.calibration.observability import (
    DirectionKind,
    Observability,
    axis_in_words,
    observability,
    with_angles,
)
from bench.config.procedure.plan import Plan, Read, Turn, Wait
from bench.model.conditions import Conditions, Mounting
from bench.model.forward import ForwardModel
from bench.model.geometry import Block, Installation
from bench.readings.table import UNORIENTED, VERIFICATION


class Setting(NamedTuple):
    """One reading of a mounted block: which mounting, pass and point, the head's angle, from which side."""

    mount: Mounting
    pass_number: int
    point: int
    angle_rad: float
    direction: int


def conditions_of(settings: Sequence[Setting]) -> Conditions:
    """Return the conditions of readings at these settings; time and temperature are not known beforehand."""
    return Conditions.of(
        [s.mount.installation for s in settings],
        [s.angle_rad for s in settings],
        series=[s.mount.series for s in settings],
        pass_number=[s.pass_number for s in settings],
        point=[s.point for s in settings],
        direction=[s.direction for s in settings],
    )


def settings_of(plan: Plan) -> list[Setting]:
    """Return the settings at which a plan reads the mounted block, verification points among them."""
    return [
        Setting(
            Mounting(step.series, step.installation),
            step.pass_number,
            step.point,
            step.target_rad,
            step.direction or 0,
        )
        for step in plan.steps
        if isinstance(step, Read) and step.target_rad is not None and step.installation not in UNORIENTED
    ]


def fitted(settings: Iterable[Setting]) -> list[Setting]:
    """Return the settings whose readings a calibration fits."""
    return [s for s in settings if s.mount.installation != VERIFICATION]


def verifying(settings: Iterable[Setting]) -> list[Setting]:
    """Return the settings of verification points."""
    return [s for s in settings if s.mount.installation == VERIFICATION]


@dataclass(frozen=True)
class Cost:
    """Expected bench time, s: of a setting with its reading, of mounting the block, and once in all."""

    setting_s: float
    mount_s: float
    once_s: float = 0.0

    @classmethod
    def of_plan(cls, plan: Plan, line_hz: float = 50.0) -> Cost:
        """Return what one more setting and one more mounting take in a plan."""
        reading_s = next((plan.step_duration_s(s, line_hz) for s in plan.steps if isinstance(s, Read)), 0.0)
        setting_s = plan.operator_time.turn_s + _settling_s(plan) + reading_s
        return cls(setting_s, plan.operator_time.mount_s)

    def total_s(self, settings: int, mounts: int) -> float:
        """Return the expected time of so many settings in so many mountings, s."""
        return self.once_s + settings * self.setting_s + mounts * self.mount_s

    def settings_within(self, time_s: float, mounts: int) -> int:
        """Return how many settings in so many mountings a time allows; none below zero."""
        return max(int((time_s - self.total_s(0, mounts)) / self.setting_s + 1e-9), 0)


def _settling_s(plan: Plan) -> float:
    """What is waited for between a turn and its reading, at the first turn of the plan, s."""
    seconds = 0.0
    turned = False
    for step in plan.steps:
        if isinstance(step, Read) and turned:
            break
        turned = turned or isinstance(step, Turn)
        if isinstance(step, Wait) and turned:
            seconds += step.duration_s
    return seconds


ANGLES: Final = ("axis_tilt", "zero_offset", "mounting_error", "mounting_roll")
"""The stand angles that every mounting has, whatever their size."""

THIRD: Final = Installation.from_axes("3", ("y", "z", "x"))
"""The block's x along the shaft, as neither of the paper's installations has it."""

MOST_MOUNTINGS: Final = 24

_PASS_RAD: Final = tuple(np.radians(45.0) * np.arange(9))
_VERIFICATION_RAD: Final = tuple(np.radians([45.0, 135.0, 225.0, 315.0]))
_SHIPPED: Final[Mapping[str, str]] = {
    "1T90": "remount-90", "2T90": "remount-90", "1T180": "remount-180", "2T180": "remount-180",
}  # fmt: skip


@dataclass(frozen=True)
class Remedy:
    """Something more to measure: `determines` of the open directions it closes, in `cost_s` of bench time."""

    text: str
    determines: int
    cost_s: float


@dataclass(frozen=True)
class Outlook:
    """What planned readings determine of coefficients and stand, and what would determine more of it.

    `remedies` are those that close a direction, the cheapest first.
    """

    found: Observability
    remedies: tuple[Remedy, ...]

    @property
    def turns(self) -> list[str]:
        """Axes about which the block's axes may turn together: a convention, which no mounting shows."""
        return [axis_in_words(d.axis) for d in self.found.directions if d.kind is DirectionKind.TURN]

    @property
    def open(self) -> list[str]:
        """The other directions that leave no trace."""
        return [d.text() for d in self.found.directions if d.kind is not DirectionKind.TURN]


@dataclass(frozen=True)
class _Candidate:
    text: str
    settings: tuple[Setting, ...] = ()
    modulus: tuple[Setting, ...] = ()
    cost_s: float = 0.0


def outlook(settings: Sequence[Setting], model: ForwardModel, block: Block, cost: Cost) -> Outlook:
    """Return what readings at these settings determine of the coefficients and of `ANGLES` in every mounting.

    Effects of the model are unknowns, too. Of more than `MOST_MOUNTINGS` only the first in each installation are
    looked at. Raises `KeyError` for an installation that the model lacks.
    """
    settings = _distinct(settings)
    own = fitted(settings)
    found = _observability(own, (), model, block)
    remedies = []
    if any(d.kind is not DirectionKind.TURN for d in found.directions):
        wider = ForwardModel({**model.installations, THIRD.label: THIRD}, model.effects, model.name)
        for more in _menu(settings, model, cost):
            then = _observability([*own, *more.settings], more.modulus, wider, block)
            closed = found.null.shape[1] - _open_of(then, found.names)
            if closed:
                remedies.append(Remedy(more.text, closed, more.cost_s))
    return Outlook(found, tuple(sorted(remedies, key=lambda r: r.cost_s)))


def _distinct(settings: Sequence[Setting]) -> list[Setting]:
    """Settings that differ in more than the pass: a repeat adds nothing to the rank."""
    distinct = list({(s.mount, s.angle_rad): s for s in reversed(settings)}.values())[::-1]
    if len({s.mount for s in distinct}) <= MOST_MOUNTINGS:
        return distinct
    first = {s.mount.installation: s.mount for s in reversed(distinct)}
    return [s for s in distinct if s.mount == first[s.mount.installation]]


def _observability(
    settings: Sequence[Setting], modulus: Sequence[Setting], model: ForwardModel, block: Block
) -> Observability:
    problem = with_angles(make_problem(model, conditions_of(settings), {}), ANGLES)
    return observability(problem, block, modulus=conditions_of(modulus) if modulus else None)


def _open_of(found: Observability, names: Sequence[str]) -> int:
    """How many directions among the unknowns of these names are open; those of added mountings do not count."""
    rows = [found.names.index(name) for name in names]
    return int(np.sum(np.linalg.svd(found.null[rows], compute_uv=False) > 1e-3))


def _menu(settings: Sequence[Setting], model: ForwardModel, cost: Cost) -> list[_Candidate]:
    """What could be added: verification points in the fit, one pass in another installation or a return."""
    menu = []
    there = verifying(settings)
    if there:
        menu.append(_Candidate("let the verification points join the fit by |a| = 1 g", modulus=tuple(there)))
    elif VERIFICATION in model.installations:
        points = _one_pass(Mounting(1, VERIFICATION), _VERIFICATION_RAD)
        text = "four verification points (installation V) that join the fit by |a| = 1 g"
        menu.append(_Candidate(text, modulus=points, cost_s=cost.total_s(len(points), 1)))
    visited = {s.mount.installation for s in settings}
    labels = [label for label in model.installations if label not in {VERIFICATION, *visited}]
    for label in dict.fromkeys([*labels, THIRD.label]):
        if label in visited:
            continue
        text = f"one pass in installation {label}"
        if label in _SHIPPED:
            text += f", as in the procedure '{_SHIPPED[label]}'"
        elif label not in model.installations:
            text += " (axes [y, z, x]: x along the shaft), to be defined in the bench file"
        menu.append(_with_pass(text, Mounting(1, label), cost))
    if visited - {VERIFICATION}:
        first = next(s.mount.installation for s in settings if s.mount.installation != VERIFICATION)
        series = 1 + max(s.mount.series for s in settings if s.mount.installation == first)
        text = f"a return to installation {first}, as in the procedure 'return'"
        menu.append(_with_pass(text, Mounting(series, first), cost))
    return menu


def _with_pass(text: str, mount: Mounting, cost: Cost) -> _Candidate:
    points = _one_pass(mount, _PASS_RAD)
    return _Candidate(text, settings=points, cost_s=cost.total_s(len(points), 1))


def _one_pass(mount: Mounting, angles_rad: Sequence[float]) -> tuple[Setting, ...]:
    return tuple(Setting(mount, 1, point, angle, 1) for point, angle in enumerate(angles_rad, start=1))
