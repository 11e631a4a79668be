"""The question that waits, as a page shows it: what is wanted, the drawing, and what the big button does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bench.model import Installation
from bench.panel.drawing.mounting import mounting, turn
from bench.run.answers import REASON, AskedPrompt
from drivers.angles import format_dms
from drivers.interfaces import PromptKind

if TYPE_CHECKING:
    from bench.panel.following.seen import Seen


def prompt_of(asked: AskedPrompt, seen: Seen, installations: Mapping[str, Installation]) -> dict[str, Any]:
    """Return a question.

    `id`, `kind`, `text`, `default`, `unit`, `choices`, `minimum`, `maximum`, `picture` as it was put; `do`,
    what is to be done; `target`, the angle in ° ′ ″ of a turn, `direction` +1 or -1; `drawing`, an SVG,
    empty where there is none; `buttons`: what can be answered by pressing one (`text` is the answer, `label`
    what stands on it), the first is what Enter does where `enter` says so.
    """
    prompt = asked.prompt
    action: Mapping[str, Any] = prompt.action  # of a record, which may say anything
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
    told["buttons"] = _buttons(told)
    return told


def _buttons(told: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the answers that a press gives; an empty one is the default, as by Enter."""
    default = told["default"]
    buttons = [] if default is None else [{"text": "", "label": _label(told, str(default))}]
    match told["kind"]:
        case PromptKind.CONFIRM:
            pressed = [("yes", "Yes, it is done"), ("no", "No, not yet")]
            if told["do"] in {"answer", "ask"}:
                pressed = [("yes", "Yes"), ("no", "No")]
            return buttons + [{"text": text, "label": label} for text, label in pressed if text != default]
        case PromptKind.CHOOSE:
            return buttons + [_choice(one) for one in told["choices"] if one != default]
    return buttons


def _choice(choice: str) -> dict[str, str]:
    """Return the button of a choice; of one that wants words of one's own the beginning of the answer, `begin`."""
    if choice.endswith(f" {REASON}"):
        beginning = choice.removesuffix(REASON)
        return {"begin": beginning, "label": f"{beginning.strip()} because …"}
    return {"text": choice, "label": choice}


def _label(told: Mapping[str, Any], default: str) -> str:
    match told["do"]:
        case "turn":
            return f"It stands at {default}"
        case "wait":
            return "Go on"
        case "select_input":
            return "Done"
    return default.capitalize() if told["kind"] == PromptKind.CONFIRM else default
