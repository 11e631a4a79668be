"""The table of the runs in the folder, with filters and search; the control charts of the check block."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final
from urllib.parse import urlencode

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from bench.base.languages import message
from bench.panel.access import Refusal, Role
from bench.panel.folder import UNREAD, RunRow
from bench.panel.shared import APART, looking, page, panel_of
from bench.services.errors import NoCheckBlock, Refused
from bench.services.requests.evaluation import Chart

if TYPE_CHECKING:
    from bench.results.control_chart import CheckBlockChart

ON_A_PAGE: Final = 50
FILTERS: Final = ("state", "verdict", "instruments", "unit", "bench", "operator")
LONGEST_SEARCH: Final = 200
MOST_OFFERED: Final = 200
"""Largest number of choices offered for a column; other values can be found by the search."""


def runs(request: Request) -> Response:
    """Show the runs that match the search, newest first."""
    looking(request)
    every = panel_of(request).table.rows()
    if unread := sum(row.state == UNREAD for row in every):
        panel_of(request).table.read_the_rest()
    asked = {name: request.query_params.get(name, "")[:LONGEST_SEARCH] for name in ("search", *FILTERS)}
    wanted = {name: asked[name] for name in FILTERS}
    words = tuple(asked["search"].casefold().split())
    found = [row for row in every if row.fits(words, wanted)]
    pages = max(math.ceil(len(found) / ON_A_PAGE), 1)
    number = min(max(_number(request.query_params.get("page", "")), 1), pages)
    return page(
        request,
        "runs.html.j2",
        rows=found[(number - 1) * ON_A_PAGE : number * ON_A_PAGE],
        found=len(found),
        total=len(every),
        unread=unread,
        asked=asked,
        choices=_choices(every, asked),
        page=number,
        pages=pages,
        address=lambda to: f"/?{urlencode({**{k: v for k, v in asked.items() if v}, 'page': to})}",
    )


def _choices(rows: list[RunRow], asked: dict[str, str]) -> dict[str, list[str]]:
    """Return the distinct values in each column, and those asked for, as choices for the filters."""
    offered = {}
    for column in FILTERS:
        words = {getattr(row, column) for row in rows} | {asked[column]}
        offered[column] = sorted(words - {""})[:MOST_OFFERED]
    return offered


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 7 else 1


KINDS: Final = {"": None, "real": True, "simulated": False}


async def check_block(request: Request) -> Response:
    """Show the charts of the latest check block; the parameter `of` chooses real or simulated runs."""
    person = looking(request)
    asked, wanted = _asked(request)
    try:
        await run_in_threadpool(charted, wanted)
    except Refused as why:
        told = "" if isinstance(why, NoCheckBlock) else why.typed
        return page(request, "no_check_block.html.j2", told=told, may=person.role is not Role.VIEWER)
    frame = "/check/chart" + (f"?of={asked}" if asked else "")
    return page(request, "framed.html.j2", title=message("Check block"), frame=frame, back="/")


async def chart(request: Request) -> Response:
    """Send the page with the charts of the check block."""
    looking(request)
    _, wanted = _asked(request)
    drawn = await run_in_threadpool(_drawn, wanted)
    return Response(drawn, media_type="text/html; charset=utf-8", headers=APART)


def _asked(request: Request) -> tuple[str, Chart]:
    """Return the kind of runs that the address asks for, and the request for their charts."""
    asked = request.query_params.get("of", "")
    if asked not in KINDS:
        raise Refusal(400, "the address asks for no known kind of runs; choose real or simulated")
    folder = panel_of(request).settings.runs
    return asked, Chart(folder, folder=folder, real=KINDS[asked])


def _drawn(wanted: Chart) -> str:
    from bench.results.control_chart import render_chart  # takes long to import

    return render_chart(charted(wanted))


def charted(request: Chart) -> CheckBlockChart:
    """Return the charts of a check block. Raises `Refused` if runs or request do not permit a chart."""
    from bench.services.check_block import charted as read_charts  # takes long to import

    return read_charts(request)
