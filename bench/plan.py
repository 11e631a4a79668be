"""A plan: what a procedure does, as a flat tuple of frozen steps. Nothing in it touches an instrument.

Every step has a `key`, unique in its plan and the same each time the procedure is expanded, such as
"0012/read/1.2.5": place in the plan (from 1), kind, installation.pass.point (a series other than the
first follows the installation: "1s2.2.5").
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final

import numpy as np

from drivers.interfaces import Direction, PromptKind

SETTLING: Final = "settling"
"""The reason of a wait between a turn and its reading."""

_APPROACH: Final[Mapping[Direction, str]] = {1: "rising", -1: "falling"}
_SAMPLE_OVERHEAD_S: Final = 0.01
_SECONDS: Final = ((3600.0, "h"), (60.0, "min"), (1.0, "s"))


@dataclass(frozen=True, slots=True)
class Mount:
    """The operator mounts the block in an installation; `series` numbers the visits to it."""

    key: str
    installation: str
    series: int

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"mount the block in installation {told_mount(self.installation, self.series)}"


@dataclass(frozen=True, slots=True)
class Turn:
    """The head is turned to an angle, arriving with rising (+1) or falling (-1) angle."""

    key: str
    installation: str
    series: int
    pass_number: int
    point: int
    target_rad: float
    direction: Direction

    def describe(self) -> str:
        """Say in one line what is done."""
        return (
            f"turn the head to {_degrees(self.target_rad)}, {_APPROACH[self.direction]}, for {_point(self)}"
        )


@dataclass(frozen=True, slots=True)
class Wait:
    """Bench time passes."""

    key: str
    duration_s: float
    reason: str

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"wait {told_duration(self.duration_s)}: {self.reason}"


@dataclass(frozen=True, slots=True)
class Read:
    """The voltmeters take one reading: `samples` samples of `nplc` power-line cycles each."""

    key: str
    installation: str
    series: int
    pass_number: int
    point: int
    target_rad: float
    direction: Direction
    samples: int
    nplc: float

    def describe(self) -> str:
        """Say in one line what is done."""
        return (
            f"read {_point(self)} at {_degrees(self.target_rad)}: "
            f"{self.samples} samples of {self.nplc:g} power-line cycles"
        )


@dataclass(frozen=True, slots=True)
class Ask:
    """The operator answers a question; the fields are those of `drivers.interfaces.Prompt`."""

    key: str
    kind: PromptKind
    text: str
    default: str | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None

    def describe(self) -> str:
        """Say in one line what is done."""
        default = "" if self.default is None else f" [{self.default}]"
        return f"ask: {self.text}{default}"


@dataclass(frozen=True, slots=True)
class SetTemperature:
    """The chamber is set to a temperature; the soak is a `Wait` of its own."""

    key: str
    target_c: float

    def describe(self) -> str:
        """Say in one line what is done."""
        return f"set the chamber to {self.target_c:g} °C"


Step = Mount | Turn | Wait | Read | Ask | SetTemperature

_STEPS: Final[Mapping[str, type[Step]]] = {
    "mount": Mount, "turn": Turn, "wait": Wait, "read": Read, "ask": Ask, "temperature": SetTemperature,
}  # fmt: skip
"""Every kind of step by the name it has in counts and in JSON, in the order in which they are told."""

_NAMES: Final = {step: name for name, step in _STEPS.items()}
_FIELDS: Final = {step: tuple(f.name for f in fields(step)) for step in _NAMES}
_BY_OPERATOR: Final = (Mount, Turn, Ask, SetTemperature)


@dataclass(frozen=True, slots=True)
class OperatorTime:
    """How long the operator is expected to take for a turn, a mounting, any other task, s."""

    turn_s: float = 120.0
    mount_s: float = 1200.0
    answer_s: float = 30.0


@dataclass(frozen=True)
class Plan:
    """Steps in order, the name of the procedure they come from and the SHA-256 of its files."""

    name: str
    steps: tuple[Step, ...]
    procedure_sha256: str
    operator_time: OperatorTime = OperatorTime()

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the canonical JSON: the same for equal plans, another after any change."""
        text = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def counts(self) -> dict[str, int]:
        """Return how many steps there are of each kind that occurs."""
        found = Counter(type(step) for step in self.steps)
        return {name: found[step] for name, step in _STEPS.items() if found[step]}

    def operator_actions(self) -> int:
        """Return how often the operator has something to do on a bench without motors."""
        return sum(isinstance(step, _BY_OPERATOR) for step in self.steps)

    def step_duration_s(self, step: Step, line_hz: float = 50.0) -> float:
        """Return the expected time of a step, s. Autozero makes a sample two integrations long."""
        match step:
            case Mount():
                return self.operator_time.mount_s
            case Turn():
                return self.operator_time.turn_s
            case Wait():
                return step.duration_s
            case Read():
                return step.samples * (2.0 * step.nplc / line_hz + _SAMPLE_OVERHEAD_S)
            case Ask() | SetTemperature():
                return self.operator_time.answer_s

    def duration_by_kind_s(self, line_hz: float = 50.0) -> dict[str, float]:
        """Return the expected time of all steps of each kind that occurs, s, in the order of `counts`."""
        total = dict.fromkeys(self.counts(), 0.0)
        for step in self.steps:
            total[_NAMES[type(step)]] += self.step_duration_s(step, line_hz)
        return total

    def expected_duration_s(self, line_hz: float = 50.0) -> float:
        """Return the expected time of the whole plan, s."""
        return sum(self.duration_by_kind_s(line_hz).values())

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON values."""
        return {
            "name": self.name,
            "procedure_sha256": self.procedure_sha256,
            "operator_time": {f.name: getattr(self.operator_time, f.name) for f in fields(OperatorTime)},
            "steps": [_step_to_json(step) for step in self.steps],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Plan:
        """Return the plan that `to_json` wrote. Raises `ValueError`, `KeyError` or `TypeError` for others."""
        return cls(
            str(data["name"]),
            tuple(_step_from_json(step) for step in data["steps"]),
            str(data["procedure_sha256"]),
            OperatorTime(**data["operator_time"]),
        )


def _step_to_json(step: Step) -> dict[str, Any]:
    written: dict[str, Any] = {"step": _NAMES[type(step)]}
    for name in _FIELDS[type(step)]:
        value = getattr(step, name)
        written[name] = list(value) if isinstance(value, tuple) else value
    return written


def _step_from_json(data: Mapping[str, Any]) -> Step:
    values = dict(data)
    name = values.pop("step")
    if name not in _STEPS:
        raise ValueError(f"a step of the unknown kind {name!r}")
    if name == "ask":
        values["kind"] = PromptKind(values["kind"])
        values["choices"] = tuple(values["choices"])
    return _STEPS[name](**values)


def told_mount(installation: str, series: int) -> str:
    """Return an installation as it is told: "1", on a later visit "1 (series 2)"."""
    return installation if series == 1 else f"{installation} (series {series})"


def told_duration(seconds: float) -> str:
    """Return a duration in the largest unit in which it is a plain number: "1 h", "90 s"."""
    for size, unit in _SECONDS:
        if seconds >= size and seconds % size == 0.0:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def _point(step: Turn | Read) -> str:
    where = told_mount(step.installation, step.series)
    return f"installation {where}, pass {step.pass_number}, point {step.point}"


def _degrees(angle_rad: float) -> str:
    return f"{round(float(np.degrees(angle_rad)), 6):g}°"
