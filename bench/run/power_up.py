"""The block on and warm: before the first step of a run, and when a run is taken up again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from bench.base.words import duration
from bench.files.bench.rails import DriftForm
from bench.procedure.plan import SWITCHED_ON, Mount, Plan, Power, Read
from bench.run.events import EventType
from bench.run.power import NAP_S, UnitPower
from bench.run.resume import Progress
from bench.run.settling import Criterion, NotSettled, Settling, wait_until_settled

_RESUMED: Final = "resume/power"

Switch = Callable[[Power], object]
"""Carries out a step that switches the block on and lets it warm up."""


def warm_up(
    power: UnitPower,
    stated_s: float | None,
    sample: Callable[[], Sequence[float]],
    on_progress: Callable[[Settling], None],
    key: str,
) -> tuple[float, tuple[float, ...]]:
    """Wait until the block is warm; return how long after switching on that was, s, and at which signals, V.

    `stated_s` is a time in place of what the bench file says; `sample` returns the signals. Meanwhile the rails are
    watched. Raises `RailFault`, `NotSettled`.
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
            between(Settling(False, wanted - left_s, 0, (), (), 0.0, left_s))
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
            f"not warm {duration(wanted.timeout)} after it was switched on: {moved.cause}",
            "look for what moves or warms it and resume, or lengthen the timeout of its warm-up in the bench file",
            moved.state,
        ) from moved


def begin(plan: Plan, switch: Switch) -> None:
    """Have the block on and warm before the first step, where the plan leaves that to the run."""
    if plan.begins_on():
        switch(SWITCHED_ON)


def take_up(
    power: UnitPower,
    plan: Plan,
    first: int,
    progress: Progress,
    switch: Switch,
    another_visit: Callable[[Read], None],
) -> None:
    """Have the block as the steps before `first` left it; where it was off meanwhile, another visit begins.

    Whether it was off the record says, the supply, or for one that a person works the person. `another_visit` is
    told the next reading of the visit that ends.
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
    """Whether the block is to be on before a step."""
    for before in reversed(plan.steps[:step]):
        if isinstance(before, Power):
            return before.switch != "off"
    return plan.begins_on()


def _next_of_a_visit(plan: Plan, first: int, progress: Progress) -> Read | None:
    """Return the next reading on the present mounting, None where nothing was read yet on that visit."""
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
