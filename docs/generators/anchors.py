"""Anchors of headings: those of the files on a code host work in the site too, and those of earlier editions."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Final

import yaml

from docs.generators.forms import anchor

MOVED: Final = Path(__file__).parents[1] / "moved.yaml"


@cache
def moved() -> dict[str, dict[str, str]]:
    """Return by page the earlier headings, each with the heading that says it now."""
    found: dict[str, dict[str, str]] = yaml.safe_load(MOVED.read_text(encoding="utf-8"))
    return found


def earlier_anchors(page: str, title: str) -> list[str]:
    """Return the anchors, beside the site's own, under which a heading of a page may have been linked."""
    earlier = [old for old, new in moved().get(page, {}).items() if new == title]
    names = [anchor(title), *(name for old in earlier for name in (of_site(old), anchor(old)))]
    return [name for name in names if name]


def of_site(heading: str) -> str:
    """Return the anchor of a heading as Sphinx makes it: letters and digits of ASCII, beginning with a letter."""
    return re.sub(r"^[^a-z]+|-+$", "", re.sub(r"[^a-z0-9]+", "-", heading.lower()))
