"""The page of a commissioning: one HTML file that needs nothing but itself, from the result as JSON has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from bench.results.template import page

VERDICTS: Final = {
    0: ("passed", "✓ All that was tried works as expected"),
    1: ("none", "Something is slower or other than expected"),
    2: ("failed", "✗ Something could not be done"),
}
"""By exit status: how the page looks, and what it says."""


def render_commissioning(result: Mapping[str, Any]) -> str:
    """Return the page; the same result gives the same text."""
    findings = result["findings"]
    look, word = VERDICTS[result["status"]]
    return page(
        "commissioning.html.j2",
        result=result,
        look=look,
        word=word,
        troubles=[one for one in findings if one["state"] not in ("works", "skipped")],
        skipped=[one for one in findings if one["state"] == "skipped"],
        rows=[(one, [_shown(figure) for figure in one["figures"]]) for one in findings],
    )


def _shown(figure: Mapping[str, Any]) -> str:
    held = f" ({figure['expected']})" if figure["expected"] else ""
    return f"{figure['what']} {figure['value']:.4g} {figure['unit']}{held}"
