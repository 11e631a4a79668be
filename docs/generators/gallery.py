"""The gallery: pages of `docs/gallery`, carried out when the site is built, and the same as notebooks.

Blocks of Python run in one namespace; a block `console` carries out commands of the program. What they print, the
value of a last expression and open figures stand below the block, on the page and in the notebook.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import re
import tempfile
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

from docs.generators.workbench import standing_in, told

ROOT: Final = Path(__file__).parents[2]
SOURCES: Final = ROOT / "docs" / "gallery"
NAMES: Final = (
    "calibrate-a-dataframe", "budget-for-my-head", "plan-fewer-points", "find-a-hidden-effect", "two-laboratories",
)  # fmt: skip
"""In the order of the page."""
_FIGURE: Final = "A chart: what the code above draws, described in the text before it"
_BLOCK: Final = re.compile(r"^```(python|console)\n(.*?)^```\n", re.M | re.S)
_GREY: Final[Any] = {f"{part}.color": "#777f88" for part in ("text", "xtick", "ytick")} | {
    "axes.labelcolor": "#777f88", "axes.edgecolor": "#777f88", "legend.frameon": False,
}  # fmt: skip
"""Figures are legible on a light and a dark page."""


@dataclass
class Cell:
    """A part of a page: a text, or code with what it printed and drew."""

    kind: str
    text: str
    printed: str = ""
    figures: list[bytes] = field(default_factory=list)


def cells_of(source: str) -> list[Cell]:
    """Return a page's texts and blocks of code in their order."""
    pieces = _BLOCK.split(source)
    kinds = ["text", *(kind for i in range(1, len(pieces), 3) for kind in (pieces[i], "text"))]
    texts = [pieces[0], *(text for i in range(1, len(pieces), 3) for text in pieces[i + 1 : i + 3])]
    return [Cell(kind, text.strip("\n")) for kind, text in zip(kinds, texts, strict=True) if text.strip()]


@cache
def carried_out(name: str) -> list[Cell]:
    """Carry out a page in a folder of its own. What a block raises ends the build."""
    import matplotlib as mpl

    cells = cells_of((SOURCES / f"{name}.md").read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": name}
    mpl.use("agg")
    with tempfile.TemporaryDirectory() as folder, standing_in(Path(folder)), mpl.rc_context(_GREY):
        for cell in cells:
            if cell.kind == "console":
                cell.printed = "".join(told(line.removeprefix("$ bench ")) for line in cell.text.splitlines())
            elif cell.kind == "python":
                cell.printed = _run(cell.text, names, name)
                cell.figures = _drawn()
            cell.printed = cell.printed.replace(f"{Path(folder).resolve()}/", "").replace(f"{ROOT}/", "")
    return cells


def _run(text: str, names: dict[str, Any], where: str) -> str:
    """Run a block; return what it prints, and the value of an expression at its end as a notebook shows it."""
    tree = ast.parse(text, where)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(tree, where, "exec"), names)  # noqa: S102 - our own page
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), where, "eval"), names)  # noqa: S307 - our own page
            if value is not None:
                print(value)
    return out.getvalue()


def _drawn() -> list[bytes]:
    """Return the open figures as PNG, and close them."""
    import matplotlib.pyplot as plt

    pictures = []
    for number in plt.get_fignums():
        picture = io.BytesIO()
        plt.figure(number).savefig(picture, format="png", dpi=150, transparent=True, bbox_inches="tight")
        pictures.append(picture.getvalue())
    plt.close("all")
    return pictures


def fragment(name: str) -> str:
    """Return a page without its title, with what its blocks print and draw."""
    parts = []
    for cell in carried_out(name):
        if cell.kind == "text":
            parts.append(re.sub(r"^# [^\n]*\n+", "", cell.text))
            continue
        parts.append(f"```{cell.kind}\n{cell.text}\n```")
        if cell.printed.strip():
            parts.append(f"```text\n{cell.printed.rstrip()}\n```")
        parts += [f"![{_FIGURE}](reference/gallery/{name}-{i}.png)" for i, _ in enumerate(cell.figures, 1)]
    parts.append(f"<a href='gallery/{name}.ipynb' download>This example as a notebook</a>")
    return "\n\n".join(parts) + "\n"


def notebook(name: str) -> dict[str, Any]:
    """Return an example as a Jupyter notebook (format 4.5), with its outputs."""
    cells = [_notebook_cell(cell, f"cell-{i}") for i, cell in enumerate(carried_out(name))]
    about = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
             "language_info": {"name": "python"}}  # fmt: skip
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": cells}


def _notebook_cell(cell: Cell, identity: str) -> dict[str, Any]:
    text = re.sub(r"^\$ ", "!", cell.text, flags=re.M) if cell.kind == "console" else cell.text
    made: dict[str, Any] = {"id": identity, "metadata": {}, "source": text.splitlines(keepends=True)}
    if cell.kind == "text":
        return {"cell_type": "markdown", **made}
    outputs: list[dict[str, Any]] = []
    if cell.printed:
        outputs.append(
            {"output_type": "stream", "name": "stdout", "text": cell.printed.splitlines(keepends=True)}
        )
    for picture in cell.figures:
        data = {"image/png": base64.b64encode(picture).decode("ascii")}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    return {"cell_type": "code", "execution_count": None, **made, "outputs": outputs}


def write_gallery(reference: Path) -> None:
    """Write the parts of the page with their figures, and the notebooks where the site serves them."""
    figures, notebooks = reference / "gallery", reference / "served" / "gallery"
    for folder in (figures, notebooks):
        folder.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        drawn = (picture for cell in carried_out(name) for picture in cell.figures)
        for i, picture in enumerate(drawn, 1):
            (figures / f"{name}-{i}.png").write_bytes(picture)
        (reference / f"_gallery-{name}.md").write_text(fragment(name), encoding="utf-8")
        text = json.dumps(notebook(name), indent=1, ensure_ascii=False) + "\n"
        (notebooks / f"{name}.ipynb").write_text(text, encoding="utf-8")
