"""How an installation is told to a person: in words and drawn with characters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from bench.config.procedure.plan import Mount
from drivers.interfaces import Prompt, PromptKind

PICTURES: Final[Mapping[str, str]] = {
    "1": """\
        z up                 head at 0°, seen from the end of the shaft:
        |   y                the block's z points up, its x lies level to the
        |  /  (shaft)        right, its y lies along the shaft
        | /
        o------ x""",
    "2": """\
        y up                 head at 0°, seen from the end of the shaft:
        |   z                the block's y points up, its x lies level to the
        |  /  (shaft)        left, its z lies along the shaft
        | /
  x ----o""",
}


UNTOUCHED: Final = "untouched"


def mount_prompt(step: Mount, *, chamber: bool) -> Prompt:
    """Return the task of mounting the block, with a drawing of the installation where there is one.

    It has no default: a key hit by chance mounts nothing. `chamber` says whether there is one to be closed.
    """
    close = ", close the chamber" if chamber else ""
    again = "" if step.series == 1 else f" (visit {step.series})"
    return Prompt(
        id=step.key,
        kind=PromptKind.CONFIRM,
        text=f"Mount the block in installation {step.installation}{again}, clamp it{close}",
        action={"do": "mount", "installation": step.installation, "series": step.series},
        picture=PICTURES.get(step.installation, ""),
    )


def untouched_prompt(step: Mount) -> Prompt:
    """Return the question whether the block is still mounted as this step left it."""
    text = (
        f"The block was mounted in installation {step.installation}. Is it untouched since? "
        "If not, mount it again now, and say so"
    )
    choices = (UNTOUCHED, "mounted again")
    return replace(mount_prompt(step, chamber=False), kind=PromptKind.CHOOSE, text=text, choices=choices)
