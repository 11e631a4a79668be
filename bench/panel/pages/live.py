"""One run, as it goes on."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response

from bench.panel.access.acting import looking, panel_of
from bench.panel.pages.shown import page


def run(request: Request) -> Response:
    """Show a run."""
    looking(request)
    found = panel_of(request).runs.run(request.path_params["name"])
    return page(request, "run.html.j2", run=found)
