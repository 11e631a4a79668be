"""Tables for a person: in the terminal, as plain text, as HTML."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Iterable
from typing import Any, Final

from rich.console import Console
from rich.table import Table

WIDTH: Final = 120
"""Characters in a line where no terminal says it; no table of ours is cut at this width."""


def table(*headings: str, no_wrap: bool = False) -> Table:
    """Return an empty table; a heading that begins with ">" stands over a column of numbers, to the right."""
    made = Table(box=None, pad_edge=False)
    for heading in headings:
        right = heading.startswith(">")
        made.add_column(heading.removeprefix(">"), justify="right" if right else "left", no_wrap=no_wrap)
    return made


def as_text(print_on: Callable[[Console], None]) -> str:
    """Return what a function prints on a console, without colours and without the last line end."""
    file = io.StringIO()
    print_on(Console(file=file, highlight=False, soft_wrap=True, markup=False, width=WIDTH))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def as_html(lines: Iterable[str], *tables: Table) -> str:
    """Return sentences and tables as HTML, for a notebook."""
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines) + "".join(map(_html_table, tables))


def _html_table(shown: Table) -> str:
    columns = [(f' style="text-align:{c.justify}"', c) for c in shown.columns]
    head = "".join(f"<th{style}>{_escaped(c.header)}</th>" for style, c in columns)
    cells = zip(
        *([f"<td{style}>{_escaped(cell)}</td>" for cell in c.cells] for style, c in columns), strict=True
    )
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _escaped(cell: Any) -> str:
    return html.escape(str(cell))
