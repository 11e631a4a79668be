"""Signing in by a token or a one-time link, and signing out."""

from __future__ import annotations

import re
from typing import Final
from urllib.parse import quote, urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.languages import known_language, message
from bench.panel.access import LANGUAGE, LONGEST_SESSION, Refusal, Role
from bench.panel.shared import acting, fields, page, panel_of

_HERE: Final = re.compile(r"/(?:[^/\\\s][^\\]*)?")


def sign_in(request: Request) -> Response:
    """Show the sign-in form; opening it, even with a link, signs nobody in."""
    asked = request.query_params
    return _form(request, asked.get("next", "/"), link=asked.get("link", ""))


async def signed_in(request: Request) -> Response:
    """Sign in a person with a valid token or link: set the session's cookie and redirect to the next page."""
    sent = await fields(request)
    panel = panel_of(request)
    link, token = sent.get("link", ""), sent.get("token", "")
    if link and not panel.settings.loopback:
        raise Refusal(403, "sign-in links work on the bench's computer only; sign in with a token")
    sign_in_by = panel.access.sign_in_by_link if link else panel.access.sign_in_by_token
    person = await run_in_threadpool(sign_in_by, link or token)
    if person is None:
        wrong = message(
            "this link was used or has expired; 'bench panel link' makes another"
            if link
            else "unknown token; 'bench panel token NAME' makes one"
        )
        return _form(request, sent.get("next", "/"), wrong=wrong, status=403)
    response = RedirectResponse(_here(sent.get("next", "/")), status_code=303)
    response.set_cookie(
        panel.settings.cookie,
        person.secret,
        max_age=int(LONGEST_SESSION.total_seconds()),
        httponly=True,
        samesite="strict",
        secure=panel.settings.address.startswith("https:"),
    )
    return response


async def sign_out(request: Request) -> Response:
    """End the session."""
    person, _ = await acting(request, Role.VIEWER)
    panel = panel_of(request)
    await run_in_threadpool(panel.access.sign_out, person.secret)
    response = RedirectResponse("/sign-in", status_code=303)
    response.delete_cookie(panel.settings.cookie)
    return response


def choose_language(request: Request) -> Response:
    """Store the chosen language in a cookie, and show the page again on which it was chosen."""
    response = RedirectResponse(
        _here(urlsplit(request.headers.get("referer", "/")).path or "/"), status_code=303
    )
    if name := known_language(request.path_params["name"]):
        response.set_cookie(LANGUAGE, name, max_age=int(LONGEST_SESSION.total_seconds()), samesite="lax")
    return response


def _form(request: Request, after: str, *, link: str = "", wrong: str = "", status: int = 200) -> Response:
    return page(
        request,
        "sign_in.html.j2",
        status=status,
        next=after if _HERE.fullmatch(after) else "/",
        link=link[:200],
        wrong=wrong,
    )


def _here(path: str) -> str:
    """Return `path` if it is on this panel, else "/", so that no link redirects to another site."""
    return quote(path, errors="replace") if _HERE.fullmatch(path) else "/"
