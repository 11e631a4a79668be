"""The content of a run's record: manifest, events, results of steps, and the states of a run."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final, TypedDict, cast

from bench.base.files import read_regular
from bench.readings.table import Reading

EVENTS: Final = "events.jsonl"
MANIFEST: Final = "run.json"
FORMAT: Final = 1


class UnitUnderTest(TypedDict):
    """The block that a run measures."""

    type: str
    serial: str


class VerdictAsked(TypedDict, total=False):
    """The decision settings stated on the command line; they override those of the bench file."""

    limit_g: float
    rule: str
    guard_band: float


class DefaultRule(TypedDict):
    """The decision rule used if none is stated, with the false-acceptance probability that sets its guard band."""

    rule: str
    false_acceptance: float


DEFAULT_RULE: Final[DefaultRule] = {"rule": "non-binary", "false_acceptance": 0.05}
"""The default decision rule, copied into each new record.

In a record without `default_rule`, the default is simple acceptance, as it was when the run began.
"""


class CheckedBefore(TypedDict, total=False):
    """The state of the check block at the start of the run.

    `run` is the latest run with the check block, `age_h` the age of that run, h. `rule` is the rule of the bench
    file: refuse or warn. `state` is in control, out of control, too old or missing; `said` puts the state in words.
    `despite` is the operator's reason for starting although the state was not good.
    """

    rule: str
    state: str
    said: str
    run: str
    age_h: float
    despite: str


class OperatorPerson(TypedDict):
    """The operator's entry in the register of persons; `register` is the hash of the register's last line."""

    role: str
    may: list[str]
    register: str


class Manifest(TypedDict, total=False):
    """The inputs and settings with which a run was begun (`run.json`), in this order.

    `files` holds the SHA-256 of each input by name. `seed` is None for a run on real instruments. A run imported
    from a readings file (`imported`) states the number of `readings` and has no procedure. `living` marks a dry run
    whose questions a person answers. `bench_why` is the reason for the choice of the bench file. `devices` names
    the origin of drivers from outside the bench software. `verdict` overrides the bench file's decision settings;
    `default_rule` applies if neither states a rule. `until` lists the goals at which the run ends.
    `check_block` is the state of the check block. Fields without a value are omitted.
    """

    format: int
    name: str
    created: str
    imported: str
    readings: int
    dry_run: bool
    seed: int | None
    living: bool
    operator: str
    operator_person: OperatorPerson
    procedure: str
    bench: str
    bench_why: str
    plan_hash: str
    unit_under_test: UnitUnderTest
    versions: dict[str, str]
    devices: dict[str, str]
    default_rule: DefaultRule
    verdict: VerdictAsked
    until: list[str]
    check_block: CheckedBefore
    files: dict[str, str]


class RecordError(Exception):
    """A run or page cannot be written, or a run holds invalid data; the text says where, why and what to do."""


@contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield a caller's `path` as a `Path`. Raises `RecordError` if the file cannot be written in this context."""
    if not isinstance(path, str | os.PathLike):
        raise RecordError(f"path={path!r}: expected the name of a file")
    try:
        yield Path(path)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be written ({error.strerror}); name a file in another folder"
        ) from error


def sha256(data: bytes) -> str:
    """Return the SHA-256 digest of `data` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a run. Raises `RecordError` if the manifest is missing or damaged."""
    try:
        manifest = json.loads(read_regular(folder / MANIFEST).decode())
    except (FileNotFoundError, NotADirectoryError):
        raise RecordError(
            f"{folder}: the folder is not a run (no {MANIFEST} in it); name the folder of a run"
        ) from None
    except OSError as error:
        raise RecordError(
            f"{folder / MANIFEST}: cannot be read ({error.strerror}); check name and permissions"
        ) from None
    except (ValueError, RecursionError):
        raise RecordError(
            f"{folder / MANIFEST}: damaged (not JSON); restore it from a copy of the run"
        ) from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("files", {}), dict):
        raise RecordError(f"{folder / MANIFEST}: damaged (not a manifest); restore it from a copy of the run")
    return cast(Manifest, manifest)


def changed_inputs(folder: Path) -> list[str]:
    """Return a sentence for each input that is missing or whose hash differs from the manifest.

    Raises `RecordError` without a manifest.
    """
    return [
        f"{name} was changed since the run began"
        for name, digest in read_manifest(folder).get("files", {}).items()
        if not (folder / name).is_file() or sha256(read_regular(folder / name)) != digest
    ]


# --- results of steps -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mounted:
    """The block is mounted; `temperature_c` was entered by a person, or is None if nobody was asked."""

    temperature_c: float | None


@dataclass(frozen=True)
class Turned:
    """The head was turned to the read-back angle `angle_deg`; `target_deg` was the target."""

    angle_deg: float
    target_deg: float


@dataclass(frozen=True)
class TemperatureSet:
    """The chamber received the set point `target_c`, °C."""

    target_c: float


@dataclass(frozen=True)
class CameToRest:
    """The signals or the temperature settled after `settled_s` seconds.

    `settled_at` are the settled values, in V (signals) or °C (chamber).
    """

    settled_s: float
    settled_at: tuple[float, ...]


@dataclass(frozen=True)
class InputSelected:
    """The voltmeter inputs were switched to `source`; `reference_v` is the voltage of a reference source."""

    source: str
    reference_v: float | None


@dataclass(frozen=True)
class Answered:
    """The person answered a question of the procedure."""

    answer: str


@dataclass(frozen=True)
class Powered:
    """The block was switched: "on", "off" or "cycle".

    `warmed_up_s` is the time from switching on to the end of the warm-up, s, None for "off"; `warmed_up_at` are the
    signals then, V, if the warm-up waited for them to settle.
    """

    switched: str
    warmed_up_s: float | None
    warmed_up_at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Levelled:
    """The tilt of the platform measured with the level, head at 0°: α1 along the shaft, α2 across it.

    `level_of` (installation) and `level_series` identify the mounting. `adjusted` says whether the platform was
    levelled first or left as found. `level_zero_arcsec` is the level's own zero along and across the shaft. Each
    row of `level_readings`, arcsec, holds the head angle, then the readings along and across: with the level in its
    first position, then with the level turned.
    """

    level_of: str
    level_series: int
    adjusted: bool
    alpha1_arcsec: float
    u_alpha1_arcsec: float
    alpha2_arcsec: float
    u_alpha2_arcsec: float
    level_zero_arcsec: tuple[float, ...]
    level_readings: tuple[tuple[float, ...], ...]


Result = (
    Reading | Mounted | Turned | TemperatureSet | CameToRest | InputSelected | Answered | Levelled | Powered
)
"""The result of a step; a `Wait` step has none."""

_KINDS: Final = (Mounted, Turned, TemperatureSet, CameToRest, InputSelected, Answered, Levelled, Powered)
"""The result types, which the record distinguishes by their field names."""


@cache
def _fields() -> Mapping[Callable[..., Result], tuple[str, ...]]:
    """Return the field names of each type of result, including results of kinds of steps in other modules."""
    from bench.config.procedure.plan import KINDS  # imported here because it is slow

    further = (kind.BRINGS for kind in KINDS if kind.BRINGS is not None)
    return {kind: tuple(of.name for of in fields(kind)) for kind in (*_KINDS, *further)}


def result_to_json(result: Result | None) -> dict[str, Any]:
    """Return a step's result as the record stores it; an empty dict for None."""
    if result is None:
        return {}
    return {"reading": result.to_json()} if isinstance(result, Reading) else asdict(result)


def result_from_json(data: Mapping[str, Any]) -> Result | None:
    """Return the result of a step from recorded event data, None if there is none; a reading lacks its samples.

    Raises `KeyError`, `TypeError` or `ValueError` for data that no step records.
    """
    if "reading" in data:
        return Reading.from_json(data["reading"] | {"samples": {}})
    brought = {kind: {n: data[n] for n in names if n in data} for kind, names in _fields().items()}
    # result types may share a field name: choose the type with the most fields present
    kind, values = max(brought.items(), key=lambda one: len(one[1]))
    return kind(**values) if values else None


# --- events -----------------------------------------------------------------------------------------


class EventType(StrEnum):
    """The types of events; the docstring of each describes the fields of `Event.data`.

    An event caused by an operator's command states its author in `by`, `role` and `where`, as far as known.
    """

    RUN_STARTED = "run_started"
    """Data: `step`, the first step; `instruments`, identities by name; `serials`, if certificates are checked."""
    RUN_RESUMED = "run_resumed"
    """Data: those of `run_started`; also the author who resumed the run, if known."""
    RUN_PAUSED = "run_paused"
    """Data: `reason`."""
    RUN_CONTINUED = "run_continued"
    RUN_FINISHED = "run_finished"
    RUN_FAILED = "run_failed"
    """Data: `error`, a sentence; `instrument`, the name of the failed instrument."""
    RUN_INTERRUPTED = "run_interrupted"
    RUN_ABORTED = "run_aborted"
    """Data: `reason`."""
    LEFT_SAFE = "left_safe"
    """Data: `to_do`, the tasks left for a person, by instrument."""
    STEP_STARTED = "step_started"
    """Data: `step`, the index of the step in the plan, from 0; `key`, its key; `attempt`, from 1."""
    STEP_DONE = "step_done"
    """Data: those of `step_started`, and the step's result."""
    STEP_FAILED = "step_failed"
    """Data: `step` and `key`, as in `step_started`; `error`, a sentence."""
    SKIPPED = "skipped"
    """Data: `first` and `last`, the range of skipped steps; `reason`."""
    REDO = "redo"
    """Data: `first` and `last`, the range of steps to repeat; `wish`, the wish that asked for it."""
    REMOUNTED = "remounted"
    """Data: `installation`; `series`; `now_series`, the series number of the later readings.

    With `why`, the block stayed mounted but lost power in between, which also begins a new visit.
    """
    POWER = "power"
    """Data: `power`, which is "on" or "off" after switching, "found on", or "fault" after a failed check.

    Also `rails`, the supply's measurements by rail or, for a fault, `wrong`, phrases that describe it.
    """
    WARMED_UP = "warmed_up"
    """Data: `after_s`, time since switch-on, s; `at`, the settled signals, V, if the warm-up waited for them."""
    EARLY_SIGN = "early_sign"
    """Data: `step`, and the fields of the early sign."""
    SAME_SERIAL = "same_serial"
    """Data: `words`, a sentence on instruments that report the same serial number."""
    CERTIFICATE = "certificate"
    """Data: `words`, a sentence on a certificate that has expired, or that is of another instrument."""
    WENT_ON = "went_on"
    """Data: `step` and `causes` of the early sign that stopped the run; `reason`, why a person continued."""
    WISH_REFUSED = "wish_refused"
    """Data: `wish`, the refused wish; `why`, a sentence."""
    ASKED = "asked"
    """A prompt that can be answered from several places.

    Data: `id`, unique in the record; the fields of the prompt: `kind`, `text`, `default`, `unit`, `choices`,
    `minimum`, `maximum`, `action`, `picture`. The question stays open until it is answered, or until the run
    continues or stops without an answer.
    """
    ANSWERED = "answered"
    """Data: `id` of the prompt; `answer`, the accepted answer; its author in `by`, `role` and `where`; `line`.

    `line` is the line number, from 1, in the run folder's file of answers; it is missing for other answers.
    """
    ANSWER_REFUSED = "answer_refused"
    """Data: those of `answered`, with `answer` as entered; `why`, a sentence."""
    CHAMBER_SLOW = "chamber_slow"
    """Data: `chamber`, its name; `start_c` and, `after_s` later, `air_c`, temperatures of the air; `target_c`."""
    CLOCK_JUMPED = "clock_jumped"
    """Data: `ahead_s`, the gain of civil time on bench time since the previous event, s."""
    CHOSEN = "chosen"
    """The choice of the next points, in a run that continues until its goals are reached.

    Data: `visit` is the number of the mounting. `left_out` lists ranges [first, last] of steps that are not needed;
    `taken_up` lists ranges dropped earlier that are needed after all. `now` is the state of the goal furthest from
    being reached (None until the readings determine the coefficients). `settings` and `repeats` are the counts so
    far. `next` holds the next points, their time and their gain; `in_all` holds the number and duration of all
    points that remain. `undecided` are the steps left to later choices, with their expected time. `stop` is the
    reason for ending the measurement.
    """
    IMPORTED = "imported"
    """Data: `file`, the name of the imported file; `readings`, the number of readings."""


MOST: Final = 1_000_000
"""Upper limit of the steps of a plan and the mountings of a run; a record with greater numbers is invalid."""

_DataTypes = tuple[tuple[str, type[object]], ...]
_STEP: Final[_DataTypes] = (("step", int),)
_STEPS: Final[_DataTypes] = (("first", int), ("last", int))
_REQUIRED_DATA: Final[Mapping[str, _DataTypes]] = {
    EventType.RUN_STARTED: (*_STEP, ("instruments", dict)),
    EventType.RUN_RESUMED: (*_STEP, ("instruments", dict)),
    EventType.LEFT_SAFE: (("to_do", dict),),
    EventType.STEP_STARTED: _STEP,
    EventType.STEP_DONE: _STEP,
    EventType.STEP_FAILED: (*_STEP, ("error", str)),
    EventType.SKIPPED: _STEPS,
    EventType.REDO: _STEPS,
    EventType.REMOUNTED: (("installation", str), ("series", int), ("now_series", int)),
    EventType.POWER: (("power", str),),
    EventType.EARLY_SIGN: (("sentence", str),),
    EventType.WISH_REFUSED: (("wish", str), ("why", str)),
    EventType.CHOSEN: (("visit", int), ("left_out", list), ("stop", str)),
    EventType.ASKED: (("id", str), ("kind", str), ("text", str), ("action", dict)),
    EventType.ANSWERED: (("id", str), ("answer", str)),
    EventType.ANSWER_REFUSED: (("id", str), ("answer", str), ("why", str)),
}
"""The data that an event of each type must have, with their types; readers of records rely on these fields."""

_NUMBERS: Final = frozenset({int, float})


@dataclass(frozen=True)
class Event:
    """One line of the record: number, civil time, bench time (s since the run began), type, and data.

    `type` is an `EventType`, or an unknown type written by a later version.
    """

    number: int
    time: str
    bench_s: float
    type: str
    data: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return the event as recorded, without the hash of the previous line."""
        return {
            "n": self.number,
            "time": self.time,
            "bench_s": self.bench_s,
            "type": self.type,
            **self.data,
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Event:
        """Return the event recorded as `data`; this dict, without the common fields, becomes `Event.data`.

        Raises `KeyError`, `TypeError` or `ValueError` for data that are not an event.
        """
        number, time, bench_s, kind = data.pop("n"), data.pop("time"), data.pop("bench_s"), data.pop("type")
        if type(number) is not int or type(time) is not str or type(kind) is not str:
            raise ValueError("number, time or type of the event is invalid")
        if type(bench_s) not in _NUMBERS or not math.isfinite(bench_s):
            raise ValueError("bench time of the event is not a number")
        for name, kinds in _REQUIRED_DATA.get(kind, ()):
            value: Any = data[name]
            if type(value) is not kinds or (isinstance(value, int) and not 0 <= value < MOST):
                raise ValueError(f"{name} of the event {kind} is invalid")
        return cls(number, time, float(bench_s), kind, data)

    @property
    def step(self) -> int:
        """The index of the event's step."""
        return int(self.data["step"])

    @property
    def steps(self) -> range:
        """The indices of the steps that were skipped or are to be repeated."""
        return range(int(self.data["first"]), int(self.data["last"]) + 1)

    @cached_property
    def result(self) -> Result | None:
        """The step's result; None for a step without a result and for events other than `step_done`."""
        return result_from_json(self.data) if self.type == EventType.STEP_DONE else None

    @property
    def reading(self) -> Reading | None:
        """The reading that the step returned, or None."""
        return result if isinstance(result := self.result, Reading) else None


class RunState(StrEnum):
    """The states of a run."""

    READY = "ready"
    RUNNING = "running"
    PAUSED = "paused"
    FINISHED = "finished"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    ABORTED = "aborted"


_OPEN: Final[Mapping[str, RunState]] = {
    EventType.RUN_RESUMED: RunState.RUNNING,
    EventType.RUN_FAILED: RunState.FAILED,
    EventType.RUN_INTERRUPTED: RunState.INTERRUPTED,
    EventType.RUN_ABORTED: RunState.ABORTED,
}
"""Events possible in every state of a run that has not ended."""


def _stopped(state: RunState) -> Mapping[str, RunState]:
    """Return the transitions of a stopped run, event -> next state; failing to resume does not change `state`."""
    return {**_OPEN, EventType.RUN_FAILED: state, EventType.RUN_INTERRUPTED: state}


TRANSITIONS: Final[Mapping[RunState, Mapping[str, RunState]]] = {
    RunState.READY: {**_OPEN, EventType.RUN_STARTED: RunState.RUNNING},
    RunState.RUNNING: {
        **_OPEN,
        EventType.RUN_PAUSED: RunState.PAUSED,
        EventType.RUN_FINISHED: RunState.FINISHED,
    },
    RunState.PAUSED: {**_OPEN, EventType.RUN_CONTINUED: RunState.RUNNING},
    RunState.FAILED: _stopped(RunState.FAILED),
    RunState.INTERRUPTED: _stopped(RunState.INTERRUPTED),
    RunState.FINISHED: {},
    RunState.ABORTED: {},
}
"""The state after each event, by the state before it; no other transitions are valid in a record."""

ENDED: Final = frozenset({RunState.FINISHED, RunState.ABORTED})
"""Final states, after which a run cannot continue."""


class Wish(StrEnum):
    """The commands that a person may give during a run."""

    PAUSE = "pause"
    CONTINUE = "continue"
    REPEAT_POINT = "redo"
    REPEAT_PASS = "redo-pass"
    MOUNT_AGAIN = "remount"
    SKIP = "skip"
    STOP = "stop"
    ABORT = "abort"


HEARD: Final[Mapping[RunState, frozenset[Wish]]] = {
    RunState.RUNNING: frozenset(Wish) - {Wish.CONTINUE},
    RunState.PAUSED: frozenset(Wish) - {Wish.PAUSE},
}
"""The wishes obeyed in each state; all others are refused."""


_CHANGING: Final = frozenset(event for row in TRANSITIONS.values() for event in row)


def state_after_one(state: RunState, event: str) -> RunState:
    """Return the state that follows `state` after an event. Raises `ValueError` for an invalid transition."""
    if event not in _CHANGING:
        return state
    if event not in TRANSITIONS[state]:
        raise ValueError(f"{event} cannot follow on {state}")
    return TRANSITIONS[state][event]
