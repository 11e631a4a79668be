"""The panel's own files, kept in memory, each at an address that changes with what is in it."""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import Final

from starlette.requests import Request
from starlette.responses import Response

from bench.panel.access.people import Refusal

KINDS: Final = {
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


@cache
def assets() -> dict[str, bytes]:
    """Return the files by name."""
    folder = files("bench.panel") / "static"
    return {one.name: one.read_bytes() for one in folder.iterdir() if one.name.rpartition(".")[2] in KINDS}


@cache
def address_of(name: str) -> str:
    """Return where a page finds one of them."""
    return f"/static/{sha256(assets()[name]).hexdigest()[:12]}/{name}"


async def asset(request: Request) -> Response:
    """Send a file of ours; what was in it under another address is gone."""
    name = request.path_params["name"]
    if name not in assets() or request.url.path != address_of(name):
        raise Refusal(404, "there is no such file")
    kept = {"cache-control": "public, max-age=31536000, immutable"}
    return Response(assets()[name], media_type=KINDS[name.rpartition(".")[2]], headers=kept)
