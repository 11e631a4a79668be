"""A plan: the actions of a procedure as a flat tuple of frozen steps. It never touches an instrument."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from itertools import accumulate
from typing import Any, Final

from bench.config.bench_file.stand import UnitSupplySection
from bench.config.procedure.steps import (
    SETTLING,
    Ask,
    InputSource,
    Level,
    Mount,
    OnFailure,
    OperatorTime,
    Power,
    Read,
    SelectInput,
    SetTemperature,
    Settle,
    Settled,
    Step,
    Times,
    Turn,
    Wait,
    mount_in_words,
    power_duration_s,
)
from drivers.person import PromptKind

__all__ = ["SETTLING", "Ask", "InputSource", "Level", "Mount", "OnFailure", "OperatorTime", "Plan", "Power", "Read",
           "SelectInput", "SetTemperature", "Settle", "Settled", "Step", "Turn", "Wait"]  # fmt: skip

KINDS: Final[tuple[type[Step], ...]] = (
    Mount, Turn, Wait, Settle, Read, SelectInput, Ask, SetTemperature, Level, Power,
)  # fmt: skip
"""All kinds of step, in the order of `Plan.counts`; add a kind from a separate module here."""

_STEPS: Final[Mapping[str, Callable[..., Step]]] = {kind.NAME: kind for kind in KINDS}
FIELDS: Final = {kind: tuple(f.name for f in fields(kind)) for kind in KINDS}

_ADDED: Final[Mapping[str, object]] = {
    "on_failure": OnFailure(), "input_s": OperatorTime().input_s, "scan": "",
}  # fmt: skip
"""Fields that plans of earlier versions lack, with the value that a missing field stands for.

A field with this value is not written, so that recorded plans keep their hash. The values must never change.
"""


@dataclass(frozen=True)
class Plan:
    """The steps in order, with the name of their procedure and the SHA-256 of its files."""

    name: str
    steps: tuple[Step, ...]
    procedure_sha256: str
    operator_time: OperatorTime = field(default_factory=OperatorTime)

    @cached_property
    def hash(self) -> str:
        """The SHA-256 of the canonical JSON: equal plans have equal hashes, and any change alters the hash."""
        head = _canonical({**self._head(), "steps": []}).removesuffix("]}")
        digest = hashlib.sha256(head.encode())  # step by step: a long plan is never one string in memory
        for index, step in enumerate(self.steps):
            digest.update((("," if index else "") + _canonical(_step_to_json(step))).encode())
        digest.update(b"]}")
        return digest.hexdigest()

    def counts(self) -> dict[str, int]:
        """Return the number of steps of each kind that occurs, by kind."""
        found = Counter(type(step) for step in self.steps)
        return {kind.NAME: found[kind] for kind in KINDS if found[kind]}

    @cached_property
    def mountings(self) -> tuple[int, ...]:
        """For each step, the number of mountings up to it."""
        return tuple(accumulate(isinstance(step, Mount) for step in self.steps))

    def begins_on(self) -> bool:
        """Whether the block must be on before the first step: yes, unless a power step comes before any reading."""
        kinds = (type(step) for step in self.steps if isinstance(step, Read | Power))
        return next(kinds, Read) is Read

    def step_duration_s(
        self, step: Step, line_hz: float = 50.0, supply: UnitSupplySection | None = None
    ) -> float:
        """Return the expected duration of a step, s; for a settling step, it is the shortest possible.

        `supply` is the bench-file section on the block's supply, needed for the times of switching.
        """
        return step.takes_s(Times(self.operator_time, line_hz, supply))

    def duration_by_kind_s(
        self, line_hz: float = 50.0, supply: UnitSupplySection | None = None
    ) -> dict[str, float]:
        """Return the expected duration, s, of all steps of a kind, by kind, in the order of `counts`.

        If the block is switched on before the first step, switching and warm-up count under "power".
        """
        total, times = dict.fromkeys(self.counts(), 0.0), Times(self.operator_time, line_hz, supply)
        for step in self.steps:
            total[step.NAME] += step.takes_s(times)
        if supply is not None and self.begins_on():
            total["power"] = total.get("power", 0.0) + power_duration_s(SWITCHED_ON, supply)
        return total

    def duration_by_mount_s(
        self, line_hz: float = 50.0, supply: UnitSupplySection | None = None
    ) -> dict[str, float]:
        """Return the expected duration, s, by visit to an installation: "1", "1 (series 2)", or "" before."""
        total: dict[str, float] = {}
        if supply is not None and self.begins_on():
            total[""] = power_duration_s(SWITCHED_ON, supply)
        mounted = ""
        for step in self.steps:
            if isinstance(step, Mount):
                mounted = mount_in_words(step.installation, step.series)
            total[mounted] = total.get(mounted, 0.0) + self.step_duration_s(step, line_hz, supply)
        return total

    def expected_duration_s(self, line_hz: float = 50.0, supply: UnitSupplySection | None = None) -> float:
        """Return the expected duration of the whole plan, s."""
        return sum(self.duration_by_kind_s(line_hz, supply).values())

    def longest_duration_s(self, line_hz: float = 50.0, supply: UnitSupplySection | None = None) -> float:
        """Return the duration, s, of the whole plan if every settling and warm-up lasts until its timeout."""
        settling = [step for step in self.steps if isinstance(step, Settle)]
        longer = sum(step.timeout_s - self.step_duration_s(step, line_hz) for step in settling)
        if supply is not None:
            warm_ups = [step for step in self.steps if isinstance(step, Power) and _warms_up(step)]
            times = len(warm_ups) + self.begins_on()
            longer += times * (supply.longest_warm_up_s - supply.warm_up_s)
        return self.expected_duration_s(line_hz, supply) + longer

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON values."""
        return {**self._head(), "steps": [_step_to_json(step) for step in self.steps]}

    def _head(self) -> dict[str, Any]:
        times = {f.name: getattr(self.operator_time, f.name) for f in fields(OperatorTime)}
        return {
            "name": self.name,
            "procedure_sha256": self.procedure_sha256,
            "operator_time": {name: value for name, value in times.items() if value != _ADDED.get(name)},
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Plan:
        """Return the plan from its `to_json`. Raises `ValueError`, `KeyError` or `TypeError` for other data."""
        return cls(
            str(data["name"]),
            tuple(_step_from_json(step) for step in data["steps"]),
            str(data["procedure_sha256"]),
            OperatorTime(**data["operator_time"]),
        )


SWITCHED_ON: Final = Power("start/power", "on")
"""The action of a run before its first step, if the block has a supply and the plan `begins_on`."""


def _warms_up(step: Power) -> bool:
    """Whether a step switches the block on with the warm-up stated in the bench file."""
    return step.switch != "off" and step.warm_up_s is None


def _step_to_json(step: Step) -> dict[str, Any]:
    written: dict[str, Any] = {"step": step.NAME}
    for name in FIELDS[type(step)]:
        value = getattr(step, name)
        if name not in _ADDED or value != _ADDED[name]:
            written[name] = asdict(value) if isinstance(value, OnFailure) else value
    return written


_canonical: Final = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode


def _step_from_json(data: Mapping[str, Any]) -> Step:
    values = dict(data)
    name = values.pop("step")
    if name not in _STEPS:
        raise ValueError(f"{name!r} is not a known kind of step")
    if name == "ask":
        values["kind"] = PromptKind(values["kind"])
        values["choices"] = tuple(values["choices"])
    if "on_failure" in values:
        values["on_failure"] = OnFailure(**values["on_failure"])
    return _STEPS[name](**values)
