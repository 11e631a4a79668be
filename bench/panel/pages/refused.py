"""What is said when a request is refused: a small page, or JSON to who asks for that."""

from __future__ import annotations

from http import HTTPStatus
from urllib.parse import quote

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from bench.base.extras import missing
from bench.base.visible import bounded, visible
from bench.panel.access.people import Refusal
from bench.panel.pages.shown import page


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
