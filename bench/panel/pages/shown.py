"""A page sent to who asked for it, with who that is."""

from __future__ import annotations

from typing import Any, Final

from starlette.requests import Request
from starlette.responses import HTMLResponse

from bench.panel import look
from bench.panel.access.acting import panel_of, person_of

APART: Final = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
}
"""Of a page that stands by itself, as a file: its own style, and nothing of it acts."""


def page(request: Request, name: str, *, status: int = 200, **content: Any) -> HTMLResponse:
    """Return the page that a template makes of its content, with `person` and `csrf` of who is signed in.

    `catalogue` says whether there are pages on units.
    """
    if (person := person_of(request)) is not None:
        shown = bool(panel_of(request).settings.catalogue)
        content = {"person": person, "csrf": person.csrf, "catalogue": shown, **content}
    return HTMLResponse(look.page(name, **content), status_code=status)
