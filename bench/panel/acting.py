"""Who asks, and what a form or a script sends: what a page must know before it changes anything."""

from __future__ import annotations

import secrets
from typing import Final
from urllib.parse import parse_qsl

from starlette.requests import ClientDisconnect, Request

from bench.base.files import from_text
from bench.panel.access import Person, Refusal, Role
from bench.panel.connections import LOG
from bench.panel.panel import Panel

MOST_FIELDS: Final = 40
CSRF_HEADER: Final = "x-csrf"


def panel_of(request: Request) -> Panel:
    """Return the panel that a request is made to."""
    panel: Panel = request.app.state.panel
    return panel


def person_of(request: Request) -> Person | None:
    """Return who is signed in, None for a stranger."""
    panel = panel_of(request)
    return panel.access.person(request.cookies.get(panel.settings.cookie, ""))


def looking(request: Request) -> Person:
    """Return who looks. Raises `Refusal` for a stranger."""
    person = person_of(request)
    if person is None:
        raise Refusal(401, "sign in first")
    return person


async def acting(request: Request, least: Role) -> tuple[Person, dict[str, str]]:
    """Return who asks for a change, and the fields sent. Raises `Refusal` for who may not, or a foreign form."""
    person = looking(request)
    sent = await fields(request)
    given = request.headers.get(CSRF_HEADER) or sent.pop("csrf", "")
    if not secrets.compare_digest(given.encode(errors="replace"), person.csrf.encode()):
        raise Refusal(403, "this form is of another session; load the page again")
    if not person.role.includes(least):
        raise Refusal(403, f"{person.name} is signed in as {person.role}; this takes the role {least}")
    return person, sent


async def fields(request: Request) -> dict[str, str]:
    """Return the fields of a form, or of a JSON object of texts. Raises `Refusal` for anything else."""
    try:
        body = await request.body()
    except ClientDisconnect:
        LOG.warning("a request ended before its body; further ones within a minute are not written here")
        raise Refusal(400, "the request ended before its body") from None
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    try:
        if kind == "application/json":
            given = from_text(body)
        elif kind == "application/x-www-form-urlencoded" or not body:
            given = dict(parse_qsl(body.decode(), keep_blank_values=True, max_num_fields=MOST_FIELDS))
        else:
            raise Refusal(415, "a form or a JSON object is taken")
    except ValueError:
        raise Refusal(400, "what was sent is no form and no JSON that can be read") from None
    if isinstance(given, dict) and len(given) > MOST_FIELDS:
        raise Refusal(400, f"at most {MOST_FIELDS} fields are taken")
    if not isinstance(given, dict) or not all(isinstance(value, str) for value in given.values()):
        raise Refusal(400, "a JSON object whose values are texts is taken")
    return given
