"""What the theme leaves out for readers who use a keyboard or a screen reader: put into the built pages."""

from __future__ import annotations

from pathlib import Path
from typing import Final

ADDED: Final = {
    '<aside class="sidebar-drawer">': '<aside class="sidebar-drawer" aria-label="Pages">',
    '<aside class="toc-drawer">': '<aside class="toc-drawer" aria-label="On this page">',
    '<aside class="toc-drawer no-toc">': '<aside class="toc-drawer no-toc" aria-label="On this page">',
    '<p class="caption" role="heading">': '<p class="caption" role="heading" aria-level="2">',
    '<th class="head"><p></p></th>': "<td></td>",
    "<pre>": '<pre tabindex="0">',
}
"""What stands in a page, and what takes its place: names of landmarks, levels of headings, boxes to scroll."""


def finish(site: Path) -> None:
    """Put it into every page of a site; a page that has it stays as it is."""
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        finished = text
        for old, new in ADDED.items():
            finished = finished.replace(old, new)
        if finished != text:
            path.write_text(finished, encoding="utf-8")
