"""The panel's templates, style and script, each at an address of its content."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.requests import Request
from starlette.responses import Response

from bench.base.numbers import typeset
from bench.base.text import visible
from bench.panel.access import Refusal
from bench.run.events import sha256

REPORT_STYLE: Final = "report.css"
"""The style of the reports, which the panel's own stands on."""

ASSETS: Final = {
    REPORT_STYLE: "text/css; charset=utf-8",
    "panel.css": "text/css; charset=utf-8",
    "panel.js": "text/javascript; charset=utf-8",
    "waiting.js": "text/javascript; charset=utf-8",
    "plots.js": "text/javascript; charset=utf-8",
    "icon.svg": "image/svg+xml",
}
"""What pages load, with its kind. They load nothing else, from nowhere else."""


@cache
def read_asset(name: str) -> bytes:
    """Return what is loaded by that name. Raises `KeyError` for any but the `ASSETS`."""
    if name not in ASSETS:
        raise KeyError(name)
    if name == REPORT_STYLE:
        return (files("bench.results") / "templates" / "style.css.j2").read_bytes()
    return (files("bench.panel") / "static" / name).read_bytes()


@cache
def asset(name: str) -> str:
    """Return the address of an asset, which changes with what is in it."""
    return f"/static/{sha256(read_asset(name))[:12]}/{name}"


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("bench.panel", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["typeset"] = typeset
    environment.globals["asset"] = asset
    return environment


def load() -> None:
    """Read and compile all templates and assets, so that no first page has to."""
    for name in ASSETS:
        asset(name)
    for name in _environment().list_templates():
        _environment().get_template(name)


def page(name: str, **content: Any) -> str:
    """Return the page that a template makes of its content: all escaped, no character in it acts unseen.

    What a page does not give to its template is an error.
    """
    return visible(_environment().get_template(name).render(**content))


KEPT = {"cache-control": "public, max-age=31536000, immutable"}


async def send_asset(request: Request) -> Response:
    """Send a file of ours; what was in it under another address is gone."""
    name = request.path_params["name"]
    if name not in ASSETS or request.scope["path"] != asset(name):
        raise Refusal(404, "there is no such file")
    return Response(read_asset(name), media_type=ASSETS[name], headers=KEPT)
