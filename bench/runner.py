"""Carries out a plan: one step after the other, each recorded before the next begins.

The runner knows instruments only by their interfaces and the person only as somebody who answers prompts;
it cannot tell a simulated bench from a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np

from bench.asking import ask, confirm
from bench.mounting import mount_picture, mount_text
from bench.plan import Ask, Mount, Plan, Read, SetTemperature, Step, Turn, Wait
from bench.record import Event, Record
from bench.resume import ResumePoint
from drivers.clock import Clock
from drivers.interfaces import (
    CHANNELS,
    BenchError,
    Channel,
    DividingHead,
    HeadPosition,
    Identity,
    Instrument,
    NotConnected,
    Person,
    Prompt,
    PromptKind,
    ThermalChamber,
    Voltmeter,
    VoltmeterSettings,
)

Observer = Callable[[Event], None]

NAP_S: Final = 1.0
"""Waiting is cut into naps, so that progress is shown and Ctrl-C is heard."""


class State(StrEnum):
    """What a run is doing."""

    READY = "ready"
    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    ABORTED = "aborted"


TRANSITIONS: Final[Mapping[State, Mapping[str, State]]] = {
    State.READY: {
        "run_started": State.RUNNING,
        "run_resumed": State.RUNNING,
        "run_failed": State.FAILED,
        "run_interrupted": State.INTERRUPTED,
    },
    State.RUNNING: {
        "run_finished": State.FINISHED,
        "run_failed": State.FAILED,
        "run_interrupted": State.INTERRUPTED,
    },
    State.FAILED: {"run_resumed": State.RUNNING, "run_aborted": State.ABORTED},
    State.INTERRUPTED: {"run_resumed": State.RUNNING, "run_aborted": State.ABORTED},
    State.FINISHED: {},
    State.ABORTED: {},
}
"""Which event leads from which state to which: there is no other way.

A program that resumes a run begins at READY again; what the run was before stands in its record."""


@dataclass(frozen=True)
class Instruments:
    """The bench as the runner sees it. Together the voltmeters carry the channels x, y, z once each."""

    voltmeters: Sequence[Voltmeter]
    head: DividingHead
    chamber: ThermalChamber | None = None

    def all(self) -> list[Instrument]:
        """Every instrument, in the order in which they are opened."""
        return [*self.voltmeters, self.head, *([self.chamber] if self.chamber else [])]


@dataclass
class _Bench:
    """What the runner knows of the bench while it works."""

    position: HeadPosition | None = None
    temperature_c: float | None = None
    settings: VoltmeterSettings | None = None


@dataclass
class Runner:
    """Executes a plan.

    `range_v` is the voltmeters' fixed range. `observers` see each event after it is on the disk.
    `at_resumed_time` is told the bench time from which a resumed run goes on.
    """

    plan: Plan
    instruments: Instruments
    person: Person
    clock: Clock
    record: Record
    range_v: float
    observers: Sequence[Observer] = ()
    at_resumed_time: Callable[[float], None] | None = None
    state: State = State.READY
    _zero_s: float = 0.0
    _bench: _Bench = field(default_factory=_Bench)

    def run(self, resume: ResumePoint | None = None) -> None:
        """Open the instruments, carry out the plan, leave the bench safe.

        A resumed run begins where `resume` says, after the block was mounted and the chamber set as the
        steps before demand. Raises what went wrong, recorded, after every instrument was closed:
        `BenchError`, `RecordError`, `KeyboardInterrupt` (Ctrl-C).
        """
        start, bench_s, finished = 0, 0.0, frozenset[int]()
        if resume:
            start, bench_s, finished = resume.step, resume.bench_s, resume.finished
        try:
            identities = self._open()
            self._zero_s = self.clock.now_s() - bench_s
            self._change("run_resumed" if resume else "run_started", step=start, instruments=identities)
            self._restore(start)
            self._continue_from(bench_s)
            for index in range(start, len(self.plan.steps)):
                if index not in finished:
                    self._step(index)
            self._change("run_finished")
        except KeyboardInterrupt:
            self._leave("run_interrupted")
            raise
        except BenchError as error:
            self._leave("run_failed", error=str(error), instrument=error.instrument)
            raise
        finally:
            for instrument in self.instruments.all():
                instrument.close()

    # --- the life of a run ---------------------------------------------------------------------------

    def _open(self) -> dict[str, str]:
        """Open everything and report every failure at once."""
        identities: dict[str, str] = {}
        failures: list[BenchError] = []
        for instrument in self.instruments.all():
            try:
                identity: Identity = instrument.open()
            except BenchError as error:
                failures.append(error)
            else:
                identities[instrument.name] = str(identity)
        if failures:
            raise failures[0] if len(failures) == 1 else NotConnected(failures)
        return identities

    def _change(self, event: str, **data: Any) -> None:
        self.state = TRANSITIONS[self.state][event]
        self._emit(event, **data)

    def _leave(self, event: str, **data: Any) -> None:
        """Record how the run stopped, where it had begun at all."""
        if event in TRANSITIONS[self.state]:
            self._change(event, **data)

    def _emit(self, kind: str, **data: Any) -> None:
        event = self.record.append(kind, self._now_s(), **data)
        for observer in self.observers:
            observer(event)

    def _now_s(self) -> float:
        return self.clock.now_s() - self._zero_s

    def _continue_from(self, bench_s: float) -> None:
        """Count bench time on from `bench_s`, the moment at which the step to be repeated began."""
        if self.at_resumed_time is not None:
            self.at_resumed_time(bench_s)
        self._zero_s = self.clock.now_s() - bench_s

    def _restore(self, start: int) -> None:
        """Bring the bench to where the steps before `start` left it; nothing of this is a result."""
        before = self.plan.steps[:start]
        for kind in (SetTemperature, Mount):
            last = next((step for step in reversed(before) if isinstance(step, kind)), None)
            if isinstance(last, SetTemperature):
                self._set_temperature(last)
            elif isinstance(last, Mount):
                self._mount(last)

    # --- steps ---------------------------------------------------------------------------------------

    def _step(self, index: int) -> None:
        step = self.plan.steps[index]
        self._emit("step_started", step=index, key=step.key)
        result = self._execute(step)
        self._emit("step_done", step=index, key=step.key, **result)

    def _execute(self, step: Step) -> dict[str, Any]:
        match step:
            case Mount():
                return self._mount(step)
            case Turn():
                return self._turn(step)
            case Read():
                return {"reading": self._read(step)}
            case Wait():
                return self._wait(step)
            case SetTemperature():
                return self._set_temperature(step)
            case Ask():
                return self._ask(step)

    def _mount(self, step: Mount) -> dict[str, Any]:
        prompt = Prompt(
            id=step.key,
            kind=PromptKind.CONFIRM,
            text=mount_text(step.installation, step.series),
            default="yes",
            action={"do": "mount", "installation": step.installation, "series": step.series},
            picture=mount_picture(step.installation),
        )
        confirm(self.person, prompt)
        self._bench.position = None
        chamber = self.instruments.chamber
        if chamber is not None and chamber.asks_person:
            self._bench.temperature_c = chamber.temperature(step.key)
        return {"temperature_c": self._bench.temperature_c}

    def _turn(self, step: Turn) -> dict[str, Any]:
        position = self.instruments.head.move(step.target_rad, step.direction, step.key)
        self._bench.position = position
        return {"angle_deg": _degrees(position.angle_rad), "target_deg": _degrees(step.target_rad)}

    def _wait(self, step: Wait) -> dict[str, Any]:
        end_s = self.clock.now_s() + step.duration_s
        while (left_s := end_s - self.clock.now_s()) > 0:
            self.clock.sleep(min(NAP_S, left_s))
        return {}

    def _set_temperature(self, step: SetTemperature) -> dict[str, Any]:
        chamber = self.instruments.chamber
        if chamber is None:
            raise BenchError(
                "chamber",
                "the procedure sets a temperature, but the bench has no chamber",
                "add one to the bench file, or take a procedure without temperatures",
            )
        chamber.set_temperature(step.target_c, step.key)
        return {"target_c": step.target_c}

    def _ask(self, step: Ask) -> dict[str, Any]:
        prompt = Prompt(
            id=step.key,
            kind=step.kind,
            text=step.text,
            default=step.default,
            unit=step.unit,
            choices=step.choices,
            minimum=step.minimum,
            maximum=step.maximum,
            action={"do": "answer"},
        )
        return {"answer": ask(self.person, prompt)}

    def _read(self, step: Read) -> dict[str, Any]:
        self._configure(VoltmeterSettings(self.range_v, step.nplc, step.samples))
        chamber = self.instruments.chamber
        if chamber is not None and not chamber.asks_person:
            self._bench.temperature_c = chamber.temperature(step.key)
        begun_s = self._now_s()
        for meter in self.instruments.voltmeters:
            meter.start()
        samples: dict[Channel, tuple[float, ...]] = {}
        for meter in self.instruments.voltmeters:
            samples.update(meter.fetch())
        position = self._bench.position
        return {
            "installation": step.installation,
            "series": step.series,
            "pass": step.pass_number,
            "point": step.point,
            "target_deg": _degrees(step.target_rad),
            "angle_deg": None if position is None else _degrees(position.angle_rad),
            "direction": 0 if position is None else position.direction,
            "time_s": begun_s,
            "temperature_c": self._bench.temperature_c,
            "unit": "V",
            "mean": [float(np.mean(samples[channel])) for channel in CHANNELS],
            "sd": [_sd(samples[channel]) for channel in CHANNELS],
            "samples_taken": step.samples,
            "samples": {channel: list(samples[channel]) for channel in CHANNELS},
        }

    def _configure(self, settings: VoltmeterSettings) -> None:
        if settings == self._bench.settings:
            return
        for meter in self.instruments.voltmeters:
            meter.configure(settings)
        self._bench.settings = settings


def _degrees(angle_rad: float | None) -> float | None:
    """Degrees to 1e-9, so that 45° is written 45 and nothing that a scale can show is lost."""
    return None if angle_rad is None else round(float(np.degrees(angle_rad)), 9)


def _sd(samples: Sequence[float]) -> float | None:
    return float(np.std(samples, ddof=1)) if len(samples) > 1 else None
