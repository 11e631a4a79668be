"""The runs of the folder."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response

from bench.api.records import run_summary
from bench.panel.access.acting import looking, panel_of
from bench.panel.pages.shown import page


def runs(request: Request) -> Response:
    """Show the runs, newest first."""
    looking(request)
    found = sorted(panel_of(request).runs.runs(), key=lambda run: run.created, reverse=True)
    return page(request, "runs.html.j2", rows=[run_summary(run) for run in found])
