"""One run followed: its record read as it grows, and what is told of it to whoever looks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from bench.api.own_effects import knowing_effects_on_record
from bench.files.bench.file import load_bench
from bench.panel.following.residuals import Points, Residuals
from bench.panel.following.seen import Seen
from bench.panel.following.snapshot import About, snapshot
from bench.panel.following.tail import Tail
from bench.run.answers import AskedPrompt
from bench.run.events import EventType
from bench.run.folder import BENCH, Run
from bench.run.record import is_being_written
from bench.run.time_left import TimeLeft
from drivers.clock import Clock, SystemClock, utc_now

LOOK_S: Final = 1.0
"""So often it is looked whether a program still carries the run out."""


class Follower:
    """Follows a run. Raises `RecordError`, `FileMistakes` where its inputs or its record cannot be read."""

    def __init__(self, folder: Path, clock: Clock | None = None) -> None:
        run = Run(folder)
        self._folder = folder
        self._clock = clock or SystemClock()
        self._tail = Tail(folder)
        self._seen = Seen(run.plan)
        with knowing_effects_on_record(run):
            bench = load_bench(folder / BENCH)
        self._residuals = Residuals(run.plan, bench)
        supply = bench.unit_under_test.supply
        step_s = [run.plan.step_duration_s(step, bench.line_frequency, supply) for step in run.plan.steps]
        self._time_left = TimeLeft(step_s)
        manifest = run.manifest
        unit = manifest.get("unit_under_test", {"type": "", "serial": ""})
        self._about = About(
            run=run.name,
            title=run.plan.name,
            simulated=run.simulated,
            unit=f"{unit.get('type', '')} {unit.get('serial', '')}".strip(),
            operator=str(manifest.get("operator", "")),
            procedure=str(manifest.get("procedure", "")),
            bench=str(manifest.get("bench", "")),
            installations=bench.installation_models(),
            chamber=bench.instruments.chamber is not None,
        )
        self._alive, self._looked_s = False, -LOOK_S
        self._unheard = 0
        """Up to this event nobody hears an answer any more: the program that asked is gone."""

    def look(self) -> bool:
        """Read what is new; say whether what is told of the run has changed. Raises `RecordError`."""
        grown = self._tail.grown()
        # what comes where nobody was thought to write is another program's: its question is to be heard
        changed = self._look_for_writer(at_once=grown and not self._alive)
        if grown:
            for event in self._tail.new():
                self._seen.take(event)
                if event.type == EventType.CHOSEN:
                    self._time_left.choose(event.data)
                self._residuals.note(event)
                changed = True
        if not self._alive:
            self._unheard = self._seen.events
        return changed

    def judge(self) -> bool:
        """Judge one reading more against its prediction; say whether there was one."""
        return self._residuals.judge_next()

    @property
    def prompt(self) -> AskedPrompt | None:
        """The question that stands, None where none does or nobody would hear an answer."""
        asked = self._seen.prompt
        return asked if self._alive and asked is not None and asked.event.number > self._unheard else None

    @property
    def waiting(self) -> bool:
        """Whether readings wait to be judged."""
        return self._residuals.waiting

    def state(self) -> dict[str, Any]:
        """Return what is told of the run now, see `bench.panel.following.snapshot`."""
        if (begun := self._seen.begun) is not None:
            self._time_left.begin(begun.step, begun.bench_s)
        return snapshot(
            self._seen, self._about, self._time_left, self.prompt, alive=self._alive, now=utc_now()
        )

    @property
    def points_version(self) -> tuple[int, int]:
        """What changes with the points: how often those before were changed, and how many there are."""
        return self._residuals.version, len(self._residuals.points)

    def points(self) -> Points:
        """Return the readings against their predictions as they are now."""
        return Points(self._residuals.version, tuple(self._residuals.points))

    def _look_for_writer(self, *, at_once: bool) -> bool:
        """Look now and then, or at once, whether the run is carried out; say whether that has changed."""
        now_s = self._clock.now_s()
        if not at_once and now_s - self._looked_s < LOOK_S:
            return False
        self._looked_s, before = now_s, self._alive
        self._alive = is_being_written(self._folder)
        return self._alive is not before
