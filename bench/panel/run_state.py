"""The snapshot of a run for pages and scripts: its state and the open question, as JSON objects."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.numbers import fixed, places, quantity
from bench.base.text import APPROACH
from bench.base.text import duration as exact_duration
from bench.config.procedure.plan import Mount, Read, Settle, Step, Turn, Wait
from bench.config.procedure.steps import precision_in_words
from bench.model.geometry import Installation
from bench.panel.mounting_drawing import mounting, turn
from bench.panel.run_events import RunView
from bench.readings.table import Reading
from bench.run.events import ENDED, Event, RunState, Wish
from bench.run.person import REASON, AskedPrompt
from bench.run.resume import redo_from
from bench.run.samples import OUTLIER_LEAST
from bench.run.sentences import duration, in_words
from bench.run.terminal import TimeLeft
from drivers.angles import format_dms
from drivers.person import PromptKind


def prompt_of(asked: AskedPrompt, seen: RunView, installations: Mapping[str, Installation]) -> dict[str, Any]:
    """Return a question as a JSON object for pages and scripts.

    `id`, `kind`, `text`, `default`, `unit`, `choices`, `minimum`, `maximum` and `picture` are those of the
    `Prompt`; `time` is when the question was asked; `do` is the operator's task. For a turn, `target` is the
    angle in ° ′ ″ and `direction` +1 or -1. `drawing` is an SVG or empty. `buttons` are the possible answers,
    each with its `text` and its `label`; if `enter` is true, the Enter key presses the first button.
    """
    prompt = asked.prompt
    action: Mapping[str, Any] = prompt.action  # from a record, so not validated
    told: dict[str, Any] = {
        "id": prompt.id,
        "kind": prompt.kind.value,
        "text": prompt.text,
        "default": prompt.default,
        "unit": prompt.unit,
        "choices": list(prompt.choices),
        "minimum": prompt.minimum,
        "maximum": prompt.maximum,
        "picture": prompt.picture,
        "time": asked.event.time,
        "do": str(action.get("do", "answer")),
        "target": None,
        "direction": None,
        "drawing": "",
        "enter": prompt.default is not None,
    }
    match told["do"]:
        case "turn":
            target_rad, direction = float(action["target_rad"]), int(action["direction"])
            told |= {"target": format_dms(target_rad % math.tau), "direction": direction}
            at_rad = None if seen.turned is None else math.radians(seen.turned[1].angle_deg)
            mounted = None if seen.mounted is None else installations.get(seen.mounted.installation)
            told["drawing"] = turn(mounted, at_rad, target_rad, direction)
        case "mount" if (installation := installations.get(str(action.get("installation")))) is not None:
            told["drawing"] = mounting(installation)
        case "wait":
            told["text"] = message(
                "Paused: nothing on the bench moves. Continue here, or redo a point first."
            )
    told["buttons"] = _buttons(told)
    return told


def _buttons(told: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the buttons of a question; if it has a default, the first button gives "" as answer, like Enter."""
    default = told["default"]
    buttons = [] if default is None else [{"text": "", "label": _label(told, str(default))}]
    match told["kind"]:
        case PromptKind.CONFIRM if told["do"] != "wait":
            pressed = [("yes", message("Yes, it is done")), ("no", message("No, not yet"))]
            if told["do"] in {"answer", "ask", "confirm_reading"}:
                pressed = [("yes", "Yes"), ("no", "No")]
            return buttons + [{"text": text, "label": label} for text, label in pressed if text != default]
        case PromptKind.CHOOSE:
            return buttons + [_choice(one) for one in told["choices"] if one != default]
    return buttons


def _choice(choice: str) -> dict[str, str]:
    """Return the button of a choice; for a choice with a reason in free text, `begin` begins the answer."""
    if choice.endswith(f" {REASON}"):
        beginning = choice.removesuffix(REASON)
        known = message("go on because …")
        return {"begin": beginning, "label": known if beginning == "go on " else f"{beginning}…"}
    return {"text": choice, "label": choice}


def _label(told: Mapping[str, Any], default: str) -> str:
    match told["do"]:
        case "turn" if told["kind"] != PromptKind.CONFIRM:
            return message(f"It stands at {default}")
        case "wait":
            return "Continue"
        case "select_input":
            return "Done"
    return default.capitalize() if told["kind"] == PromptKind.CONFIRM else default


LOG_LINES: Final = 14
_SENTENCE: Final = re.compile(r";\s+|(?<=[a-z)0-9])\.\s+(?=[A-Z])")
DRIFTS: Final = 0.01
"""Significance level: a drift with a smaller p-value is reported."""


@dataclass(frozen=True)
class About:
    """A run's constant data: first members of snapshots (`told`), installations, whether it has a chamber."""

    told: Mapping[str, Any]
    installations: Mapping[str, Installation]
    chamber: bool


def snapshot(
    seen: RunView,
    about: About,
    time_left: TimeLeft,
    asked: AskedPrompt | None,
    *,
    alive: bool,
    now: datetime,
    disk_full: bool = False,
) -> dict[str, Any]:
    """Return the snapshot of a run as a JSON object; `alive` says whether a program carries it out.

    `asked` is the open question. If `disk_full`, the alarm names the full disk as the cause.
    """
    latest = seen.latest
    return {
        **about.told,
        "operator": seen.progress.operators(about.told["operator"]),
        "events": seen.events,
        "last_time": None if latest is None else latest.time,
        "now": now.isoformat(),
        "bench_s": None if latest is None else latest.bench_s,
        "state": seen.state.value,
        "alive": alive,
        "ended": seen.state in ENDED,
        "why": seen.why,
        "to_do": [f"{name}: {what}" for name, what in seen.left_safe.items()],
        "doing": _doing(seen, alive=alive),
        "prompt": None if asked is None else prompt_of(asked, seen, about.installations),
        "refused": None if seen.refused is None else _answer(seen.refused),
        "unmet": "" if seen.unmet is None else in_words(seen.unmet, seen.plan),
        "answered": None if seen.answered is None else _answer(seen.answered),
        "where": _where(seen, time_left),
        "angle": _angle(seen),
        "reading": _reading(seen),
        "chamber": _chamber(seen) if about.chamber else None,
        "soak": _soak(seen, about),
        "warnings": [_warning(event) for event in reversed(seen.warnings)],
        "alarm": alarm_of(seen, asked, alive=alive, disk_full=disk_full),
        "redo": _redo_point(seen),
        "doubt": seen.progress.doubt is not None,
        "log": [_line(event, seen) for event in list(seen.last)[: -LOG_LINES - 1 : -1]],
    }


def _doing(seen: RunView, *, alive: bool) -> str:
    match seen.state:
        case RunState.FINISHED | RunState.ABORTED:
            return message(f"The run is {seen.state}.")
        case RunState.FAILED:
            return message("The run failed. It can be resumed.")
        case RunState.INTERRUPTED if seen.stopped_by:
            return message(f"{seen.stopped_by} stopped the run. It can be resumed.")
        case RunState.INTERRUPTED:
            return message("The run was interrupted. It can be resumed.")
        case _ if not alive:
            return message("The program of this run ended unexpectedly. The run can be resumed.")
        case RunState.PAUSED:
            return message("Paused: nothing on the bench moves.")
        case RunState.READY:
            return message("The instruments are being opened.")
    if seen.step is None:
        return message("Between two steps.")
    text = seen.plan.steps[seen.step.step].describe()
    return text[:1].upper() + text[1:]


def alarm_of(
    seen: RunView, asked: AskedPrompt | None, *, alive: bool, disk_full: bool = False
) -> dict[str, str] | None:
    """Return the alarm of a run: `cause` in one line, `action` to take, `details`; None if there is no alarm.

    `do` is "resume" if the action is to resume the run, else empty. A confident early warning is an alarm
    only while a question is open and no reading has followed the warning.
    """
    if seen.state is RunState.ABORTED or seen.state is RunState.FINISHED:
        return None
    if seen.state is RunState.FAILED or (seen.state is RunState.INTERRUPTED and seen.why):
        cause, details = _first_sentence(seen.why or message("The run failed."))
        return _alarm(cause, message("Remove the cause, then resume the run."), details, "resume")
    if not alive and seen.state in {RunState.RUNNING, RunState.PAUSED, RunState.READY}:
        cause = message("The program of this run ended unexpectedly.")
        action = message("Resume the run: no reading is lost.")
        if disk_full:
            cause = message("The program of this run ended: the disk is full.")
            action = message("Free disk space, then resume the run: no reading is lost.")
        return _alarm(cause, action, "", "resume")
    warning = seen.warnings[-1] if seen.warnings else None
    if warning is None or asked is None or not warning.data.get("confident"):
        return None
    if seen.taken is not None and seen.taken[0].number > warning.number:
        return None
    told = _warning(warning)
    cause, details = _first_sentence(told["words"])
    causes = told["causes"]
    action = message("Check the mounting and the wiring, then answer.")
    if len(causes) == 1:
        action = message(f"Probable cause: {causes[0]}. Correct it, then answer.")
    elif causes:
        action = message(f"Find which of these it is, correct it, then answer: {'; '.join(causes)}.")
    return _alarm(cause, action, f"{details}." if details else "", "")


def _alarm(cause: str, action: str, details: str, do: str) -> dict[str, str]:
    return {"cause": cause, "action": action, "details": details, "do": do}


def _first_sentence(text: str) -> tuple[str, str]:
    """Return a text in two parts: up to the first semicolon or end of a sentence, and the rest."""
    found = _SENTENCE.search(text)
    return (text, "") if found is None else (text[: found.start()] + ".", text[found.end() :])


def _redo_point(seen: RunView) -> str:
    """Return the point that the wish "redo" would repeat, with its angle; "" if no point was measured yet."""
    index = _next_step(seen) if seen.step is None else seen.step.step
    try:
        found = redo_from(seen.plan, seen.progress, Wish.REPEAT_POINT, index)
    except (LookupError, ValueError):  # nothing is turned yet
        return ""
    if found is None:
        return ""
    steps = seen.plan.steps[found.first :]
    turn = next((step for step in steps if isinstance(step, Turn)), None)
    read = next((step for step in steps if isinstance(step, Read)), None)
    if turn is None or read is None:
        return ""
    return message(f"point {read.point}, {format_dms(turn.target_rad)}, pass {read.pass_number}")


def _where(seen: RunView, time_left: TimeLeft) -> dict[str, Any]:
    step = _step_at(seen)
    left_s = None
    if seen.state not in ENDED and seen.latest is not None:
        left_s = time_left.at(_next_step(seen) if seen.step is None else seen.step.step)
    return {
        "installation": getattr(step, "installation", None) or getattr(seen.mounted, "installation", None),
        "series": getattr(step, "series", None) or getattr(seen.mounted, "series", None),
        "pass": getattr(step, "pass_number", None),
        "point": getattr(step, "point", None),
        "reading": seen.readings_done,
        "readings": seen.readings_planned,
        "step": None if seen.step is None else seen.step.step + 1,
        "steps": len(seen.plan.steps),
        "done": len(seen.progress.done | seen.progress.skipped | seen.progress.left_out),
        "left_s": left_s,
        "left": None if left_s is None else duration(left_s),
    }


def _next_step(seen: RunView) -> int:
    """Return the index of the first step neither done nor left out; the number of steps if there is none."""
    over = seen.progress.done | seen.progress.skipped | seen.progress.left_out
    return next((i for i in range(len(seen.plan.steps)) if i not in over), len(seen.plan.steps))


def _step_at(seen: RunView) -> Step | None:
    """Return the step whose position in the plan is shown: the present or next mount, turn or reading."""
    if seen.step is None:
        return None
    for step in seen.plan.steps[seen.step.step :]:
        if isinstance(step, Mount | Turn | Read):
            return step
    return None


def _angle(seen: RunView) -> dict[str, Any] | None:
    if seen.turn is None:
        return None
    step = seen.plan.steps[seen.turn.step]
    if not isinstance(step, Turn):
        return None
    target_deg = math.degrees(step.target_rad)
    told: dict[str, Any] = {
        "commanded": format_dms(step.target_rad),
        "commanded_deg": round(target_deg, 6),
        "direction": APPROACH[step.direction],
        "read": None,
        "read_deg": None,
        "off": None,
    }
    if seen.turned is not None and seen.turned[0].number > seen.turn.number:
        read_deg = seen.turned[1].angle_deg
        off_rad = math.remainder(math.radians(read_deg - target_deg), math.tau)
        off = format_dms(abs(off_rad), 1)
        falls = off_rad < 0 and off != format_dms(0.0, 1)
        told |= {
            "read": format_dms(math.radians(read_deg), 1),
            "read_deg": read_deg,
            "off": f"{'−' if falls else '+'}{off}",
        }
    return told


def _reading(seen: RunView) -> dict[str, Any] | None:
    if seen.taken is None:
        return None
    event, reading = seen.taken
    return {
        "n": event.number,
        "time": event.time,
        "words": f"{reading}"
        + ("" if reading.angle_deg is None else f" at {format_dms(math.radians(reading.angle_deg))}"),
        "samples": reading.samples_taken,
        "channels": [_channel(reading, i) for i in range(len(CHANNELS))],
        "rest": _rest(seen),
    }


def _channel(reading: Reading, i: int) -> dict[str, Any]:
    sd, unit = reading.sd[i], reading.unit
    drift, p, outlier = reading.drift[i], reading.drift_p[i], reading.outlier[i]
    if reading.samples_taken < OUTLIER_LEAST:  # earlier versions recorded outliers among only three samples
        outlier = None
    steady = None if p is None else p >= DRIFTS
    drifted = ""
    if drift is not None and p is not None:
        size = f"{'+' if drift >= 0 else '−'}{quantity(abs(drift), unit)}"
        drifted = message(f"{'steady' if steady else 'drifts'} ({size}, p = {p:.2g})")
    return {
        "channel": CHANNELS[i],
        "value": f"{fixed(reading.mean[i], min(places(sd), 7) if sd else 6, sign=True)} {unit}",
        "scatter": "–" if sd is None else quantity(sd, unit),
        "drift": drifted or "–",
        "steady": steady,
        "outlier": ""
        if outlier is None
        else message(f"sample {outlier.sample} lies {outlier.sigma:.1f} σ from the mean"),
    }


def _rest(seen: RunView) -> str:
    """Return a sentence on how long the last settling took; "" if nothing has settled yet."""
    if seen.rest is None:
        return ""
    step, rest = seen.rest
    return message(f"{step.what} settled after {duration(rest.settled_s)}, within {precision_in_words(step)}")


def _chamber(seen: RunView) -> dict[str, Any]:
    known = seen.chamber
    window = None
    if (
        (waiting := seen.waiting) is not None
        and isinstance(waiting[1], Settle)
        and waiting[1].what == "temperature"
    ):
        settle = waiting[1]
        window = message(f"within {precision_in_words(settle)} for {exact_duration(settle.window_s)}")
    return {
        "set_c": seen.set_c,
        "actual_c": None if known is None else round(known[1], 3),
        "actual_time": None if known is None else known[0].time,
        "window": window,
    }


def _soak(seen: RunView, about: About) -> dict[str, Any] | None:
    """Return the countdown to the end of the current wait or timeout of settling; None if there is none."""
    if (waiting := seen.waiting) is None or seen.latest is None:
        return None
    event, step = waiting
    if isinstance(step, Wait):
        words, lasts_s = step.reason, step.duration_s
    else:
        words, lasts_s = message(f"until the {step.what} settle, at most"), step.timeout_s
    left_s = max(0.0, lasts_s - (seen.latest.bench_s - event.bench_s))
    until = None
    if not about.told["simulated"]:
        until = (datetime.fromisoformat(event.time) + timedelta(seconds=lasts_s)).isoformat()
    return {"words": words, "lasts_s": lasts_s, "lasts": duration(lasts_s), "left_s": left_s, "until": until}


def _warning(event: Event) -> dict[str, Any]:
    data = event.data
    return {
        "n": event.number,
        "step": data.get("step"),
        "words": str(data["sentence"]),
        "causes": [str(cause) for cause in data.get("causes", ())],
        "channels": [str(channel) for channel in data.get("channels", ())],
        "stops": bool(data.get("confident")),
    }


def _answer(event: Event) -> dict[str, Any]:
    members = {"id": "id", "answer": "answer", "by": "by", "place": "where", "why": "why"}
    return {name: str(event.data.get(member, "")) for name, member in members.items()}


def _line(event: Event, seen: RunView) -> dict[str, Any]:
    by = " ".join(str(event.data[name]) for name in ("by", "role", "where") if event.data.get(name))
    try:
        words = in_words(event, seen.plan).replace(event.type, event.type.replace("_", " "), 1)
    except (KeyError, IndexError, TypeError):
        words = event.type.replace("_", " ")
    return {
        "n": event.number,
        "time": event.time,
        "words": words,
        "by": "" if event.data.get("by") and str(event.data["by"]) in words else by,
        "kind": event.type,
    }
