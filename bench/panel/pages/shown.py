"""Pages sent to a person, and what is said when a request is refused."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any, Final
from urllib.parse import quote

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from bench.base.computing import missing
from bench.base.text import bounded, visible
from bench.panel import look
from bench.panel.access import Refusal
from bench.panel.acting import panel_of, person_of

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


def wants_json(request: Request) -> bool:
    """Whether a script asks: it says so, or sends JSON."""
    asked = request.headers.get("accept", "") + request.headers.get("content-type", "")
    return "application/json" in asked or "text/event-stream" in asked


def refused(request: Request, refusal: Refusal) -> Response:
    """Answer with why a request is refused; who only has to sign in is led there."""
    if wants_json(request):
        return JSONResponse({"problem": visible(bounded(refusal.text))}, status_code=refusal.status)
    if refusal.status == HTTPStatus.UNAUTHORIZED and request.method == "GET":
        return RedirectResponse(
            f"/sign-in?next={quote(request.scope['path'], errors='replace')}", status_code=303
        )
    title = HTTPStatus(refusal.status).phrase
    return page(request, "refused.html.j2", status=refusal.status, title=title, text=bounded(refusal.text))


def by_framework(request: Request, error: Exception) -> Response:
    """Answer for what the framework refuses: an address or a method that there is not."""
    status = error.status_code if isinstance(error, HTTPException) else 500
    texts = {404: "there is no such page", 405: "this cannot be asked of this page"}
    return refused(request, Refusal(status, texts.get(status, HTTPStatus(status).phrase)))


def by_refusal(request: Request, error: Exception) -> Response:
    """Answer for a refusal of ours."""
    return refused(request, error if isinstance(error, Refusal) else Refusal(400, str(error)))


def by_record(request: Request, error: Exception) -> Response:
    """Answer for a record or a file that cannot be read or written, or a package that is not installed."""
    if isinstance(error, OSError):
        return refused(request, Refusal(409, f"{error.filename or 'a file'}: {error.strerror or error}"))
    if isinstance(error, ImportError):
        if not (told := missing(error)):
            raise error
        return refused(request, Refusal(409, told))
    return refused(request, Refusal(409, str(error)))
