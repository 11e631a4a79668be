"""The check block of the bench: its control charts, as `bench chart --page` writes them. Nothing is written."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from bench.panel.access import Refusal
from bench.panel.acting import looking, panel_of
from bench.panel.pages.shown import APART

KINDS: Final = {"": None, "real": True, "simulated": False}


async def check(request: Request) -> Response:
    """Show the charts of the check block of which the latest run is; `of` says whether real or simulated ones."""
    looking(request)
    asked = request.query_params.get("of", "")
    if asked not in KINDS:
        raise Refusal(400, "of: expected real or simulated")
    drawn = await run_in_threadpool(_drawn, panel_of(request).settings.runs, KINDS[asked])
    return Response(drawn, media_type="text/html; charset=utf-8", headers=APART)


def _drawn(folder: Path, real: bool | None) -> str:
    from bench.results.control_chart_page import render_chart
    from bench.services.check_block import charted
    from bench.services.requests.history import Chart

    return render_chart(charted(Chart(folder, folder=folder, real=real)))
