"""What every request must have, before any page sees it; and what every reply says to the browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bench.panel.access.people import Refusal
from bench.panel.settings import Settings

LARGEST_BODY: Final = 65_536
METHODS: Final = frozenset({"GET", "HEAD", "POST"})
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "font-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",  # with none at all a browser tells the origin of a form as "null"
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Gate:
    """Refuses what no browser of a person at this panel sends; counts what a body brings as it comes."""

    def __init__(
        self, app: ASGIApp, settings: Settings, refuse: Callable[[Request, Refusal], Response]
    ) -> None:
        self._app, self._settings, self._refuse = app, settings, refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer with why it is refused."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if (refusal := self._refused(scope)) is not None:
            await self._refuse(Request(scope), refusal)(scope, receive, with_headers)
            return
        taken = counted(receive) if scope["method"] == "POST" else without_body(receive)
        await self._app(scope, taken, with_headers)

    def _refused(self, scope: Scope) -> Refusal | None:
        """Return why a request is refused by its head alone."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if len(headers.getlist("host")) > 1 or not self._settings.allows_host(host):
            return Refusal(403, f"this panel is at {self._settings.url}")
        if scope["method"] not in METHODS:
            return Refusal(405, "the panel knows GET and POST")
        if scope["method"] == "POST" and not self._settings.allows_origin(headers.get("origin", ""), host):
            return Refusal(403, "this change was asked for by a page that is not the panel's")
        length = headers.get("content-length", "0")
        if "content-length" in headers and "transfer-encoding" in headers:
            return Refusal(400, "a request has Content-Length or Transfer-Encoding, not both")
        if not length.isascii() or not length.isdecimal() or len(length) > 9 or int(length) > LARGEST_BODY:
            return Refusal(413, f"at most {LARGEST_BODY} bytes are taken")
        return None


def counted(receive: Receive) -> Receive:
    """Return a receiver that raises `Refusal` once a body is larger than is taken."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > LARGEST_BODY:
            raise Refusal(413, f"at most {LARGEST_BODY} bytes are taken")
        return message

    return bounded


def without_body(receive: Receive) -> Receive:
    """Return a receiver that drops a body: no page that is looked at reads one.

    A stream, which waits for its client to go away, would meet it when its answer has begun: too late to refuse.
    """

    async def dropped() -> Message:
        message = await receive()
        return {**message, "body": b""} if message["type"] == "http.request" else message

    return dropped
