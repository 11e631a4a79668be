"""Anchors of headings: those that the files have on a code host work in the site, and those of earlier editions too."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import yaml
from docutils import nodes

from docs.generators.forms import anchor

MOVED: Final = Path(__file__).parents[1] / "moved.yaml"


def moved() -> dict[str, dict[str, str]]:
    """Return by page the earlier headings, each with the heading that says it now."""
    found: dict[str, dict[str, str]] = yaml.safe_load(MOVED.read_text(encoding="utf-8"))
    return found


def add_anchors(doctree: nodes.document, page: str) -> None:
    """Give each heading of a page the anchors under which it was linked before."""
    taken = {name for section in doctree.findall(nodes.section) for name in section["ids"]}
    for section in doctree.findall(nodes.section):
        title = section[0].astext()
        earlier = [old for old, new in moved().get(page, {}).items() if new == title]
        for name in (anchor(title), *(name for old in earlier for name in (nodes.make_id(old), anchor(old)))):
            if name and name not in taken:
                section["ids"].append(name)
                taken.add(name)


def setup(app: Any) -> dict[str, bool]:
    """Add the anchors to every page that Sphinx reads."""
    app.connect("doctree-read", lambda app, doctree: add_anchors(doctree, f"{app.env.docname}.md"))
    return {"parallel_read_safe": True}
