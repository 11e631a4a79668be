"""The runs of the folder as a table, filtered and searched."""

from __future__ import annotations

import math
from typing import Final
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response

from bench.panel.acting import looking, panel_of
from bench.panel.pages.shown import page
from bench.panel.table import UNREAD, Row

ON_A_PAGE: Final = 50
FILTERS: Final = ("state", "verdict", "instruments", "unit", "bench", "operator")
LONGEST_SEARCH: Final = 200
MOST_OFFERED: Final = 200
"""A list of more different words than that is no choice; the search finds them."""


def runs(request: Request) -> Response:
    """Show the runs that are looked for, newest first."""
    looking(request)
    every = panel_of(request).table.rows()
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
        unread=sum(row.state == UNREAD for row in every),
        asked=asked,
        choices=_choices(every, asked),
        page=number,
        pages=pages,
        address=lambda to: f"/?{urlencode({**{k: v for k, v in asked.items() if v}, 'page': to})}",
    )


def _choices(rows: list[Row], asked: dict[str, str]) -> dict[str, list[str]]:
    """Return the words that each column has, to choose from."""
    offered = {}
    for column in FILTERS:
        words = {getattr(row, column) for row in rows} | {asked[column]}
        offered[column] = sorted(words - {""})[:MOST_OFFERED]
    return offered


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 7 else 1
