"""Followers of runs send snapshots and residuals as server-sent events; all viewers of a run share one."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.files import from_text, open_regular
from bench.base.languages import message
from bench.base.numbers import without_infinity
from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.procedure.plan import Mount, Plan, Read
from bench.panel.holding import Holding, read_holding
from bench.panel.run_events import RunView, Tail
from bench.panel.run_state import About, snapshot
from bench.readings.table import Reading
from bench.run.early_warning import watcher_of
from bench.run.events import Event, EventType, RecordError
from bench.run.folder import BENCH, Run
from bench.run.live import LIVE
from bench.run.person import AskedPrompt
from bench.run.record import is_being_written
from bench.run.terminal import TimeLeft
from bench.services.own_effects import knowing_effects_on_record
from drivers.clock import Clock, SystemClock, utc_now

MOST_POINTS: Final = 200
COVERAGE: Final = 2.0
"""Coverage factor: half-width of the plotted bands in standard uncertainties."""


@dataclass(frozen=True)
class PlottedPoints:
    """The points of a `ResidualPlot` at some moment; `version` counts how often earlier points changed."""

    version: int = 0
    points: tuple[dict[str, Any], ...] = ()

    def since(self, told: PlottedPoints) -> dict[str, Any]:
        """Return the update for a viewer who has `told`: new points, index of the first, coverage factor."""
        begin = len(told.points) if told.version == self.version else 0
        return {"from": begin, "k": COVERAGE, "points": self.points[begin:]}


class ResidualPlot:
    """The readings of a run minus their predictions, as points for viewers; `plotted` is replaced at each change.

    A point has the keys `n` (event number), `step`, `installation`, `series`, `pass`, `point`, `angle_deg`,
    `time_s`. For each channel it has the `residual`, its standard uncertainty `u` (both in `unit`) and `sigma`, the
    residual divided by `u`. `struck` is True if the reading was replaced by a repetition.
    """

    def __init__(self, plan: Plan, bench: BenchFile) -> None:
        self._watcher = watcher_of(plan, bench)
        self._steps = plan.steps
        self._waiting: deque[Event] = deque()
        self._readings = 0
        self.plotted = PlottedPoints()

    def note(self, event: Event) -> None:
        """Queue an event for `judge_next`."""
        if event.type not in _TOLD:
            return
        if event.type == EventType.STEP_DONE and not isinstance(self._steps[event.step], Read | Mount):
            return
        self._waiting.append(event)
        self._readings += _is_reading(event)
        while self._readings > MOST_POINTS:
            self._readings -= _is_reading(self._waiting.popleft())

    @property
    def waiting(self) -> bool:
        """Whether queued readings still await comparison with their predictions."""
        return self._readings > 0

    def judge_next(self) -> bool:
        """Compare the next queued reading with its prediction; return whether a reading was queued."""
        while self._waiting:
            event = self._waiting.popleft()
            self._watcher.observe(event)
            match event.type:
                case EventType.REDO:
                    self._strike(event)
                case EventType.STEP_DONE if isinstance(reading := event.result, Reading):
                    self._readings -= 1
                    self._watcher.take(reading)
                    self._add(event, reading)
                    return True
        return False

    def _strike(self, redo: Event) -> None:
        points, steps = self.plotted.points, set(redo.steps)
        struck = [{**one, "struck": one["struck"] or one["step"] in steps} for one in points]
        if struck != [*points]:
            self.plotted = PlottedPoints(self.plotted.version + 1, tuple(struck))

    def _add(self, event: Event, reading: Reading) -> None:
        judged = self._watcher.judged
        if judged is None or reading.angle_deg is None:
            return
        u = np.sqrt(np.diagonal(judged.covariance[0]))
        point = {
            "n": event.number,
            "step": event.step,
            "installation": reading.installation,
            "series": reading.series,
            "pass": reading.pass_number,
            "point": reading.point,
            "angle_deg": reading.angle_deg,
            "time_s": event.bench_s if reading.time_s is None else reading.time_s,
            "unit": reading.unit,
            "residual": [float(f"{value:.6g}") for value in judged.residual[0]],
            "u": [float(f"{value:.4g}") for value in u],
            "sigma": [float(f"{value:.3g}") for value in judged.sigma[0]],
            "struck": False,
        }
        before = self.plotted
        too_many = len(before.points) == MOST_POINTS
        self.plotted = PlottedPoints(before.version + too_many, (*before.points[too_many:], point))


_TOLD: Final = frozenset({EventType.STEP_DONE, EventType.REMOUNTED, EventType.REDO, EventType.WENT_ON})


def _is_reading(event: Event) -> bool:
    return "reading" in event.data


DISK_NEEDED: Final = 1 << 16
"""Free space (bytes) without which a program cannot continue the record of a run."""
ALIVE_LOOK_S: Final = 1.0
"""Interval (s) of the check whether a program still carries out the run."""


class Follower:
    """A follower of one run's events and residuals. Raises `RecordError`, `FileMistakes` for an unreadable run."""

    def __init__(self, folder: Path, clock: Clock | None = None) -> None:
        run = Run(folder)
        self._folder = folder
        self._clock = clock or SystemClock()
        self._tail = Tail(folder)
        self._seen = RunView(run.plan)
        with knowing_effects_on_record(run):
            bench = load_bench(folder / BENCH)
        self.residuals = ResidualPlot(run.plan, bench)
        supply = bench.unit_under_test.supply
        step_s = [run.plan.step_duration_s(step, bench.line_frequency, supply) for step in run.plan.steps]
        self._time_left = TimeLeft(step_s)
        manifest = run.manifest
        unit = manifest.get("unit_under_test", {"type": "", "serial": ""})
        told = {
            "run": run.name,
            "title": run.plan.name,
            "simulated": run.simulated,
            "unit": f"{unit.get('type', '')} {unit.get('serial', '')}".strip(),
            **{name: str(manifest.get(name, "")) for name in ("operator", "procedure", "bench")},
        }
        self._about = About(told, bench.installation_models(), bench.instruments.chamber is not None)
        self._alive, self._looked_s = False, -ALIVE_LOOK_S
        self._unheard = 0
        """Questions up to this event number cannot be answered: the program that asked them has ended."""

    def look(self) -> bool:
        """Read new events; return whether the snapshot of the run has changed. Raises `RecordError`."""
        grown = self._tail.grown()
        # growth without a known writer comes from a new program, whose question can be answered
        changed = self._look_for_writer(at_once=grown and not self._alive)
        if grown:
            for event in self._tail.new():
                self._seen.take(event)
                self._time_left.take(event)
                self.residuals.note(event)
                changed = True
        if not self._alive:
            self._unheard = self._seen.events
        return changed

    @property
    def prompt(self) -> AskedPrompt | None:
        """The open question; None if there is none, or if no program waits for the answer."""
        asked = self._seen.prompt
        return asked if self._alive and asked is not None and asked.event.number > self._unheard else None

    def live(self) -> bytes:
        """Return the latest live value of an open question as JSON; empty if there is none."""
        if self.prompt is None:
            return b""
        try:
            with open_regular(self._folder / LIVE) as file:
                return file.read(MOST_LIVE)
        except OSError:
            return b""

    def state(self) -> dict[str, Any]:
        """Return the current snapshot of the run, see `bench.panel.run_state.snapshot`."""
        return snapshot(
            self._seen,
            self._about,
            self._time_left,
            self.prompt,
            alive=self._alive,
            now=utc_now(),
            disk_full=not self._alive and shutil.disk_usage(self._folder).free < DISK_NEEDED,
        )

    def _look_for_writer(self, *, at_once: bool) -> bool:
        """Check, when due or `at_once`, whether a program carries out the run; return whether this has changed."""
        now_s = self._clock.now_s()
        if not at_once and now_s - self._looked_s < ALIVE_LOOK_S:
            return False
        self._looked_s, before = now_s, self._alive
        self._alive = is_being_written(self._folder)
        return self._alive is not before


LOOK_S: Final = 0.05
LIVE_LOOK_S: Final = 0.02
"""Interval (s) at which the live value is read; reading it waits neither for events nor for comparisons."""

BEAT_S: Final = 2.0
LINGER_S: Final = 30.0
"""Time (s) for which a follower without viewers is kept, so that a reloaded page finds it again."""

MOST_LIVE: Final = 4096
"""Largest file of a live value, bytes."""

JUDGED_AT_ONCE: Final = 20
"""Number of readings judged between updates, so that a long run can be viewed while it is judged."""


def as_event(name: str, data: Any) -> bytes:
    """Return a server-sent event with JSON data, which never contains a line end."""
    text = json.dumps(without_infinity(data), ensure_ascii=True, separators=(",", ":"))
    return f"event: {name}\ndata: {text}\n\n".encode()


def as_live(value: bytes) -> bytes:
    """Return a server-sent event with a run's live value; its data are {} for a missing or damaged value."""
    try:
        told = from_text(value) if value else {}
    except ValueError:
        told = {}
    return as_event("live", told if isinstance(told, dict) else {})


class SharedFollower:
    """A `Follower` shared by viewers on an event loop: it reads in a thread, and wakes viewers that wait.

    `state` is the latest snapshot. `trouble` is the error that stopped the follower, else empty.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._follower: Follower | None = None
        self._news = asyncio.Event()
        self._holding: Holding | None = None
        self.version = 0
        self.points = PlottedPoints()
        self.state: dict[str, Any] = {}
        self.sent_state = b""
        self.live = b""
        self.trouble = ""
        self.watchers = 0
        self._ready = asyncio.Event()
        self._task = asyncio.create_task(self._follow())
        self._live_task = asyncio.create_task(self._follow_live())

    @property
    def prompt(self) -> AskedPrompt | None:
        """The open question; None if there is none, or if no program waits for the answer."""
        return None if self._follower is None else self._follower.prompt

    @property
    def judging(self) -> bool:
        """Whether readings still await comparison with their predictions."""
        return self._follower is not None and self._follower.residuals.waiting

    @property
    def over(self) -> bool:
        """Whether the follower no longer reads the run, because of an error or because it was stopped."""
        return bool(self.trouble) or self._task.done()

    async def ready(self) -> None:
        """Wait until there is a first snapshot or an error."""
        await self._ready.wait()

    def stop(self) -> None:
        """Stop following the run."""
        self._task.cancel()
        self._live_task.cancel()

    async def wait(self, version: int) -> bool:
        """Wait at most 2 s (`BEAT_S`) until `self.version` differs from `version`; return whether it differs."""
        if self.version == version:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), BEAT_S)
        return self.version != version

    async def _follow(self) -> None:
        while True:
            try:
                news = await asyncio.to_thread(self._look)
            except (RecordError, FileMistakes, OSError) as error:
                news, self.trouble = str(error) != self.trouble, str(error)
            except Exception as error:  # a defect must not leave a page that looks alive
                news, self.trouble = (
                    not self.trouble,
                    message(f"the panel can no longer follow this run: {error!r}"),
                )
            if news:
                self._wake()
            self._ready.set()
            if self.trouble:
                return
            await asyncio.sleep(0.0 if self.judging else LOOK_S)

    async def _follow_live(self) -> None:
        while not self.over:
            live = b"" if self._follower is None or not self.watchers else self._follower.live()
            if live != self.live:
                self.live = live
                self._wake()
            await asyncio.sleep(LIVE_LOOK_S)

    def _wake(self) -> None:
        """Wake the streams of all viewers; each then sends the changes to its viewer."""
        self.version += 1
        awaited, self._news = self._news, asyncio.Event()
        awaited.set()

    def _look(self) -> bool:
        """Read new events; return whether there is an update to send."""
        if self._follower is None:
            self._follower = Follower(self._folder)
        follower, before = self._follower, self.points
        read = follower.look()
        if not read:
            for _ in range(JUDGED_AT_ONCE):
                if not follower.residuals.judge_next():
                    break
        self.points = follower.residuals.plotted
        holding = read_holding(self._folder)
        if read or holding != self._holding or not self.state:
            self._holding = holding
            self.state = {**follower.state(), "control": holding.to_json()}
            self.sent_state = as_event("state", self.state)
            return True
        return self.points is not before


class Followers:
    """The followers of all runs that have viewers; all followers belong to one event loop."""

    def __init__(self) -> None:
        self._shared: dict[Path, SharedFollower] = {}

    async def state(self, folder: Path) -> dict[str, Any]:
        """Return the snapshot of a run. Raises `RecordError` if it cannot be read."""
        async with self._watched(folder) as shared:
            return shared.state

    async def prompt(self, folder: Path) -> AskedPrompt | None:
        """Return the open question of a run. Raises `RecordError` if its record cannot be read."""
        async with self._watched(folder) as shared:
            return shared.prompt

    async def points(self, folder: Path) -> tuple[dict[str, Any], ...]:
        """Return a run's points once all readings are compared. Raises `RecordError` for a damaged run."""
        async with self._watched(folder) as shared:
            while shared.judging and not shared.trouble:
                await shared.wait(shared.version)
            return shared.points.points

    async def stream(self, folder: Path) -> AsyncIterator[bytes]:
        """Yield a run's server-sent events for one viewer. Raises `RecordError` if the first look fails."""
        async with self._watched(folder) as shared:
            told, sent, live = PlottedPoints(), b"", b""
            while not shared.trouble:
                version = shared.version
                if shared.sent_state is not sent:
                    sent = shared.sent_state
                    yield sent
                if shared.live != live:
                    live = shared.live
                    yield as_live(live)
                if (points := shared.points) is not told:
                    yield as_event("points", points.since(told))
                    told = points
                if not await shared.wait(version):
                    yield as_event("beat", {})
            yield as_event("trouble", {"words": shared.trouble})

    def close(self) -> None:
        """Stop following all runs."""
        for shared in self._shared.values():
            shared.stop()
        self._shared.clear()

    @asynccontextmanager
    async def _watched(self, folder: Path) -> AsyncIterator[SharedFollower]:
        """Yield the follower of a run; start one if there is none. Raises `RecordError` for a damaged run."""
        shared = self._shared.get(folder)
        if shared is None or shared.over:
            shared = self._shared[folder] = SharedFollower(folder)
        shared.watchers += 1
        try:
            await shared.ready()
            if shared.trouble:
                raise RecordError(shared.trouble)
            yield shared
        finally:
            shared.watchers -= 1
            if shared.watchers == 0:
                with suppress(RuntimeError):  # the loop has ended
                    asyncio.get_running_loop().call_later(LINGER_S, self._forget, folder, shared)

    def _forget(self, folder: Path, shared: SharedFollower) -> None:
        if shared.watchers == 0:
            shared.stop()
            if self._shared.get(folder) is shared:
                del self._shared[folder]
