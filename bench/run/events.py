"""The content of a run's record: the manifest, the events, the results of steps, and the states of a run."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final, TypedDict, cast

from bench.base.files import read_regular
from bench.readings.reading import Reading

EVENTS: Final = "events.jsonl"
MANIFEST: Final = "run.json"
FORMAT: Final = 1


class UnitUnderTest(TypedDict):
    """The block that a run measures."""

    type: str
    serial: str


class VerdictAsked(TypedDict, total=False):
    """The way to the run's verdict, where the command asked for another than the bench file's."""

    limit_g: float
    rule: str
    guard_band: float


class DefaultRule(TypedDict):
    """The decision rule of a run where nobody states one, with the probability that sets its guard band."""

    rule: str
    false_acceptance: float


DEFAULT_RULE: Final[DefaultRule] = {"rule": "non-binary", "false_acceptance": 0.05}
"""The default, as each new record keeps it.

A record without one was begun when simple acceptance was the default.
"""


class CheckedBefore(TypedDict, total=False):
    """The state of the check block at the start of the run.

    `run` is the run of the check block; its age and the `rule` are recorded with it. `state` is in control,
    out of control, too old or missing; `said` is the same in words. `despite` is the reason for beginning the
    run where the state spoke against it.
    """

    rule: str
    state: str
    said: str
    run: str
    age_h: float
    despite: str


class Manifest(TypedDict, total=False):
    """The inputs and settings with which a run was begun (`run.json`), in this order.

    `files` are the SHA-256 of the inputs by name. `seed` is None for a run on real instruments. A run of a
    readings file (`imported`) has the number of its `readings`, and no procedure. `living` marks a dry run
    whose questions a person answers. `bench_why` is the reason for the choice of the bench file. `devices` is
    the origin of drivers that are not the bench's own. `verdict` replaces the bench file's way to a verdict;
    `default_rule` is used where neither states one. `until` are the goals at which the run ends.
    `check_block` is the state of the check block. Fields without content are left out.
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
    """A run folder cannot be written, or its content is invalid; the text says where, why and what to do."""


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a run. Raises `RecordError` when there is none."""
    try:
        manifest = json.loads(read_regular(folder / MANIFEST).decode())
    except (FileNotFoundError, NotADirectoryError):
        raise RecordError(f"{folder}: not a run (no {MANIFEST} in it)") from None
    except OSError as error:
        raise RecordError(f"{folder / MANIFEST}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise RecordError(f"{folder / MANIFEST}: damaged, not JSON; take it from a copy of the run") from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("files", {}), dict):
        raise RecordError(f"{folder / MANIFEST}: damaged, not a manifest; take it from a copy of the run")
    return cast(Manifest, manifest)


def changed_inputs(folder: Path) -> list[str]:
    """Return the inputs of a run that differ from its manifest. Raises `RecordError` without a manifest."""
    return [
        f"{name} was changed since the run began"
        for name, digest in read_manifest(folder).get("files", {}).items()
        if not (folder / name).is_file() or sha256(read_regular(folder / name)) != digest
    ]


# --- results of steps -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mounted:
    """The block is mounted; `temperature_c` was given by a person, None where nobody was asked."""

    temperature_c: float | None


@dataclass(frozen=True)
class Turned:
    """The head was turned: the angle read back, and the target."""

    angle_deg: float
    target_deg: float


@dataclass(frozen=True)
class TemperatureSet:
    """The chamber was set."""

    target_c: float


@dataclass(frozen=True)
class CameToRest:
    """The quantity has settled: after which time, s, and at which values, V or °C."""

    settled_s: float
    settled_at: tuple[float, ...]


@dataclass(frozen=True)
class InputSelected:
    """The inputs were switched; `reference_v` is the voltage of a reference, V."""

    source: str
    reference_v: float | None


@dataclass(frozen=True)
class Answered:
    """The person answered a question of the procedure."""

    answer: str


@dataclass(frozen=True)
class Powered:
    """The block was switched "on", "off" or "cycle"; the time of its warm-up, s, and the signals then, V."""

    switched: str
    warmed_up_s: float | None
    warmed_up_at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Levelled:
    """The tilt of the platform by the level, with the head at 0°: α1 and α2 with standard uncertainties.

    `level_of` and `level_series` state the mounting. `adjusted` says whether the platform was levelled
    before; else it was left as found. `level_zero_arcsec` is the level's own zero along the shaft and across.
    `level_readings` holds for each setting the head's angle, then along and across in the first and in the
    turned position, arcsec.
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
"""The result of a step; a wait has none."""

_KINDS: Final = (Mounted, Turned, TemperatureSet, CameToRest, InputSelected, Answered, Levelled, Powered)
"""The kinds of results; a record distinguishes them by their fields."""


@cache
def _fields() -> Mapping[Callable[..., Result], tuple[str, ...]]:
    """Return the fields of each kind of result, also for kinds of step that other modules define."""
    from bench.config.procedure.plan import KINDS  # takes long to import

    further = (kind.BRINGS for kind in KINDS if kind.BRINGS is not None)
    return {kind: tuple(of.name for of in fields(kind)) for kind in (*_KINDS, *further)}


def result_to_json(result: Result | None) -> dict[str, Any]:
    """Return the record of a step's result."""
    if result is None:
        return {}
    return {"reading": result.to_json()} if isinstance(result, Reading) else asdict(result)


def result_from_json(data: Mapping[str, Any]) -> Result | None:
    """Return the result of a step from its record; of a reading all but its samples.

    Raises `KeyError`, `TypeError`, `ValueError` for data that no step records.
    """
    if "reading" in data:
        return Reading.from_json(data["reading"] | {"samples": {}})
    brought = {kind: {n: data[n] for n in names if n in data} for kind, names in _fields().items()}
    # kinds may have a field in common: the one that accounts for the most is meant
    kind, values = max(brought.items(), key=lambda one: len(one[1]))
    return kind(**values) if values else None


# --- events -----------------------------------------------------------------------------------------


class EventType(StrEnum):
    """The types of events, each with the names of its data.

    An event from a wish states its author in `by`, `role` and `where`, as far as known.
    """

    RUN_STARTED = "run_started"
    """`step`, the first one; `instruments`, their identities by name; `serials`, in a dry run only where it has
    certificates."""
    RUN_RESUMED = "run_resumed"
    """The data of `run_started`."""
    RUN_PAUSED = "run_paused"
    """`reason`."""
    RUN_CONTINUED = "run_continued"
    RUN_FINISHED = "run_finished"
    RUN_FAILED = "run_failed"
    """`error`, a sentence; `instrument`."""
    RUN_INTERRUPTED = "run_interrupted"
    RUN_ABORTED = "run_aborted"
    """`reason`."""
    LEFT_SAFE = "left_safe"
    """`to_do`, the tasks left for a person, by instrument."""
    STEP_STARTED = "step_started"
    """`step`, its place in the plan from 0; `key`; `attempt`, from 1."""
    STEP_DONE = "step_done"
    """The data of `step_started`, and the result of the step."""
    STEP_FAILED = "step_failed"
    """`step`, `key`; `error`, a sentence."""
    SKIPPED = "skipped"
    """`first` and `last` of the steps; `reason`."""
    REDO = "redo"
    """`first` and `last` of the steps; `wish`."""
    REMOUNTED = "remounted"
    """`installation`, `series`, and `now_series`, the series of its further readings.

    With `why` the block stayed mounted, but was without power in the meantime: that is another visit, too.
    """
    POWER = "power"
    """`power`: the block was switched "on" or "off", was "found on", or a check found a "fault".

    `rails` are the supply's measurements at each rail; with a fault, phrases in `wrong` replace them.
    """
    WARMED_UP = "warmed_up"
    """`after_s`, from switching on; `at`, V, the settled signals where the warm-up waited for them."""
    EARLY_SIGN = "early_sign"
    """`step`, and an early sign."""
    SAME_SERIAL = "same_serial"
    """`words`, a sentence: instruments that state one serial number."""
    CERTIFICATE = "certificate"
    """`words`, a sentence: a certificate has expired, or is of another instrument than the one that answered."""
    WENT_ON = "went_on"
    """`step` and `causes` of an early sign that stopped the run; `reason` for going on."""
    WISH_REFUSED = "wish_refused"
    """`wish`; `why`, a sentence."""
    ASKED = "asked"
    """A prompt that may be answered from more than one place: its `id`, unique in the record, and its fields.

    The fields are `kind`, `text`, `default`, `unit`, `choices`, `minimum`, `maximum`, `action`, `picture`.
    The question is open until it is answered, or until the run continues or stops without an answer.
    """
    ANSWERED = "answered"
    """`id` of the prompt; `answer`, the one that counts; `by`, `role` and `where`; `line`, from 1.

    `line` is the number of the line in the file of answers in the run's folder.

    An answer that does not come from this file has no `line`.
    """
    ANSWER_REFUSED = "answer_refused"
    """The data of `answered`, with `answer` as given; `why`, a sentence."""
    CHAMBER_SLOW = "chamber_slow"
    """`chamber`, its name; its air `start_c` then, `air_c` now, `target_c` as demanded; `after_s`."""
    CLOCK_JUMPED = "clock_jumped"
    """`ahead_s`, the lead that civil time gained over bench time since the event before."""
    CHOSEN = "chosen"
    """The choice of the next points, in a run that goes on until its goals are reached.

    `visit` is the number of the mounting. `left_out` are ranges [first, last] of steps that are not needed,
    `taken_up` ranges of earlier such steps that are needed again. `now` is the state of the goal furthest
    from being reached (None before the readings determine the coefficients). `settings` and `repeats` are the
    numbers so far. `next` are the points, their time and their gain; `in_all` is what is expected until the
    end. `undecided` are the steps that later choices concern, with their expected time. `stop` is the reason
    for measuring nothing more.
    """
    IMPORTED = "imported"
    """`file`; `readings`, how many."""


MOST: Final = 1_000_000
"""Limit on the steps of a plan and the mountings of a run; a record that counts more is invalid."""

_Told = tuple[tuple[str, type[object]], ...]
_STEP: Final[_Told] = (("step", int),)
_STEPS: Final[_Told] = (("first", int), ("last", int))
_TOLD: Final[Mapping[str, _Told]] = {
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
"""The data that an event of each type must have, with their types; readers of records rely on them."""

_NUMBERS: Final = frozenset({int, float})


@dataclass(frozen=True)
class Event:
    """One line of the record: its number, civil time, bench time in s since the run began, type, contents.

    The type is an `EventType`, or a type of a later version.
    """

    number: int
    time: str
    bench_s: float
    type: str
    data: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return the event as the record holds it, without the hash of the line before."""
        return {
            "n": self.number,
            "time": self.time,
            "bench_s": self.bench_s,
            "type": self.type,
            **self.data,
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Event:
        """Return a recorded event, which keeps `data`.

        Raises `KeyError`, `TypeError`, `ValueError` for data that are no event.
        """
        number, time, bench_s, kind = data.pop("n"), data.pop("time"), data.pop("bench_s"), data.pop("type")
        if type(number) is not int or type(time) is not str or type(kind) is not str:
            raise ValueError("its number, time or type is none")
        if type(bench_s) not in _NUMBERS or not math.isfinite(bench_s):
            raise ValueError("its bench time is no number")
        for name, kinds in _TOLD.get(kind, ()):
            value: Any = data[name]
            if type(value) is not kinds or (isinstance(value, int) and not 0 <= value < MOST):
                raise ValueError(f"{name} is none")
        return cls(number, time, float(bench_s), kind, data)

    @property
    def step(self) -> int:
        """The step to which the event belongs."""
        return int(self.data["step"])

    @property
    def steps(self) -> range:
        """The steps that are skipped or redone."""
        return range(int(self.data["first"]), int(self.data["last"]) + 1)

    @cached_property
    def result(self) -> Result | None:
        """The result of a step; None for an event that ends no step, and for a step without a result."""
        return result_from_json(self.data) if self.type == EventType.STEP_DONE else None

    @property
    def reading(self) -> Reading | None:
        """The reading of a step, if it has one."""
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
"""Events possible in every run that has not ended, in whatever state its last program left it."""


def _stopped(state: RunState) -> Mapping[str, RunState]:
    """Return the row of a stopped run: another attempt that fails leaves its state unchanged."""
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
"""The state after each event, by the state before it; writers and readers of records allow no others."""

ENDED: Final = frozenset({RunState.FINISHED, RunState.ABORTED})
"""States in which nothing more happens to a run."""


class Wish(StrEnum):
    """The wishes that a person may have during a run."""

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
"""The wishes that are heard in each state."""


_CHANGING: Final = frozenset(event for row in TRANSITIONS.values() for event in row)


def state_after_one(state: RunState, event: str) -> RunState:
    """Return the state after a recorded event. Raises `ValueError` where the table does not allow it."""
    if event not in _CHANGING:
        return state
    if event not in TRANSITIONS[state]:
        raise ValueError(f"{event} cannot follow on {state}")
    return TRANSITIONS[state][event]
