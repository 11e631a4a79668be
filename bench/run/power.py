"""The power supply of the block during a run: switching, warm-up, monitoring, and the safe state."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from bench.base.languages import message
from bench.base.text import duration
from bench.config.bench_file.stand import DriftForm, RailSection, UnitSupplySection
from bench.config.procedure.plan import Mount, Plan, Power, Read
from bench.readings.columns import Rail
from bench.run.driver_checks import checked_states
from bench.run.events import EventType
from bench.run.person import ask
from bench.run.resume import PlanProgress
from bench.run.samples import Criterion, NotSettled, Settling, wait_until_settled
from drivers.clock import Clock
from drivers.interfaces import (
    BadReading,
    BenchError,
    InstrumentLost,
    InstrumentRefused,
    OutputState,
    PowerSupply,
    SetOtherwise,
    SupplyLimits,
)
from drivers.making_safe import Attempts
from drivers.person import Person, Prompt, PromptKind, WatchingPerson

WATCH_S: Final = 10.0
"""Interval between checks of the rails during a wait, s."""
IN_RUSH_S: Final = 2.0
"""Time from switching on to the first check of the rails, s; the inrush current has then decayed."""
NAP_S: Final = 1.0
"""Longest sleep during a wait, s, so that the operator's commands and Ctrl-C take effect soon."""

SET_AGAIN: Final = message("switch off and set again")
STAYED_ON: Final = message("it stayed on")
WAS_OFF: Final = message("it was off")

_PASSING: Final = (InstrumentLost, BadReading, InstrumentRefused)
"""Failures of a check that may not recur at the next check; at a reading, they invalidate the reading."""


class RailFault(BenchError):
    """A supply rail of the block is out of its limits; readings since the last good check are not trusted."""


@dataclass(frozen=True)
class Feeding:
    """The block's supply as stated in the bench file, and the limits of the instrument, if known."""

    section: UnitSupplySection
    limits: SupplyLimits | None = None


@dataclass
class UnitPower:
    """The block's power supply during a run; `now_s` returns the bench time since the run began, s.

    `nap` is called repeatedly during waits and handles the operator's commands; `tell` records events. `on` says
    whether the block was on after the last switching or check. `off_since_s` is the value of `now_s` when the block
    was switched off, None if unknown; `on_since_s` is the value of `clock` when it was switched on, s. `in_charge`
    says whether this run has switched the block, or found it on and took it over.
    """

    supply: PowerSupply
    fed: Feeding
    person: Person
    clock: Clock
    now_s: Callable[[], float]
    nap: Callable[[], None]
    tell: Callable[[EventType, dict[str, Any]], None]
    on: bool = field(default=False, init=False)
    in_charge: bool = field(default=False, init=False)
    off_since_s: float | None = None
    on_since_s: float = field(default=0.0, init=False)
    _left_on: bool = field(default=False, init=False)
    _looked_s: float = field(default=0.0, init=False)
    _seen: Mapping[str, Rail] = field(default_factory=dict, init=False)

    @property
    def section(self) -> UnitSupplySection:
        """The bench file's section on the block's supply."""
        return self.fed.section

    # --- switching -----------------------------------------------------------------------------------

    def have_on(self, key: str) -> None:
        """Ensure that the block is on, with the settings and protections of the bench file.

        A block that is on with these settings is left unchanged. If the settings differ, or only some rails are on,
        the person is asked before the block is switched off and on again. Raises `RailFault` or `BenchError`.
        """
        try:
            self.supply.set_up(self._settings(), key)
        except SetOtherwise as found:
            otherwise = found.cause
        else:
            states = checked_states(self.supply, self.supply.state(key))
            on = [rail.name for rail in self.section.rails if self._of(states, rail).on]
            if not on:
                self._switch_on(key, set_up=True)
                return
            if len(on) == len(self.section.rails):
                self.on, self.in_charge, self.on_since_s = True, True, self.clock.now_s()
                self._record_event("found on", self.look(key))
                return
            otherwise = message(f"of its rails only {', '.join(on)} is on")
        self._ask_about(otherwise, key)
        self.switch_off(key)
        self._switch_on(key)

    def _ask_about(self, otherwise: str, key: str) -> None:
        """Ask whether a supply that is on with other settings may be changed. Raises `BenchError` if not.

        `otherwise` describes the difference.
        """
        prompt = Prompt(
            id=f"{key}/found",
            kind=PromptKind.CHOOSE,
            text=message(
                f"The {self.supply.name} is on, and its settings differ from the bench file: {otherwise}. "
                "Check what it feeds. Have it switched off and set as the bench file says, or leave it on "
                "and stop the run"
            ),
            choices=(SET_AGAIN, message("leave it")),
            action={"do": "ask"},
        )
        if ask(self.person, prompt) != SET_AGAIN:
            raise BenchError(
                self.supply.name,
                f"it is on with other settings than the bench file states: {otherwise}",
                "correct its settings or the bench file",
            )

    def _switch_on(self, key: str, *, set_up: bool = False) -> None:
        """Set up the supply, switch the rails on in order, and check them; after a failure switch all off."""
        self._stay_off(key)
        if not set_up:
            self.supply.set_up(self._settings(), key)
        self.in_charge = True
        try:
            for number, rail in enumerate(self.section.rails):
                if number:
                    self.clock.sleep(self.section.pause)
                self.supply.switch(rail.output, True, key)
            self.on_since_s = self.clock.now_s()
            self.clock.sleep(IN_RUSH_S)
            rails = self.look(key)
        except BaseException as error:
            if trouble := self._off(key):
                error.add_note(trouble)
            raise
        self.on = True
        self._record_event("on", rails)

    def switch_off(self, key: str) -> None:
        """Switch the rails off, in reverse order. Raises `BenchError` if the supply does not obey."""
        self.in_charge = True
        for number, rail in enumerate(reversed(self.section.rails)):
            if number:
                self.clock.sleep(self.section.pause)
            self.supply.switch(rail.output, False, key)
        self.on, self.off_since_s = False, self.now_s()
        self._record_event("off", {})

    def cycle(self, off_s: float, key: str) -> None:
        """Switch the block off and on again; it stays off for `off_s`, or longer if the bench file says so."""
        self.switch_off(key)
        self._stay_off(key, off_s)
        self._switch_on(key)

    def _stay_off(self, key: str, off_s: float = 0.0) -> None:
        """Wait until the block has been off long enough; if nobody knows since when, count from now."""
        least_s = max(off_s, self.section.least_off)
        since_s = self.now_s() if self.off_since_s is None else self.off_since_s
        while (left_s := since_s + least_s - self.now_s()) > 0.0:
            self.nap()
            self.clock.sleep(min(NAP_S, left_s))

    def _off(self, key: str) -> str:
        """Switch everything off despite errors; return the task left for a person, or an empty string.

        During shutdown, a person who operates the supply receives a task and no prompt.
        """
        rails = Attempts()
        for number, rail in enumerate(() if self.supply.asks_person else reversed(self.section.rails)):
            if number:
                self.clock.sleep(self.section.pause)
            by_hand = message(
                f"its rail {rail.name} did not switch off by itself: find the cause before the next run"
            )
            rails.make(by_hand, partial(self.supply.switch, rail.output, False, key))
        remedy = rails.end()
        if remedy or self.supply.asks_person:
            whole = Attempts()
            whole.make(
                message("could not switch the block off: switch it off by hand"), self.supply.switch_all_off
            )
            if to_do := whole.end():
                return to_do
        self.on, self.off_since_s = False, self.now_s()
        return remedy

    def leave(self) -> str:
        """Put the block into its safe state; return the task left for a person, or "". No error is raised.

        A block that this run has neither switched nor taken over is left unchanged.
        """
        if not self.in_charge or self.section.when_unsafe == "stay-on":
            return ""
        self._left_on = self.on
        return self._off("end/power")

    @property
    def left_off(self) -> bool:
        """Whether `leave` switched the block off."""
        return self._left_on and not self.on

    # --- checking ------------------------------------------------------------------------------------

    def look(self, key: str) -> Mapping[str, Rail]:
        """Return the measured voltage and current by rail. Raises `RailFault`, and the errors of `supply.state`."""
        states = checked_states(self.supply, self.supply.state(key))
        self._looked_s = self.clock.now_s()
        wrong = [
            message(f"rail {rail.name} {what}")
            for rail in self.section.rails
            for what in self._wrong(states, rail)
        ]
        if wrong:
            self.tell(EventType.POWER, {"power": "fault", "wrong": wrong})
            raise RailFault(
                self.supply.name,
                "; ".join(wrong),
                "find the cause before you continue; the block then warms up again and counts as mounted again",
            )
        self._seen = {
            rail.name: Rail(state.voltage_v, rail.voltage, state.current_a)
            for rail in self.section.rails
            for state in (self._of(states, rail),)
        }
        return self._seen

    def at_reading(self, key: str) -> Mapping[str, Rail]:
        """Return the measured rails before or after a reading; empty if the block is off.

        For a supply read by a person, return the last values, to avoid a prompt at each reading. Raises the
        errors of `look`.
        """
        if not self.on:
            return {}
        return self._seen if self.supply.asks_person else self.look(key)

    def watch(self, key: str) -> None:
        """Check the rails of a block that is on, `WATCH_S` after the last check, unless a person reads them.

        Raises only `RailFault`.
        """
        due = self.clock.now_s() - self._looked_s >= WATCH_S
        if not self.on or self.supply.asks_person or not due:
            return
        try:
            self.look(key)
        except RailFault:
            raise
        except _PASSING:
            self._looked_s = self.clock.now_s()

    def watch_while_asked(self, *persons: Person | None) -> None:
        """Check the rails also while questions to `persons` wait, unless a person reads the supply."""
        if self.supply.asks_person:
            return
        for person in persons:
            if isinstance(person, WatchingPerson):
                person.meanwhile = partial(self.watch, "asked")

    def is_as_left(self, key: str) -> bool:
        """Return whether the block stayed on since the run stopped; the supply shows this, or a person says it."""
        if self.supply.asks_person:
            prompt = Prompt(
                id=f"{key}/since",
                kind=PromptKind.CHOOSE,
                text=message("The block was on when the run stopped. Has it been on all the time since?"),
                default=WAS_OFF,
                choices=(STAYED_ON, WAS_OFF),
                action={"do": "ask"},
            )
            return ask(self.person, prompt) == STAYED_ON
        states = checked_states(self.supply, self.supply.state(key))
        return not any(self._not_on(states, rail) for rail in self.section.rails)

    def _wrong(self, states: Mapping[str, OutputState], rail: RailSection) -> Iterator[str]:
        state = self._of(states, rail)
        if not_on := self._not_on(states, rail):
            yield not_on
            return
        if state.limiting:
            yield message(f"is in current limit, with {state.voltage_v:.4g} V at {state.current_a:.3g} A")
        low_v, high_v = rail.window_v
        if not low_v <= state.voltage_v <= high_v:
            yield message(f"has {state.voltage_v:.5g} V, not {low_v:g} to {high_v:g} V")
        low_a, high_a = rail.current.minimum, rail.current.maximum
        if not low_a <= state.current_a <= high_a:
            yield message(f"gives {state.current_a:.3g} A, not {low_a:g} to {high_a:g} A")
        limits = self.fed.limits
        if limits is not None and rail.output in limits.outputs:
            differences = limits.outputs[rail.output].differences(state.settings, rail.settings)
            yield from (message(f"was set otherwise: {what}") for what in differences)

    def _not_on(self, states: Mapping[str, OutputState], rail: RailSection) -> str:
        state = self._of(states, rail)
        if state.tripped:
            return message("was switched off by a protection of the supply, which tripped")
        return "" if state.on else message("is off: it was switched off, or the supply was without power")

    def _of(self, states: Mapping[str, OutputState], rail: RailSection) -> OutputState:
        if rail.output not in states:
            has = ", ".join(states)
            raise InstrumentRefused(
                self.supply.name,
                f"it has no output {rail.output} (it has {has})",
                "correct the bench file",
            )
        return states[rail.output]

    def _settings(self) -> dict[str, Any]:
        return {rail.output: rail.settings for rail in self.section.rails}

    def _record_event(self, what: str, rails: Mapping[str, Rail]) -> None:
        self.tell(
            EventType.POWER, {"power": what, "rails": {name: rail.to_json() for name, rail in rails.items()}}
        )


_RESUMED: Final = "resume/power"

Switch = Callable[[Power], object]
"""A function that carries out a power step: switches the block on and waits for its warm-up."""


def warm_up(
    power: UnitPower,
    stated_s: float | None,
    sample: Callable[[], Sequence[float]],
    on_progress: Callable[[Settling], None],
    key: str,
) -> tuple[float, tuple[float, ...]]:
    """Wait until the block is warm; return the time since it was switched on, s, and the settled signals, V.

    `stated_s` overrides the warm-up of the bench file; `sample` returns the signals, V. After a warm-up of fixed
    duration, no signals are returned. The rails are checked during the wait. Raises `RailFault` or `NotSettled`.
    """
    wanted = power.section.warm_up if stated_s is None else stated_s
    clock = power.clock
    at: tuple[float, ...] = ()

    def between(state: Settling) -> None:
        on_progress(state)
        power.nap()
        power.watch(key)

    if isinstance(wanted, DriftForm):
        at = _until_settled(power, wanted, sample, between)
    else:
        while (left_s := power.on_since_s + wanted - clock.now_s()) > 0.0:
            between(Settling(False, wanted - left_s, 0, (), (), left_s))
            clock.sleep(min(NAP_S, left_s))
    after_s = clock.now_s() - power.on_since_s
    power.tell(EventType.WARMED_UP, {"after_s": round(after_s, 3), **({"at": list(at)} if at else {})})
    return after_s, at


def _until_settled(
    power: UnitPower,
    wanted: DriftForm,
    sample: Callable[[], Sequence[float]],
    between: Callable[[Settling], None],
) -> tuple[float, ...]:
    criterion = Criterion(wanted.drift, wanted.per, wanted.timeout, wanted.interval)
    try:
        return wait_until_settled(sample, criterion, power.clock, between).values
    except NotSettled as moved:
        raise NotSettled(
            moved.instrument,
            f"the block was not warm {duration(wanted.timeout)} after it was switched on: {moved.cause}",
            "find what moves or warms the block and resume, or lengthen the timeout of its warm-up in the bench "
            "file and start a new run",
            moved.state,
        ) from moved


def take_up(
    power: UnitPower,
    plan: Plan,
    first: int,
    progress: PlanProgress,
    switch: Switch,
    another_visit: Callable[[Read], None],
) -> None:
    """Switch the block on before step `first` of a resumed run, if the plan has it on there.

    `switch` warms the block up again if it was not warm yet, or if it was off according to the record, the supply
    or the person. If it was off and the present mounting already has readings, `another_visit` is called with the
    next reading, so that the remaining readings count as those of a new mounting.
    """
    if not _on_at(plan, first):
        return
    power.off_since_s = progress.off_since_s
    was_off = progress.power not in {"on", "found on"} or not power.is_as_left(_RESUMED)
    if progress.warm and not was_off:
        power.have_on(_RESUMED)
        power.tell(EventType.WARMED_UP, {"after_s": None})
        return
    switch(Power(_RESUMED, "on"))
    following = _next_of_a_visit(plan, first, progress)
    if was_off and following is not None:
        another_visit(following)


def _on_at(plan: Plan, step: int) -> bool:
    """Return whether, by the plan, the block is switched on before step `step`."""
    for before in reversed(plan.steps[:step]):
        if isinstance(before, Power):
            return before.switch != "off"
    return plan.begins_on()


def _next_of_a_visit(plan: Plan, first: int, progress: PlanProgress) -> Read | None:
    """Return the next reading on the present mounting if its visit already has a reading; else None."""
    for index in range(first, len(plan.steps)):
        step = plan.steps[index]
        if isinstance(step, Mount):
            return None
        if isinstance(step, Read) and step.target_rad is not None and not progress.settled(index):
            visit = (step.installation, step.series)
            begun = any(
                isinstance(before, Read) and (before.installation, before.series) == visit
                for before in (plan.steps[i] for i in sorted(progress.done))
            )
            return step if begun else None
    return None
