"""What a run's record consists of: the manifest, the events, what steps bring; the states that events lead to."""

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
    """How the run's verdict is found, where that was asked for in place of the bench file's."""

    limit_g: float
    rule: str
    guard_band: float


class DefaultRule(TypedDict):
    """The decision rule of a run for which nobody states one, with the probability that sets its guard band."""

    rule: str
    false_acceptance: float


DEFAULT_RULE: Final[DefaultRule] = {"rule": "non-binary", "false_acceptance": 0.05}
"""The default as each record keeps it: one that has none was begun when simple acceptance was the default."""


class CheckedBefore(TypedDict, total=False):
    """What the check block said as the run began: `run` of the check block, how old, what the `rule` is.

    `state` is in control, out of control, too old or missing, `said` the same in words; `despite` is why the run
    was begun all the same, where the state spoke against it.
    """

    rule: str
    state: str
    said: str
    run: str
    age_h: float
    despite: str


class Manifest(TypedDict, total=False):
    """What a run was begun with (`run.json`), in this order; `files` are the SHA-256 of the inputs by name.

    `seed` is None for a run on real instruments. A run of a readings file (`imported`) says how many
    `readings` that has, and nothing of a procedure. `living` is a dry run whose questions a person answers.
    `bench_why` says why that bench file was taken. `devices` says
    where those drivers came from that are none of the bench's own, `verdict` how it is judged in place of the bench
    file's, `default_rule` how where neither says it, `until` the goals at which it ends, `check_block` what that
    said; all are left out where there is nothing.
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
    """A run folder that cannot be written or believed; the text says where, why and what to do."""


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Return the inputs' manifest of a run. Raises `RecordError` when there is none."""
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
    """Say which of the inputs of a run are not what its manifest says. Raises `RecordError` without a manifest."""
    return [
        f"{name} was changed since the run began"
        for name, digest in read_manifest(folder).get("files", {}).items()
        if not (folder / name).is_file() or sha256(read_regular(folder / name)) != digest
    ]


# --- results of steps -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mounted:
    """The block is mounted; `temperature_c` is what a person told, None where nobody was asked."""

    temperature_c: float | None


@dataclass(frozen=True)
class Turned:
    """The head was turned: where it stands, read back, and where it was to go."""

    angle_deg: float
    target_deg: float


@dataclass(frozen=True)
class TemperatureSet:
    """The chamber was set."""

    target_c: float


@dataclass(frozen=True)
class CameToRest:
    """What was waited for has settled: how long that took and at which values, V or °C."""

    settled_s: float
    settled_at: tuple[float, ...]


@dataclass(frozen=True)
class InputSelected:
    """The inputs were switched, to a reference of so many volts where it is one."""

    source: str
    reference_v: float | None


@dataclass(frozen=True)
class Answered:
    """The person answered a question of the procedure."""

    answer: str


@dataclass(frozen=True)
class Powered:
    """The block was switched: "on", "off" or "cycle"; how long it then warmed up, s, and at which signals, V."""

    switched: str
    warmed_up_s: float | None
    warmed_up_at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Levelled:
    """What the level showed with the head at 0°: α1 and α2 of the platform with their standard uncertainties.

    `level_of` and `level_series` say for which mounting; `adjusted` that the platform was levelled before, else it
    stood as it was found. `level_zero_arcsec` is the level's own zero along the shaft and across, `level_readings`
    for each setting the head's angle, then along and across in the first and in the turned position, arcsec.
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
"""What a step brings; a wait brings none."""

_KINDS: Final = (Mounted, Turned, TemperatureSet, CameToRest, InputSelected, Answered, Levelled, Powered)
"""Results, which their fields tell apart in a record."""


@cache
def _fields() -> Mapping[Callable[..., Result], tuple[str, ...]]:
    """Return the fields of each kind of result; kinds of step in modules of their own bring theirs."""
    from bench.config.procedure.plan import KINDS  # takes long to import

    further = (kind.BRINGS for kind in KINDS if kind.BRINGS is not None)
    return {kind: tuple(of.name for of in fields(kind)) for kind in (*_KINDS, *further)}


def result_to_json(result: Result | None) -> dict[str, Any]:
    """Return what is recorded of a step."""
    if result is None:
        return {}
    return {"reading": result.to_json()} if isinstance(result, Reading) else asdict(result)


def result_from_json(data: Mapping[str, Any]) -> Result | None:
    """Return what a step brought from what is recorded of it, of a reading all but its samples.

    Raises `KeyError`, `TypeError`, `ValueError` for what no step brings.
    """
    if "reading" in data:
        return Reading.from_json(data["reading"] | {"samples": {}})
    brought = {kind: {n: data[n] for n in names if n in data} for kind, names in _fields().items()}
    # kinds may have a field in common: the one that accounts for the most is meant
    kind, values = max(brought.items(), key=lambda one: len(one[1]))
    return kind(**values) if values else None


# --- events -----------------------------------------------------------------------------------------


class EventType(StrEnum):
    """What may be recorded, with the names of what is told of it.

    What somebody wished says in `by`, `role` and `where` who it was, where that is known.
    """

    RUN_STARTED = "run_started"
    """`step`, the first one; `instruments`, their identities by name; `serials`, in a dry run only where it has
    certificates."""
    RUN_RESUMED = "run_resumed"
    """As of `run_started`."""
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
    """`to_do`, what a person must still do, by instrument."""
    STEP_STARTED = "step_started"
    """`step`, its place in the plan from 0; `key`; `attempt`, from 1."""
    STEP_DONE = "step_done"
    """As of `step_started`, and what the step brought."""
    STEP_FAILED = "step_failed"
    """`step`, `key`; `error`, a sentence."""
    SKIPPED = "skipped"
    """`first` and `last` of the steps; `reason`."""
    REDO = "redo"
    """`first` and `last` of the steps; `wish`."""
    REMOUNTED = "remounted"
    """`installation`, `series`, and `now_series` by which its further readings are known.

    With `why` the block was not taken off, but without power in the meantime: that is another visit, too.
    """
    POWER = "power"
    """`power`: the block was switched "on" or "off", "found on", or a look found a "fault".

    `rails` is what the supply measures at each; with a fault there are phrases in its place, `wrong`."""
    WARMED_UP = "warmed_up"
    """`after_s`, from switching on; where it was waited until the signals had settled, `at`, V."""
    EARLY_SIGN = "early_sign"
    """`step`, and an early sign."""
    SAME_SERIAL = "same_serial"
    """`words`, a sentence: instruments that state one serial number."""
    CERTIFICATE = "certificate"
    """`words`, a sentence: a certificate has expired, or is of another instrument than the one that answered."""
    WENT_ON = "went_on"
    """`step` and `causes` of an early sign that stopped the run; `reason` why it is gone on."""
    WISH_REFUSED = "wish_refused"
    """`wish`; `why`, a sentence."""
    ASKED = "asked"
    """A prompt that may be answered from more than one place: `id`, which no other of the record has, and the
    fields of a prompt: `kind`, `text`, `default`, `unit`, `choices`, `minimum`, `maximum`, `action`, `picture`.

    It stands until it is answered, or the run goes on, or stops, without an answer."""
    ANSWERED = "answered"
    """`id` of the prompt; `answer`, as it counts; `by`, `role` and `where`; `line` of the answers left in the
    run's folder, from 1, where it is one of these."""
    ANSWER_REFUSED = "answer_refused"
    """As of `answered`, `answer` as it was given; `why`, a sentence."""
    CHAMBER_SLOW = "chamber_slow"
    """`chamber`, its name; `start_c`, `air_c` and `target_c`, where it was, is and was sent; `after_s`."""
    CLOCK_JUMPED = "clock_jumped"
    """`ahead_s`, by how much civil time went ahead of the bench's since the event before."""
    CHOSEN = "chosen"
    """What is measured next, where a run goes on until it is good enough: `visit`, the number of the
    mounting; `left_out`, ranges [first, last] of steps that are not needed, and `taken_up`, of such that
    are after all; `now`, what the goal that is furthest from reached is at (None before the readings
    determine the coefficients); `settings` and `repeats` so far; `next`, the points, what they take and
    bring; `in_all`, what is expected until the end; `undecided`, the steps that later choices are about,
    with the time expected of them; or `stop`, why nothing more is measured."""
    IMPORTED = "imported"
    """`file`; `readings`, how many."""


MOST: Final = 1_000_000
"""No plan has as many steps, and no run as many mountings: what counts more of them is none of ours."""

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
"""What an event must tell, and as what, for those who read records to rely on it."""

_NUMBERS: Final = frozenset({int, float})


@dataclass(frozen=True)
class Event:
    """One line of the record: its number, civil time, bench time in s since the run began, type, contents.

    The type is an `EventType`, or one of a later version.
    """

    number: int
    time: str
    bench_s: float
    type: str
    data: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return it as the record holds it, save for the hash of the line before."""
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

        Raises `KeyError`, `TypeError`, `ValueError` for what is none.
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
        """The step that it is about."""
        return int(self.data["step"])

    @property
    def steps(self) -> range:
        """The steps that are skipped or to be done again."""
        return range(int(self.data["first"]), int(self.data["last"]) + 1)

    @cached_property
    def result(self) -> Result | None:
        """What a step brought; None for events that are not the end of one, and a step that brought nothing."""
        return result_from_json(self.data) if self.type == EventType.STEP_DONE else None

    @property
    def reading(self) -> Reading | None:
        """The reading that a step brought, if it did."""
        return result if isinstance(result := self.result, Reading) else None


class RunState(StrEnum):
    """What a run is doing."""

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
"""What may happen to every run that has not ended, whatever its last program left it at."""


def _stopped(state: RunState) -> Mapping[str, RunState]:
    """Return the row of a run that has stopped: a further attempt that fails leaves it as it was."""
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
"""Which event leads from which state to which: there is no other way, for who writes a record or reads it."""

ENDED: Final = frozenset({RunState.FINISHED, RunState.ABORTED})
"""States in which nothing more happens to a run."""


class Wish(StrEnum):
    """What a person may ask of a run that goes on."""

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
"""Which wishes are heard in which state."""


_CHANGING: Final = frozenset(event for row in TRANSITIONS.values() for event in row)


def state_after_one(state: RunState, event: str) -> RunState:
    """Return the state that an event on record leads to. Raises `ValueError` where the table does not allow it."""
    if event not in _CHANGING:
        return state
    if event not in TRANSITIONS[state]:
        raise ValueError(f"{event} cannot follow on {state}")
    return TRANSITIONS[state][event]
