"""The plots of a run: their page, their numbers as JSON, and the numbers as tables."""

from __future__ import annotations

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from bench.base.languages import message
from bench.base.numbers import without_infinity
from bench.panel.access import Refusal
from bench.panel.outcome import previous_calibration
from bench.panel.pages.run import run_of
from bench.panel.plots import FORMS, live_table, plots_of, sections_of, table_of, written
from bench.panel.shared import page, panel_of
from bench.panel.stream import COVERAGE

LIVE = "live"
"""The table of the residuals from predictions, which the live page of a run plots."""


async def plots(request: Request) -> Response:
    """Show the plots of a finished run; the script then asks for their numbers."""
    found = run_of(request)
    return page(request, "plots.html.j2", run=found, sections=sections_of(found))


async def data(request: Request) -> Response:
    """Send the numbers of a run's plots, see `bench.panel.plots.plots_of`."""
    found = run_of(request)
    return JSONResponse(await run_in_threadpool(plots_of, found, panel_of(request).runs))


async def previous(request: Request) -> Response:
    """Send the readings minus their predictions by the unit's previous calibration, for the live page."""
    found, panel = run_of(request), panel_of(request)
    earlier = await run_in_threadpool(previous_calibration, found, panel.runs)
    points = () if earlier is None else await panel.followers.points(earlier.folder)
    told = {"run": earlier.name if earlier else "", "k": COVERAGE, "points": points}
    return JSONResponse(without_infinity(told))


async def table(request: Request) -> Response:
    """Send the numbers of a plot as a CSV file or an Excel workbook."""
    found, panel = run_of(request), panel_of(request)
    name, form = request.path_params["table"], request.path_params["form"]
    if form not in FORMS:
        raise Refusal(404, message("no such form of a table; choose one of the page"))
    if name == LIVE:
        rows = live_table(without_infinity(await panel.followers.points(found.folder)))
    else:
        rows = table_of(await run_in_threadpool(plots_of, found, panel.runs), name)
    content = await run_in_threadpool(written, rows, name, form, simulated=found.simulated)
    return Response(content, media_type=FORMS[form], headers={"content-disposition": "attachment"})
