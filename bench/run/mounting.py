"""How an installation is told to a person: in words and drawn with characters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

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


def mount_text(installation: str, series: int) -> str:
    """Return the task of mounting the block, in one sentence."""
    again = "" if series == 1 else f" (visit {series})"
    return f"Mount the block in installation {installation}{again}, clamp it, close the chamber"


def mount_picture(installation: str) -> str:
    """Return a drawing of the installation, empty where there is none."""
    return PICTURES.get(installation, "")
