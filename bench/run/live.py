"""Live signals while a person adjusts something: quick samples that are displayed and never recorded."""

from __future__ import annotations

import json
import math
import os
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS
from bench.base.languages import message, translated
from bench.config.procedure.plan import Plan, Read
from bench.readings.table import Reading
from bench.run.early_warning import EarlyWarning
from bench.run.events import Event, EventType
from bench.run.expectation import ExpectedSignals
from bench.run.workbench import Workbench
from drivers.clock import Clock, SystemClock, utc_now
from drivers.interfaces import BadReading, BenchError
from drivers.person import Prompt

LIVE: Final = "live.json"
"""The file in the run's folder with the latest value. Each sample replaces it; it is not part of the record."""

LOOK_S: Final = 0.25
"""Interval between two samples, s of real time."""

SETTLED_S: Final = 3.0
SETTLED_G: Final = 3e-5
"""Signals that change by less than this within `SETTLED_S` have settled, g: a tenth of the verification limit."""

QUIET_G: Final = 3e-4
"""A scatter above this, g, counts as motion; the noise of quick samples on the 10 V range is a third of it."""

TELLING_ARCSEC: Final = 60.0
"""Largest expanded uncertainty (k = 2) of a shown deviation from the commanded angle: a scale division."""

LINEAR_ARCSEC: Final = 3600.0
"""Up to this deviation, the error of its linear estimate is below 1 %."""

SHOWN_V: Final = 5
"""Decimals of a signal in the terminal: 10 µV, about an arcsecond."""


@dataclass(frozen=True)
class LiveValue:
    """The signals at one moment, V; if they could not be sampled, `why` gives the reason.

    `off_arcsec` is the deviation from the commanded angle, `expanded_arcsec` its expanded uncertainty (k = 2). Both
    are None if no angle is commanded or the deviation is not known well enough. `settled` is None until the signals
    have been sampled for `SETTLED_S`.
    """

    prompt: str
    time: str
    signals_v: tuple[float, ...] | None = None
    off_arcsec: float | None = None
    expanded_arcsec: float | None = None
    settled: bool | None = None
    why: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the value as written for the panel."""
        return {
            "prompt": self.prompt,
            "time": self.time,
            "signals_v": None if self.signals_v is None else list(self.signals_v),
            "settled": self.settled,
            "why": self.why,
            "to_go": self.to_go,
        }

    @property
    def to_go(self) -> str:
        """The turn still needed to reach the commanded angle, in words; empty if it is unknown."""
        if self.off_arcsec is None or self.expanded_arcsec is None:
            return ""
        if abs(self.off_arcsec) <= self.expanded_arcsec:
            return message(f"there, within {self.expanded_arcsec:.0f}″")
        too_far, off = self.off_arcsec > 0, abs(self.off_arcsec)
        if off > LINEAR_ARCSEC:
            most = f"{LINEAR_ARCSEC / 3600.0:.0f}°"
            return message(f"more than {most} too far") if too_far else message(f"more than {most} to go")
        u = f"{self.expanded_arcsec:.0f}″"
        return (
            message(f"{_angle(off)} too far (± {u})") if too_far else message(f"{_angle(off)} to go (± {u})")
        )

    def in_a_line(self) -> str:
        """Return the value as one line for the terminal, in the language of the prompts."""
        live = translated(message("live"))
        if self.signals_v is None:
            return f"{live}: {translated(self.why)}"
        signals = "  ".join(f"{c} {v:+.{SHOWN_V}f}" for c, v in zip(CHANNELS, self.signals_v, strict=True))
        state = {None: "", True: message("settled"), False: message("moving")}[self.settled]
        parts = (translated(part) for part in (self.to_go, state) if part)
        return "; ".join([f"{live}: {signals} V", *parts])


def _angle(arcsec: float) -> str:
    if arcsec < 120.0:
        return f"{arcsec:.0f}″"
    return f"{arcsec / 60.0:.1f}′" if arcsec < 7200.0 else f"{arcsec / 3600.0:.1f}°"


class LiveSignals:
    """Quick samples of the meters while a question waits, written to the file `LIVE` and shown by `show`.

    Events of the run tell which reading comes next. `scale_v_g` is the least scale factor of the block, V/g. After
    an instrument's error, except `BadReading`, no samples are taken until the next question.
    """

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        watcher: EarlyWarning,
        scale_v_g: float,
        show: Callable[[str], None] = lambda line: None,
        clock: Clock | None = None,
    ) -> None:
        self._file, self._plan, self._watcher, self._show = folder / LIVE, plan, watcher, show
        self._settled_v, self._quiet_v = SETTLED_G * scale_v_g, QUIET_G * scale_v_g
        self._clock = clock or SystemClock()
        self._bench: Workbench | None = None
        self._step = 0
        self._prompt: Prompt | None = None
        self._expected: ExpectedSignals | None = None
        self._silent = ""
        self._looked_s = -math.inf
        self._recent: deque[tuple[float, tuple[float, ...]]] = deque()

    def attach(self, bench: Workbench) -> None:
        """Take the samples with the meters of this bench from now on."""
        self._bench = bench

    def observe(self, event: Event) -> None:
        """Note which step of the plan is carried out."""
        if event.type == EventType.STEP_STARTED:
            self._step = event.step

    def begin(self, prompt: Prompt) -> None:
        """Begin to sample the signals while this question waits."""
        self._prompt, self._recent = prompt, deque()
        self._expected = self._expectation(prompt.action)
        self._silent = self._why_not()

    def look(self) -> None:
        """Sample the signals if a sample is due. Errors of instruments are not raised."""
        now_s = self._clock.now_s()
        if self._bench is None or self._prompt is None or now_s - self._looked_s < LOOK_S:
            return
        self._looked_s = now_s
        if self._silent:
            self._tell(LiveValue(self._prompt.id, utc_now().isoformat(), why=self._silent))
            self._prompt = None
            return
        try:
            signals = self._bench.glance()
        except BadReading:
            self._tell(LiveValue(self._prompt.id, utc_now().isoformat(), why="no valid signal (overload?)"))
            return
        except BenchError as error:
            self._silent = message(f"{error.instrument} cannot be read now; the next reading tries again")
            return
        self._tell(self._value(self._prompt.id, now_s, signals))

    def end(self) -> None:
        """Stop sampling; the bench restores the meters' settings before its next reading."""
        self._prompt = None
        with suppress(OSError):
            self._file.unlink(missing_ok=True)

    def _why_not(self) -> str:
        """Return why the meters of the bench cannot be sampled quickly; empty if they can."""
        meters = [] if self._bench is None else self._bench.instruments.voltmeters
        return next((f"{m.name}: {why}" for m in meters if (why := getattr(m, "not_live", ""))), "")

    def _value(self, prompt: str, now_s: float, signals: tuple[float, ...]) -> LiveValue:
        self._recent.append((now_s, signals))
        while len(self._recent) > 1 and now_s - self._recent[1][0] >= SETTLED_S:  # the oldest is older
            self._recent.popleft()
        off = expanded = None
        if self._expected is not None:
            off_rad, u_rad = self._expected.deviation_rad(np.asarray(signals))
            if 2.0 * u_rad / ARCSEC <= TELLING_ARCSEC:
                off, expanded = off_rad / ARCSEC, 2.0 * u_rad / ARCSEC
        return LiveValue(prompt, utc_now().isoformat(), signals, off, expanded, self._has_settled())

    def _has_settled(self) -> bool | None:
        """Return whether all signals have settled: scatter and slope of a fitted line are within limits.

        None if they were sampled for less than `SETTLED_S`.
        """
        times = np.array([time for time, _ in self._recent])
        values = np.array([signals for _, signals in self._recent])
        if times[-1] - times[0] < SETTLED_S or len(times) < 4:
            return None
        from_middle = times - times.mean()
        spread = math.sqrt(from_middle @ from_middle)
        slope = from_middle @ values / spread**2
        # noise from the median of successive differences, which a motion hardly affects
        noise = np.median(np.abs(np.diff(values, axis=0)), axis=0) / (0.6745 * math.sqrt(2.0))
        # with few samples, noise alone exceeds 5 estimated standard deviations in 1 % of the windows
        limit = np.maximum(self._settled_v / SETTLED_S, 5.0 * noise / spread)
        return bool(np.all((noise <= self._quiet_v) & (np.abs(slope) <= limit)))

    def _expectation(self, action: Mapping[str, Any]) -> ExpectedSignals | None:
        """Return the signals expected at the angle that `action` commands; None if it commands none."""
        if action["do"] != "turn":
            return None
        step = next((step for step in self._plan.steps[self._step :] if isinstance(step, Read)), None)
        if step is None or step.target_rad is None:
            return None
        return self._watcher.expect(
            Reading(
                installation=step.installation,
                series=step.series,
                pass_number=step.pass_number,
                point=step.point,
                angle_deg=math.degrees(action["target_rad"]),
                direction=action["direction"],
                mean=(0.0, 0.0, 0.0),
            )
        )

    def _tell(self, value: LiveValue) -> None:
        self._show(value.in_a_line())
        beside = self._file.with_suffix(".tmp")
        with suppress(OSError):  # a failed display must not stop a run
            beside.write_text(json.dumps(value.to_json()), encoding="utf-8")
            os.replace(beside, self._file)  # noqa: PTH105 - atomic, and without the flush of a record
