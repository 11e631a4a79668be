"""Tables for display: in the terminal, as plain text, as HTML."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from bench.base.computing import quiet
from bench.base.languages import HEADING, message, shown, translated
from bench.base.text import visible

WIDTH: Final = 120
"""Line width if there is no terminal, characters; wide enough for all tables of the project."""


class Screen(Console):
    """A console that translates texts, and shows their control characters as escapes instead of obeying them."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print objects, a text in the current language of prompts if it has a translation."""
        super().print(*(translated(one) if isinstance(one, str) else one for one in objects), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the rendered segments with control characters escaped, except the console's own control codes."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)


class _Rows(Table):
    """A table whose cells show control characters as escapes; columns are as wide as the escaped text.

    Numbers and texts of several words are in the current language.
    """

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        super().add_row(
            *(visible(str(shown(cell))) if isinstance(cell, str) else cell for cell in cells), **options
        )


def table(*headings: str, no_wrap: bool = False) -> Table:
    """Return an empty table with translated headings; ">" begins that of a right-aligned column, for numbers."""
    made = _Rows(box=None, pad_edge=False)
    for heading in headings:
        right = heading.startswith(">")
        made.add_column(
            translated(heading.removeprefix(">"), HEADING),
            justify="right" if right else "left",
            no_wrap=no_wrap,
            overflow="fold",  # a path is never cut
        )
    return made


def print_notes(out: Console, notes: Iterable[str], lead: str = "") -> None:
    """Print the notes of a result, each translated as a whole; print none with `--quiet`.

    The JSON and the page contain the notes, too. `lead` names the source among several.
    """
    for note in () if quiet.get() else notes:
        out.print(Text(f"{translated(message('note'))}: {lead}{translated(note)}"))  # not translated twice


def as_text(print_on: Callable[[Console], None]) -> str:
    """Return the text that `print_on` prints on a console, without colours and trailing blanks."""
    file = io.StringIO()
    print_on(Screen(file=file, highlight=False, soft_wrap=True, markup=False, width=WIDTH))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def as_html(lines: Iterable[str], *tables: Table) -> str:
    """Return sentences and tables as HTML, for a notebook."""
    return "".join(f"<p>{_escaped(line)}</p>" for line in lines) + "".join(map(_html_table, tables))


def _html_table(shown: Table) -> str:
    columns = [(f' style="text-align:{c.justify}"', c) for c in shown.columns]
    head = "".join(f"<th{style}>{_escaped(c.header)}</th>" for style, c in columns)
    cells = zip(
        *([f"<td{style}>{_escaped(cell)}</td>" for cell in c.cells] for style, c in columns), strict=True
    )
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _escaped(cell: Any) -> str:
    return html.escape(visible(str(cell)))
