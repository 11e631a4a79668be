"""The templates of the panel's pages: one way to fill them."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.requests import Request
from starlette.responses import HTMLResponse

from bench.base.numbers import typeset
from bench.base.visible import visible
from bench.panel.access.acting import person_of
from bench.panel.assets import address_of


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
    environment.globals["static"] = address_of
    return environment


def page(request: Request, name: str, *, status: int = 200, **content: Any) -> HTMLResponse:
    """Return the page that a template makes of its content, with who is signed in (`person`, None for a stranger).

    What a page does not give to it is an error. All is escaped, and no character in it acts unseen.
    """
    text = (
        _environment().get_template(name).render(person=person_of(request), path=request.url.path, **content)
    )
    return HTMLResponse(visible(text), status_code=status)
