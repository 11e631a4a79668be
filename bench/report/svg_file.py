"""A figure as an SVG file that stands alone; the same input gives the same text."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

from bench.report.plots import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def svg_file(name: str, inches: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """Draw a figure and return the text of an SVG file; `name` fixes the identifiers in it."""
    from matplotlib import style
    from matplotlib.figure import Figure

    text = io.StringIO()
    with style.context(["default", {**STYLE, "svg.hashsalt": name}]):
        figure = Figure(figsize=inches, layout="constrained")
        draw(figure)
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(text, format="svg", metadata=nothing)
    return text.getvalue()
