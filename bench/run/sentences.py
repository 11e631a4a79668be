"""Events of a run as sentences, for the terminal and the plain-text log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from bench.base.languages import message
from bench.base.numbers import figures, scale_for
from bench.base.text import visible
from bench.config.procedure.plan import Plan
from bench.readings.table import Reading
from bench.run.events import Answered, Event, EventType, Turned

TERMINAL: Final = "terminal"
"""The place stated in the events of a person at the run's own terminal."""


def sentence(event: Event) -> str:
    """Return a sentence for an event that the operator should notice; for any other event, its type."""
    data = event.data
    match event.type:
        case EventType.EARLY_SIGN:
            return message(f"{'stopped' if data.get('confident') else 'note'}: {data['sentence']}")
        case EventType.WENT_ON:
            if not data["causes"]:
                return message(f"continued in spite of a misfit without a known cause: {data['reason']}")
            return message(f"continued in spite of '{'; '.join(data['causes'])}': {data['reason']}")
        case EventType.SAME_SERIAL | EventType.CERTIFICATE:
            return message(f"note: {data['words']}")
        case EventType.STEP_FAILED:
            return message(f"failed, tried again: {data['error']}")
        case EventType.CLOCK_JUMPED:
            ahead_s = data["ahead_s"]
            way = "ahead" if ahead_s > 0 else "back"
            return message(
                f"note: the computer's clock went {duration(abs(ahead_s))} {way}: it slept, or its time "
                "was set; redo the last point if drift matters"
            )
        case EventType.CHAMBER_SLOW:
            return message(
                f"note: the {data['chamber']} has gone from {data['start_c']:.1f} °C to {data['air_c']:.1f} °C in "
                f"{duration(data['after_s'])}, sent to {data['target_c']:g} °C: check that it conditions "
                "and is closed"
            )
        case EventType.POWER:
            return _power_in_words(data)
        case EventType.WARMED_UP if data.get("after_s") is not None:
            return message(f"the block is warm, {duration(data['after_s'])} after it was switched on")
        case EventType.REMOUNTED if data.get("why") == "power":
            return message(
                f"the block lost power: its further readings in installation {data['installation']} count "
                f"as another visit, series {data['now_series']}"
            )
        case EventType.CHOSEN:
            return chosen_in_words(data)
        case EventType.LEFT_SAFE:
            tasks = (message(f"still to do: {name}: {what}") for name, what in data["to_do"].items())
            return "\n".join(tasks)
    return _of_somebody(event) or event.type


def said(event: Event) -> str:
    """Return a sentence on a recorded answer: the answer, its author and place."""
    by, who = _by(event.data), event.data.get("by")
    if event.type == EventType.ANSWERED:
        answer = event.data["answer"]
        return message(f"{who} answered: {answer}") if who and not by else message(f"answered{by}: {answer}")
    return message(f"an answer{by} is not accepted: {event.data['why']}")


def _of_somebody(event: Event) -> str:
    """Return a sentence on an answer or wish from elsewhere than the terminal; empty for any other event."""
    data, by = event.data, _by(event.data)
    match event.type:
        case EventType.WISH_REFUSED:
            return message(f"{data['wish']}{by} is not possible: {data['why']}")
        case EventType.ANSWERED | EventType.ANSWER_REFUSED if by:
            return said(event)
        case EventType.RUN_PAUSED | EventType.RUN_CONTINUED | EventType.REDO if by:
            return f"{_DONE[event.type]}{by}"
        case EventType.RUN_INTERRUPTED if by:
            return message(f"stopped{by}")
    return ""


_DONE: Final[Mapping[str, str]] = {
    EventType.RUN_PAUSED: "paused",
    EventType.RUN_CONTINUED: "continued",
    EventType.REDO: "repeated",
}


def _by(data: Mapping[str, Any]) -> str:
    """Return a phrase on the author and place of an answer or wish; empty if unknown or at this terminal."""
    where = data.get("where", "")
    if where in ("", TERMINAL):
        return ""
    if where == "instrument":
        return message(f" by the {data.get('by')}")
    by = data.get("by")
    if where == "command":
        return message(f" by command by {by}") if by else message(" by command")
    return message(f" in the {where} by {by}") if by else message(f" in the {where}")


def _power_in_words(data: Mapping[str, Any]) -> str:
    rails = ", ".join(
        f"{name} {rail['voltage_v']:.5g} V, {rail['current_a']:.3g} A"
        for name, rail in data.get("rails", {}).items()
    )
    match data["power"]:
        case "on":
            return message(f"the block is switched on: {rails}")
        case "found on":
            return f"the block was found on with the stated settings: {rails}"
        case "off":
            return message("the block is switched off")
        case _:
            return message(f"stopped: {'; '.join(map(str, data.get('wrong', ())))}")


def duration(seconds: float) -> str:
    """Return a rounded duration: 7500 -> "2 h 05 min", 180 -> "3 min", 40 -> "40 s"."""
    if not math.isfinite(seconds):
        return message("without end")
    if seconds >= 3600:
        minutes = round(seconds / 60)
        return f"{minutes // 60} h {minutes % 60:02d} min"
    if seconds >= 90:
        return f"{round(seconds / 60)} min"
    return f"{round(seconds)} s"


_STOPS: Final[Mapping[str, str]] = {
    "reached": message("enough"),
    "used up": message("not reached; no setting is left to measure"),
    "time": message("the time is up"),
}


def chosen_in_words(data: Mapping[str, Any]) -> str:
    """Return a choice of points in words: present state of the goal and next points, or why measuring ends."""
    so_far = message(f"{data['settings']} settings, {data['repeats']} repeats")
    now = _goal_in_words(data.get("now"))
    if data["stop"]:
        why = _STOPS.get(data["stop"], data["stop"])
        words = f"{why}: {now or 'the coefficients are not yet determined'}; {so_far}"
        needless = data.get("not_needed", 0)
        return message(f"{words}; {needless} are not needed") if needless else words
    coming, in_all = data["next"], data["in_all"]
    place = coming["installation"] + ("" if coming["series"] == 1 else f"/{coming['series']}")
    count = len(coming["points"])
    words = message(
        f"next: {count} point{'' if count == 1 else 's'} in installation {place}, {duration(coming['takes_s'])}"
    )
    if coming.get("tells_apart"):
        words += message(", to separate possible causes of the misfit")
    if (then := coming.get("then")) is not None:
        size, gained = size_in_words(then["u"], then["unit"]), _per_minute(data.get("now"), coming)
        words += ", " + (
            message(f"for {size}") if gained is None else message(f"for {size} ({gained} a minute)")
        )
    further = in_all["settings"] - count
    more = message(f"then about {further} more") if further > 0 else ""
    left = message(f"{duration(in_all['takes_s'])} to the end")
    return "; ".join(filter(None, (now, so_far if data["settings"] else "", words, more, left)))


def _goal_in_words(reached: Mapping[str, Any] | None) -> str:
    """Return the state of a goal, such as "u of Kxy is 61 µV/g, goal 50 µV/g"; empty for None."""
    if reached is None:
        return ""
    size, asked = size_in_words(reached["u"], reached["unit"]), reached.get("asked")
    if not asked:
        return message(f"{reached['goal']} is {size}")
    return message(f"{reached['goal']} is {size}, goal {size_in_words(asked, reached['unit'])}")


def size_in_words(u: float, unit: str) -> str:
    """Return the uncertainty `u` with an SI prefix: 49.8e-6, "V/g" -> "49.8 µV/g"."""
    base, slash, per = unit.partition("/")
    scale = scale_for(u, base)
    return f"{figures(u / scale.size)} {scale.unit}{slash}{per}"


def _per_minute(now: Mapping[str, Any] | None, coming: Mapping[str, Any]) -> str | None:
    """Return, as text, the expected decrease of u per minute from the state `now` over the `coming` points.

    Return None if no decrease is expected, or if another goal will then be furthest from being reached.
    """
    then, takes_s = coming["then"], float(coming["takes_s"])
    if now is None or now["goal"] != then["goal"] or takes_s <= 0 or now["u"] <= then["u"]:
        return None
    return size_in_words((now["u"] - then["u"]) / (takes_s / 60.0), now["unit"])


LOG = "run.log"


class RunLog:
    """An observer of a run that appends one line per event to `run.log`.

    The log is derived from the record, so a full disk stops the log but not the run.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self._plan = plan
        self._path = folder / LOG

    def __call__(self, event: Event) -> None:
        """Append a line for the event; starts of steps are omitted, because their ends imply them."""
        if event.type == EventType.STEP_STARTED:
            return
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(
                    visible(
                        f"{event.time[:19]}  {duration(event.bench_s):>11}  {in_words(event, self._plan)}\n"
                    )
                )
        except OSError:
            return


def in_words(event: Event, plan: Plan) -> str:
    """Return the log text for an event; `plan` is the run's plan."""
    if event.type == EventType.STEP_STARTED:
        return message(f"begun: {plan.steps[event.step].describe()}")
    if event.type == EventType.ASKED:
        return message(f"asked: {event.data['text']}")
    if event.type in (EventType.ANSWERED, EventType.ANSWER_REFUSED):
        return said(event)
    if event.type != EventType.STEP_DONE:
        why = event.data.get("error") or event.data.get("reason")
        return f"{event.type}: {why}" if why else sentence(event).replace("\n", "; ")
    text = plan.steps[event.step].describe()
    match event.result:
        case Reading(mean=mean, unit=unit):
            text += "  " + "  ".join(f"{value:+.8f}" for value in mean) + f" {unit}"
        case Turned(angle_deg=angle):
            text += "  " + message(f"read {angle:.6f}°")
        case Answered(answer=answer):
            text += f"  {answer}"
    return text
