"""The pages on the catalogue, if the panel has one: a search among units, and a unit's page. They only read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from bench.base.languages import message
from bench.panel.access import Refusal
from bench.panel.shared import looking, page, panel_of

if TYPE_CHECKING:
    from bench.catalogue.questions import AnswerTable
    from bench.results.catalogue import UnitResult

LONGEST: Final = 300
ON_A_PAGE: Final = 100


async def units(request: Request) -> Response:
    """Show the units whose runs match the search."""
    looking(request)
    asked = request.query_params.get("ask", "")[:LONGEST]
    found = await run_in_threadpool(_units, _where(request), asked)
    rows = [
        {"address": f"/catalogue/unit/{quote(row[0], safe='')}", **dict(zip(found.columns, row, strict=True))}
        for row in found.rows[:ON_A_PAGE]
        if row[0] is not None
    ]
    return page(request, "catalogue.html.j2", asked=asked, rows=rows, found=len(found), most=ON_A_PAGE)


async def unit(request: Request) -> Response:
    """Show a unit: its coefficients over time, its runs, its next due date."""
    looking(request)
    name = request.path_params["unit"][:LONGEST]
    history = await run_in_threadpool(_history, _where(request), name)
    from bench.results.catalogue import coefficient_rows

    return page(
        request,
        "unit.html.j2",
        history=history,
        rows=coefficient_rows(history.calibrations),
        figure=f"/catalogue/figure/{quote(history.unit, safe='')}" if history.calibrations else "",
        runs=list(reversed(history.runs))[:ON_A_PAGE],
    )


async def figure(request: Request) -> Response:
    """Send the figure of a unit as a standalone SVG file."""
    looking(request)
    name = request.path_params["unit"][:LONGEST]
    drawn = await run_in_threadpool(_figure, _where(request), name)
    return Response(drawn, media_type="image/svg+xml", headers={"cache-control": "no-store"})


def _where(request: Request) -> str:
    """Return the catalogue that the panel shows. Raises `Refusal` (404) if it has none."""
    where = panel_of(request).settings.catalogue
    if not where:
        raise Refusal(404, message("this panel has no catalogue; start it with --catalogue"))
    return where


def _units(where: str, asked: str) -> AnswerTable:
    from bench.catalogue.questions import answer
    from bench.catalogue.store import open_catalogue

    # a word without a key is searched for in the names of units
    words = [
        word if "=" in word or "<" in word or ">" in word else f"unit=*{word}*" for word in asked.split()
    ]
    with open_catalogue(where, existing=True) as catalogue:
        return answer(catalogue, words, "units")


def _history(where: str, unit: str) -> UnitResult:
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import unit_history

    with open_catalogue(where, existing=True) as catalogue:
        return unit_history(catalogue, unit)


def _figure(where: str, unit: str) -> str:
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import unit_calibrations
    from bench.results.catalogue import unit_file

    with open_catalogue(where, existing=True) as catalogue:
        calibrations = unit_calibrations(catalogue, unit)
    if not calibrations:
        raise Refusal(404, message(f"{unit}: no calibration to draw; calibrate a run of it"))
    return unit_file(calibrations)
