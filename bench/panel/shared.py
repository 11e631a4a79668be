"""Functions for all pages: the panel, the person and the form of a request, templates, assets, refusals."""

from __future__ import annotations

import logging
import secrets
from collections import Counter
from functools import cache
from http import HTTPStatus
from importlib.resources import files
from pathlib import PurePath
from typing import Any, Final
from urllib.parse import parse_qsl, quote

from jinja2 import Environment
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from bench.base.computing import missing
from bench.base.files import from_text
from bench.base.languages import ENGLISH, LANGUAGES, language, message, texts_for_scripts
from bench.base.template_texts import environment_for
from bench.base.text import bounded, visible
from bench.panel.access import STATE, Access, Person, Refusal, Role, Settings
from bench.panel.folder import Certificates, RunsFolder, RunsTable
from bench.panel.launching import Started, Wishes
from bench.panel.queue import DayQueue
from bench.panel.stream import Followers
from bench.run.events import RecordError, sha256
from bench.services.errors import sentence


class Panel:
    """The state of a panel that serves one folder of runs."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.runs = RunsFolder(settings.runs)
        self.table = RunsTable(self.runs)
        self.wishes = Wishes(settings.runs / STATE / "wishes")
        self.diagnosing: dict[str, Started] = {}
        self.followers = Followers()
        self.certificates = Certificates(settings.laboratory)
        self.streams: Counter[str] = Counter()
        self.access = Access(settings.runs / STATE, laboratory=settings.laboratory)
        self.queue = DayQueue(settings.runs / STATE)


LOG: Final = logging.getLogger("uvicorn.error")
"""The log of the server, to which the panel adds warnings about clients."""

MOST_FIELDS: Final = 40
CSRF_HEADER: Final = "x-csrf"


def panel_of(request: Request) -> Panel:
    """Return the panel that received a request."""
    panel: Panel = request.app.state.panel
    return panel


def person_of(request: Request) -> Person | None:
    """Return the signed-in person of a request; None if nobody is signed in."""
    panel = panel_of(request)
    return panel.access.person(request.cookies.get(panel.settings.cookie, ""))


def looking(request: Request) -> Person:
    """Return the signed-in person who requests a page. Raises `Refusal` if nobody is signed in."""
    person = person_of(request)
    if person is None:
        raise Refusal(401, "nobody is signed in; sign in first")
    return person


def operator(request: Request) -> Person:
    """Return the signed-in person of a request that only operators may make. Raises `Refusal` for anybody else."""
    person = looking(request)
    person.require(Role.OPERATOR)
    return person


async def acting(request: Request, least: Role, most: int = MOST_FIELDS) -> tuple[Person, dict[str, str]]:
    """Return the person who requests a change, and the fields of the form.

    Raises `Refusal` for a person below the role `least`, a wrong CSRF token, or more than `most` fields.
    """
    person = looking(request)
    sent = await fields(request, most)
    given = request.headers.get(CSRF_HEADER) or sent.pop("csrf", "")
    if not secrets.compare_digest(given.encode(errors="replace"), person.csrf.encode()):
        raise Refusal(403, "this form belongs to another session; load the page again")
    person.require(least)
    return person, sent


async def fields(request: Request, most: int = MOST_FIELDS) -> dict[str, str]:
    """Return the fields, at most `most`, of a form or a JSON object of texts. Raises `Refusal` for other data."""
    try:
        body = await request.body()
    except ClientDisconnect:
        LOG.warning(message("a request was incomplete; further ones within a minute are not listed"))
        raise Refusal(400, "the request is incomplete; send it again") from None
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    try:
        if kind == "application/json":
            given = from_text(body)
        elif kind == "application/x-www-form-urlencoded" or not body:
            pairs = parse_qsl(body.decode(), keep_blank_values=True)
            given = dict(pairs) if len(pairs) <= most else pairs
        else:
            raise Refusal(415, "the request is neither a form nor JSON; send a form or a JSON object")
    except ValueError:
        raise Refusal(400, "the request cannot be read; send a form or valid JSON") from None
    if isinstance(given, dict | list) and len(given) > most:
        raise Refusal(
            400,
            f"the form has more than {most} fields; send fewer, or change the file in an editor",
        )
    if not isinstance(given, dict) or not all(isinstance(value, str) for value in given.values()):
        raise Refusal(
            400,
            "the request's JSON is no object of texts; send a JSON object whose values are texts",
        )
    return given


REPORT_STYLE: Final = "report.css"
"""The style sheet of the reports, which the panel's own extends."""

_STATIC: Final = files("bench.panel") / "static"
_KINDS: Final = {
    ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".svg": "image/svg+xml",
}  # fmt: skip
ASSETS: Final = {
    name: _KINDS[PurePath(name).suffix]
    for name in (
        REPORT_STYLE,
        *(f"texts-{name}.js" for name in LANGUAGES if name != ENGLISH),
        *sorted(file.name for file in _STATIC.iterdir()),
    )
}
"""The files that pages load, with their media types. Pages load nothing else."""


@cache
def read_asset(name: str) -> bytes:
    """Return the content of an asset. Raises `KeyError` for a name not in `ASSETS`."""
    if name not in ASSETS:
        raise KeyError(name)
    if name == REPORT_STYLE:
        return (files("bench.results") / "templates" / "style.css.j2").read_bytes()
    if name.startswith("texts-"):
        return texts_for_scripts(name.removeprefix("texts-").removesuffix(".js")).encode()
    return (_STATIC / name).read_bytes()


@cache
def asset(name: str) -> str:
    """Return the address of an asset, which changes with its content."""
    return f"/static/{sha256(read_asset(name))[:12]}/{name}"


@cache
def _environment(name: str = ENGLISH) -> Environment:
    environment = environment_for(name, "bench.panel")
    environment.filters["filename"] = lambda path: PurePath(str(path)).name
    environment.globals.update(asset=asset, language=name, languages=LANGUAGES)
    return environment


def load() -> None:
    """Read all assets and compile all templates, so that the first pages are fast."""
    for name in ASSETS:
        asset(name)
    for name in _environment().list_templates():
        _environment().get_template(name)


def rendered(name: str, **content: Any) -> str:
    """Return a rendered template; `content` is HTML-escaped, and its control characters are made visible."""
    return visible(_environment(language()).get_template(name).render(**content))


KEPT = {"cache-control": "public, max-age=31536000, immutable"}


async def send_asset(request: Request) -> Response:
    """Send an asset if the path is its current address, which changes with its content."""
    name = request.path_params["name"]
    if name not in ASSETS or request.scope["path"] != asset(name):
        raise Refusal(404, "no such file; load the page again")
    return Response(read_asset(name), media_type=ASSETS[name], headers=KEPT)


APART: Final = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'",
    "x-frame-options": "SAMEORIGIN",
}
"""Headers of a standalone page, such as a report: it may have its own style, but no scripts or forms."""


def page(request: Request, name: str, *, status: int = 200, **content: Any) -> HTMLResponse:
    """Return the response with a template rendered with `content`.

    If a person is signed in, the template also gets `person`, `csrf`, and `catalogue` (whether there is one).
    """
    if (person := person_of(request)) is not None:
        shown = bool(panel_of(request).settings.catalogue)
        content = {"person": person, "csrf": person.csrf, "catalogue": shown, **content}
    return HTMLResponse(rendered(name, **content), status_code=status)


def wants_json(request: Request) -> bool:
    """Return whether a script made the request: it accepts or sends JSON."""
    asked = request.headers.get("accept", "") + request.headers.get("content-type", "")
    return "application/json" in asked or "text/event-stream" in asked


TITLES: Final = {403: message("You may not do this"), 404: message("This page does not exist")}
"""Titles of refusals by status; HTTP's own phrases are no words for operators."""
SECTIONS: Final = frozenset({"/bench", "/procedures", "/queue", "/start"})
"""Pages to go back to after a refusal on a page below them."""


def _back(request: Request) -> str:
    """Return the address of the page to which a refusal links back; "" for the list of runs alone."""
    path, name = request.scope["path"], request.path_params.get("name", "")
    section = f"/{path.removeprefix('/').partition('/')[0]}"  # a request may name a path without a slash
    if section == "/runs" and person_of(request) is not None and panel_of(request).runs.holds(name):
        section = f"/runs/{quote(name)}/"
    elif section not in SECTIONS:
        return ""
    return section if request.method != "GET" or section != path else ""


def refused(request: Request, refusal: Refusal) -> Response:
    """Return the response with the reason for a refusal; redirect to the sign-in page if nobody is signed in."""
    if wants_json(request):
        return JSONResponse({"problem": visible(bounded(refusal.text))}, status_code=refusal.status)
    if refusal.status == HTTPStatus.UNAUTHORIZED and request.method == "GET":
        return RedirectResponse(
            f"/sign-in?next={quote(request.scope['path'], errors='replace')}", status_code=303
        )
    title = TITLES.get(refusal.status, message("This is not possible"))
    text = bounded(refusal.text)
    return page(
        request, "refused.html.j2", status=refusal.status, title=title, text=text, back=_back(request)
    )


def by_error(request: Request, error: Exception) -> Response:
    """Return the response to an error: refusal, unknown address or method, unusable file, missing package."""
    match error:
        case Refusal():
            return refused(request, error)
        case HTTPException(status_code=status):
            texts = {404: message("no such page"), 405: message("this page does not accept that request")}
            return refused(request, Refusal(status, texts.get(status, HTTPStatus(status).phrase)))
        case OSError():
            told = f"{error.filename or 'a file'}: {error.strerror or error}"
            return refused(request, Refusal(409, told))
        case ImportError():
            if not (told := missing(error)):
                raise error
            return refused(request, Refusal(409, told))
    name = request.path_params.get("name", "")
    if isinstance(error, RecordError) and name and person_of(request) and not wants_json(request):
        found = panel_of(request).runs.run(name)
        told = str(error).replace(f"{found.folder.absolute()}/", "").replace(f"{found.folder}/", "")
        return page(request, "damaged.html.j2", status=409, run=name, text=bounded(told))
    return refused(request, Refusal(409, sentence(error)))
