"""Execution of a plan step by step; each step is recorded before the next begins.

The runner knows instruments only by their interfaces, and the person only by the answers to prompts, so that it
cannot distinguish a simulated bench from a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import takewhile
from typing import Any, Final

from bench.config.procedure.plan import (
    SWITCHED_ON,
    Mount,
    OnFailure,
    Plan,
    Power,
    Read,
    SelectInput,
    SetTemperature,
    Step,
    Turn,
)
from bench.readings.table import Reading
from bench.run.driver_checks import named_fault
from bench.run.events import HEARD, TRANSITIONS, Event, EventType, RecordError, RunState, Wish, result_to_json
from bench.run.expectation import EarlySign
from bench.run.instruments import agree_to_others, how_it_stopped, leave_safe, same_serials
from bench.run.listening import Asker, ClockWatch
from bench.run.person import (
    NOBODY_KNOWN,
    Controls,
    OperatorWish,
    RunControl,
    Stopped,
    WishAuthor,
    confirm,
    raised,
)
from bench.run.power import NAP_S, UnitPower, take_up
from bench.run.record import Record, ResumePoint
from bench.run.resume import (
    PlanProgress,
    Redo,
    end_of_point,
    how_to_go_on,
    is_still_to_be_read,
    pause_prompt,
    redo_from,
    soak_to_repeat,
)
from bench.run.samples import Settling
from bench.run.workbench import BenchSetup, Workbench
from drivers.clock import Clock, SystemClock
from drivers.interfaces import BadReading, InstrumentLost, InstrumentRefused, message
from drivers.person import Person

Observer = Callable[[Event], None]
Watch = Callable[[Reading], Sequence[EarlySign]]
"""A function that judges a new reading and returns the early signs to be recorded."""

WORTH_REPEATING: Final = (BadReading, InstrumentLost, InstrumentRefused)
"""Failures that may not recur on the next attempt, unlike an exceeded limit or a missing answer."""

NO_REPEAT: Final = OnFailure(repeats=0, then="stop")


class RunAborted(Exception):
    """The person aborted the run; it cannot be resumed."""


@dataclass(frozen=True)
class People:
    """The people of a run, who answer its prompts and whose commands ("wishes") it obeys.

    `decider` is asked how to continue after a misfit; by default it is `person`. `asker` is the `Asker` behind
    `person` or `decider`, if a real person answers. `patience` is the clock used during a pause: real time, even if
    the bench is simulated. `hold_signals` keeps later signals from raising exceptions. `resumed_by` is the person
    who resumed the run, if known.
    """

    person: Person
    decider: Person | None = None
    asker: Asker | None = None
    controls: Controls = field(default_factory=Controls)
    patience: Clock = field(default_factory=SystemClock)
    hold_signals: Callable[[], None] = lambda: None
    resumed_by: WishAuthor = NOBODY_KNOWN


@dataclass
class Recorder:
    """Records a run's events. Once an event is on disk, it updates `progress`, then calls the `observers`.

    `clocks` detects jumps of civil time. `now_s` returns the bench time since the start of the run, s.
    """

    record: Record
    observers: Sequence[Observer] = ()
    progress: PlanProgress = field(default_factory=PlanProgress)
    clocks: ClockWatch | None = None
    now_s: Callable[[], float] = field(default=lambda: 0.0, init=False)

    def emit(self, kind: EventType, /, **data: Any) -> None:
        """Record an event with its `data`; then record a jump of the computer's clock, if there was one."""
        event = self.record.append(kind, self.now_s(), **data)
        self.progress.take(event)
        for observer in self.observers:
            with suppress(OSError):  # a closed terminal must not stop the run
                observer(event)
        if self.clocks is not None and (ahead_s := self.clocks.gap_s()):
            self.emit(EventType.CLOCK_JUMPED, ahead_s=round(ahead_s, 1))

    def tell(self, kind: EventType, data: dict[str, Any]) -> None:
        """Record an event reported by an instrument or by a prompt."""
        self.emit(kind, **data)


@dataclass
class Runner:
    """Executor of a plan: commands the bench, asks its people and records all events.

    `watch` judges each reading. `choose` receives a step index and the progress; if the next points have to be
    chosen, it returns the data of a `chosen` event, otherwise None. `certificates` receives the serial numbers by
    instrument name, and returns sentences on the instruments' certificates. `at_resumed_time` is called with the
    bench time at which a resumed run continues, s.
    """

    plan: Plan
    bench: BenchSetup
    people: People
    recorder: Recorder
    watch: Watch = lambda reading: ()
    choose: Callable[[int, PlanProgress], dict[str, Any] | None] = lambda index, progress: None
    certificates: Callable[[Mapping[str, str]], Sequence[str]] | None = None
    on_settling: Callable[[Settling], None] = lambda state: None
    at_resumed_time: Callable[[float], None] | None = None
    _zero_s: float = 0.0
    _soak_due: bool = False
    _index: int | None = None

    def __post_init__(self) -> None:
        people, bench, recorder = self.people, self.bench, self.recorder
        recorder.now_s = self._now_s
        self.progress, self._emit = recorder.progress, recorder.emit
        self._workbench = Workbench(
            bench,
            people.person,
            self._now_s,
            self._poll_wishes,
            on_settling=self.on_settling,
            tell=recorder.tell,
        )
        if people.asker is not None:
            people.asker.attach(
                recorder.tell, people.controls, lambda control: self._why_not(control, self._index)
            )
            if people.asker.live is not None:
                people.asker.live.attach(self._workbench)
        if bench.feeding is not None and (supply := bench.instruments.power_supply) is not None:
            power = UnitPower(
                supply,
                bench.feeding,
                people.person,
                bench.clock,
                self._now_s,
                self._poll_wishes,
                recorder.tell,
            )
            power.watch_while_asked(people.person, people.decider)
            self._workbench.power = power

    def run(self, resume: ResumePoint | None = None) -> None:
        """Open the instruments, carry out the plan, and leave the bench safe.

        With `resume`, first restore the bench to the state that the earlier steps left, then continue at that
        point; `progress` must already hold the completed steps. The first error is recorded, and raised after
        every instrument is safe and closed: `BenchError`, `RecordError`, `RunAborted`, `KeyboardInterrupt`. The
        notes of this error list other errors during shutdown and the tasks left for a person.
        """
        cause: BaseException | None = None
        try:
            try:
                self._run(resume)
            finally:
                self.people.hold_signals()
        except Exception as error:
            cause = self.bench.mistake() or named_fault(error, self.bench.instruments.all()) or error
        except BaseException as error:
            cause = error
        self._way_out(cause)
        if cause is not None:
            raise cause

    def _run(self, resume: ResumePoint | None) -> None:
        start, bench_s = (resume.step, resume.bench_s) if resume else (0, 0.0)
        self._workbench.visits = self.progress.remounts
        self._zero_s = self.bench.clock.now_s() - bench_s
        opened = self.bench.instruments.open()
        identities = {name: str(identity) for name, identity in opened.items()}
        self._insist(partial(agree_to_others, self.people.person, self.progress.identities, identities))
        serials = {name: identity.serial for name, identity in opened.items()}
        known = {} if self.certificates is None else {"serials": serials}
        begun = EventType.RUN_RESUMED if resume else EventType.RUN_STARTED
        author = self.people.resumed_by.to_json() if resume else {}
        self._emit(begun, step=start, instruments=identities, **known, **author)
        for words in same_serials(opened):
            self._emit(EventType.SAME_SERIAL, words=words)
        for words in self.certificates(serials) if self.certificates is not None else ():
            self._emit(EventType.CERTIFICATE, words=words)
        if resume:
            start = self._restore(resume)
        elif self._workbench.power is not None and self.plan.begins_on():
            self._insist(partial(self._workbench.do_power, SWITCHED_ON))
        self._carry_out(start)
        self._emit(EventType.RUN_FINISHED)

    def _carry_out(self, start: int) -> None:
        index = start
        while (index := self._choose(index)) < len(self.plan.steps) or self.progress.doubt is not None:
            self._index = index
            try:
                if self._ask_in_doubt():
                    continue
                self._poll_wishes()
                if self._soak_due:
                    self._soak_again(index)
                if not self.progress.settled(index):
                    self._step(index)
                index += 1
            except OperatorWish as wish:
                index = self._obey(wish.control, index)

    def _choose(self, index: int) -> int:
        """Choose points if a choice is due at step `index`, and record it; return the step to continue with."""
        if self.progress.doubt is not None or (chosen := self.choose(index, self.progress)) is None:
            return index
        self._emit(EventType.CHOSEN, **chosen)
        return min(index, chosen["next"]["first"]) if "next" in chosen else index

    def _ask_in_doubt(self) -> bool:
        """If an early sign stopped the run, ask how to continue and return True. Raises `OperatorWish`."""
        if (doubt := self.progress.doubt) is None:
            return False
        again = doubt.step in self.progress.in_vain
        reason = how_to_go_on(self.people.decider or self.people.person, doubt, again=again)
        decision = {"causes": doubt.data["causes"], "reason": reason, **self._answerer().to_json()}
        self._emit(EventType.WENT_ON, step=doubt.step, **decision)
        return True

    # --- the life of a run ---------------------------------------------------------------------------

    def _way_out(self, cause: BaseException | None) -> None:
        """Leave the bench safe, then record why the run stopped and which tasks are left for a person."""
        to_do = leave_safe(self.bench.instruments, self._workbench.demanded_c, self._workbench.power)
        try:
            self._record_stop(cause)
            if self._workbench.power is not None and self._workbench.power.left_off:
                self.recorder.tell(EventType.POWER, {"power": "off", "rails": {}})
            if to_do:
                self._emit(EventType.LEFT_SAFE, to_do=to_do)
        except RecordError as error:
            if cause is not None and not isinstance(cause, RecordError):
                cause.add_note(str(error))
            if cause is not None and to_do:
                cause.add_note("; ".join(f"{name}: {what}" for name, what in to_do.items()))

    def _record_stop(self, cause: BaseException | None) -> None:
        """Record the cause of the stop, unless the run has already ended or the record cannot be written."""
        if cause is None or isinstance(cause, RecordError | RunAborted):
            return
        event, data = how_it_stopped(cause, self.people.controls.stopped)
        if event in TRANSITIONS[self.recorder.record.state]:
            self._emit(event, **data)

    def _now_s(self) -> float:
        return self.bench.clock.now_s() - self._zero_s

    def _restore(self, resume: ResumePoint) -> int:
        """Restore the bench, with every question before the long waits; return the step to continue with."""
        self._workbench.platform_moved = self.progress.platform_moved
        before = self.plan.steps[: resume.step]
        for kind in (SetTemperature, Mount, SelectInput):
            kept = (step for i, step in enumerate(before) if i not in self.progress.left_out)
            last = next((step for step in reversed([*kept]) if isinstance(step, kind)), None)
            if isinstance(last, SetTemperature):
                self._insist(partial(self._workbench.do_temperature, last))
            elif isinstance(last, Mount) and is_still_to_be_read(self.plan, self.progress, resume.step):
                at = resume.step if self.progress.doubt is None else self.progress.doubt.step
                self._insist(partial(self._remount, last, at))
            elif isinstance(last, SelectInput) and last.source != "signal":
                self._insist(partial(self._workbench.execute, last))
        start = self._decided(resume.step)
        if (power := self._workbench.power) is not None:
            known = (power, self.plan, start, self.progress)
            self._insist(
                partial(take_up, *known, self._workbench.do_power, partial(self._emit_remounted, why="power"))
            )
        self._soak_again(start)
        if resume.turn is not None and start == resume.step:
            self._insist(partial(self._step, resume.turn))
        self.progress.reopen(self.plan, start)
        if self.at_resumed_time is not None:
            self.at_resumed_time(resume.bench_s)
            self._zero_s = self.bench.clock.now_s() - resume.bench_s
        return start

    def _decided(self, index: int) -> int:
        """Have a person decide on an open early sign before step `index`; return the step to continue with."""
        self._index = index
        while self.progress.doubt is not None:
            try:
                self._ask_in_doubt()
            except OperatorWish as wish:
                index = self._obey(wish.control, index)
        return index

    def _soak_again(self, step: int) -> None:
        """Repeat, before `step`, the waits that followed the last setting of the chamber (`soak_to_repeat`)."""
        for soak in soak_to_repeat(self.plan, self.progress, step):
            self._insist(partial(self._step, soak))
        self._soak_due = False

    def _remount(self, step: Mount, index: int) -> None:
        """Ask whether the block is still mounted as it was; if not, readings from `index` on form a new visit."""
        if self._workbench.still_mounted(step):
            self._workbench.temperature_c = self.progress.temperature_c
            return
        self._emit_remounted(self._next_on(step, index))

    def _next_on(self, mounting: Mount, index: int) -> Mount | Read:
        """Return the next reading on a mounting from step `index` on, whose series may be later; or `mounting`."""
        coming = takewhile(lambda step: not isinstance(step, Mount), self.plan.steps[index:])
        return next(
            (step for step in coming if isinstance(step, Read) and step.target_rad is not None), mounting
        )

    def _emit_remounted(self, step: Mount | Read, why: str = "") -> None:
        """Record that the block was mounted again or lost power, so that its later readings form a new visit."""
        planned = (s.series for s in self.plan.steps if isinstance(s, Mount | Read))
        visit = 1 + max(*planned, *self.progress.remounts.values())
        cause = {"why": why} if why else {}
        place = {"installation": step.installation, "series": step.series}
        self._emit(EventType.REMOUNTED, **place, now_series=visit, **cause)

    def _insist(self, prepare: Callable[[], object]) -> None:
        """Repeat the preparation `prepare`, which precedes the steps, until it succeeds.

        Obey a wish to abort. After a wish to pause, start the preparation over. Refuse every other wish.
        """
        index, self._index = self._index, None
        try:
            while True:
                try:
                    prepare()
                    return
                except OperatorWish as wish:
                    if wish.control.wish is Wish.ABORT:
                        raise self._aborted(wish.control) from None
                    if why := self._why_not(wish.control, None):
                        self._refuse(wish.control, why)
        finally:
            self._index = index

    # --- wishes --------------------------------------------------------------------------------------

    def _poll_wishes(self) -> None:
        """Raise `OperatorWish` or `Stopped` if a wish has arrived.

        A wish that cannot be obeyed is refused here, so that no soak or switching under way begins again.
        """
        if self.people.asker is not None:
            self.people.asker.drain()
        if (control := self.people.controls.poll()) is None:
            return
        if self._index is None and control.wish is Wish.PAUSE:  # afterwards the wait would begin again
            why = message("a wait before the next step is repeated; pause after it, or stop the run")
        else:
            why = self._why_not(control, self._index)
        if not why:
            raise raised(control)
        self._refuse(control, why)

    def _answerer(self) -> WishAuthor:
        return NOBODY_KNOWN if self.people.asker is None else self.people.asker.answered_by

    def _obey(self, control: RunControl, index: int) -> int:
        """Obey a wish received at step `index`; return the step to continue with."""
        if control.by_person and control.who == NOBODY_KNOWN:
            control = replace(control, who=self._answerer())
        if why := self._why_not(control, index):
            self._refuse(control, why)
            return index
        match control.wish:
            case Wish.PAUSE:
                return self._pause(control, index)
            case Wish.CONTINUE:
                self._emit(EventType.RUN_CONTINUED, **control.who.to_json())
            case Wish.REPEAT_POINT | Wish.REPEAT_PASS | Wish.MOUNT_AGAIN:
                if (found := redo_from(self.plan, self.progress, control.wish, index)) is not None:
                    return self._redo(control, found, index)
            case Wish.SKIP:
                last = end_of_point(self.plan, index) - 1
                self._emit(EventType.SKIPPED, first=index, last=last, **control.reason_and_author())
                return last + 1
            case Wish.ABORT:
                raise self._aborted(control)
            case Wish.STOP:
                raise Stopped(control)
        return index

    def _why_not(self, control: RunControl, index: int | None) -> str:
        """Return why a wish at step `index` (None: before the steps) cannot be obeyed, or an empty string."""
        wish, state = control.wish, self.recorder.record.state
        if index is None:
            kept = wish in (Wish.PAUSE, Wish.ABORT, Wish.STOP)
            return "" if kept else message("no step is running yet")
        if wish not in HEARD[state]:
            return f"the run is {state}"
        if wish in (Wish.REPEAT_POINT, Wish.REPEAT_PASS, Wish.MOUNT_AGAIN):
            if self._workbench.platform_moved:
                return message("the platform was levelled since the last point")
            if redo_from(self.plan, self.progress, wish, index) is None:
                return message("no point was measured since the block was mounted or switched")
        if wish is Wish.SKIP:
            if self.progress.doubt is not None:
                return message("first answer the question about the reading in doubt")
            if isinstance(self.plan.steps[index], Mount):
                return message("the block must be mounted before the readings that follow")
            if self._is_switched_otherwise(self.plan.steps[index]):
                return message("the block must be switched as planned before the readings that follow")
        return ""

    def _is_switched_otherwise(self, step: Step) -> bool:
        power = self._workbench.power
        return isinstance(step, Power) and power is not None and power.on == (step.switch == "off")

    def _aborted(self, control: RunControl) -> RunAborted:
        self._emit(EventType.RUN_ABORTED, **control.reason_and_author())
        return RunAborted(control.reason)

    def _refuse(self, control: RunControl, why: str) -> None:
        self._emit(EventType.WISH_REFUSED, wish=control.wish.value, why=why, **control.who.to_json())

    def _pause(self, pause: RunControl, index: int) -> int:
        """Wait, with the bench idle, until a wish ends the pause; return the step to continue with."""
        self._emit(EventType.RUN_PAUSED, **pause.reason_and_author())
        ask = pause.by_person or self.people.asker is not None
        while self.recorder.record.state is RunState.PAUSED:
            control = self._asked() if ask else self.people.controls.poll()
            if control is None:
                self._workbench.watch_rails("paused")
                self.people.patience.sleep(NAP_S)
                continue
            after = self._obey(control, index)
            if self.recorder.record.state is RunState.PAUSED and after != index:
                self._emit(EventType.RUN_CONTINUED, **control.who.to_json())
            index = after
        return index

    def _asked(self) -> RunControl:
        try:
            confirm(self.people.asker or self.people.person, pause_prompt(self._now_s()))
        except OperatorWish as wish:
            return wish.control
        return RunControl(Wish.CONTINUE, by_person=True, who=self._answerer())

    def _redo(self, control: RunControl, found: Redo, index: int) -> int:
        """Repeat the last point, or its whole pass, from its first turn; return the step to continue with."""
        request = {"wish": control.wish.value, **control.who.to_json()}
        self._emit(EventType.REDO, first=found.first, last=found.last, **request)
        if found.mount is not None:
            self._insist(partial(self._workbench.do_mount, found.mount))
            self._emit_remounted(self._next_on(found.mount, found.first))
            self._soak_due = True
        return min(found.first, index)

    # --- steps ---------------------------------------------------------------------------------------

    def _step(self, index: int) -> None:
        """Carry out a step; after a transient failure repeat it, then skip or stop as its failure policy says."""
        step = self.plan.steps[index]
        policy = step.on_failure if isinstance(step, Read | Turn) else NO_REPEAT
        for tries_left in range(policy.repeats, -1, -1):
            begun = {"step": index, "key": step.key, "attempt": self.progress.attempt(index)}
            self._emit(EventType.STEP_STARTED, **begun)
            try:
                result = self._workbench.execute(step)
            except WORTH_REPEATING as error:
                if self.bench.mistake() or (not tries_left and policy.then == "stop"):
                    raise
                self._emit(EventType.STEP_FAILED, step=index, key=step.key, error=str(error))
                continue
            self._emit(EventType.STEP_DONE, **begun, **result_to_json(result))
            for sign in self.watch(result) if isinstance(result, Reading) else ():
                self._emit(EventType.EARLY_SIGN, step=index, **sign.to_json())
            return
        # after a failed turn, the point's readings would be at a wrong angle
        last = end_of_point(self.plan, index) - 1 if isinstance(step, Turn) else index
        self._emit(EventType.SKIPPED, first=index, last=last, reason=f"failed {policy.repeats + 1} times")
