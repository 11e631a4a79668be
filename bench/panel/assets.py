"""The panel's own files, each at an address that changes with what is in it."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response

from bench.panel.access.people import Refusal
from bench.panel.look import ASSETS, asset, read_asset

KEPT = {"cache-control": "public, max-age=31536000, immutable"}


async def send_asset(request: Request) -> Response:
    """Send a file of ours; what was in it under another address is gone."""
    name = request.path_params["name"]
    if name not in ASSETS or request.scope["path"] != asset(name):
        raise Refusal(404, "there is no such file")
    return Response(read_asset(name), media_type=ASSETS[name], headers=KEPT)
