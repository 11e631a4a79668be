"""The read-only pages on the catalogue, if the panel has one: a search for units, and the page of a unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from bench.panel.access import Refusal
from bench.panel.shared import looking, page, panel_of

if TYPE_CHECKING:
    from bench.catalogue.questions import AnswerTable
    from bench.catalogue.store import Catalogue
    from bench.results.catalogue import UnitResult

Told = TypeVar("Told")
LONGEST: Final = 300
ON_A_PAGE: Final = 100


async def units(request: Request) -> Response:
    """Show the units with runs that match the search."""
    asked = request.query_params.get("ask", "")[:LONGEST]
    found = await _asked(request, _units, asked)
    rows = [
        {"address": f"/catalogue/unit/{quote(row[0], safe='')}", **dict(zip(found.columns, row, strict=True))}
        for row in found.rows[:ON_A_PAGE]
        if row[0] is not None
    ]
    return page(request, "catalogue.html.j2", asked=asked, rows=rows, found=len(found), most=ON_A_PAGE)


async def unit(request: Request) -> Response:
    """Show a unit: its coefficients over time, its runs, its next due date."""
    history = await _asked(request, _history, request.path_params["unit"][:LONGEST])
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
    drawn = await _asked(request, _figure, request.path_params["unit"][:LONGEST])
    return Response(drawn, media_type="image/svg+xml", headers={"cache-control": "no-store"})


async def _asked(request: Request, question: Callable[[Catalogue, str], Told], asked: str) -> Told:
    """Return the answer of `question` to `asked` from the catalogue. Raises `Refusal` (404) without a catalogue."""
    looking(request)
    where = panel_of(request).settings.catalogue
    if not where:
        raise Refusal(404, "this panel has no catalogue; start it with --catalogue")
    from bench.catalogue.store import open_catalogue

    def answered() -> Told:
        with open_catalogue(where, existing=True) as catalogue:
            return question(catalogue, asked)

    return await run_in_threadpool(answered)


def _units(catalogue: Catalogue, asked: str) -> AnswerTable:
    from bench.catalogue.questions import answer

    # a word without a key is searched for in the names of units
    words = [
        word if "=" in word or "<" in word or ">" in word else f"unit=*{word}*" for word in asked.split()
    ]
    return answer(catalogue, words, "units")


def _history(catalogue: Catalogue, unit: str) -> UnitResult:
    from bench.catalogue.unit import unit_history

    return unit_history(catalogue, unit)


def _figure(catalogue: Catalogue, unit: str) -> str:
    from bench.catalogue.unit import unit_calibrations
    from bench.results.catalogue import unit_figure

    calibrations = unit_calibrations(catalogue, unit)
    if not calibrations:
        raise Refusal(
            404,
            f"{unit}: the catalogue has no calibration of it to draw; calibrate a run, then use 'bench "
            "catalogue sync'",
        )
    return unit_figure(calibrations)
