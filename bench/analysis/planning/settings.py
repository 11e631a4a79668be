"""Settings of the head as a plan foresees them: where a reading is taken, and what it takes to get there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from bench.model import Conditions, Mounting
from bench.procedure.plan import Plan, Read, Turn, Wait
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
