"""The page of what was measured: the tables of `docs/measured.yaml`, each with the command that repeats it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import yaml

from docs.generators.markdown import code, table

STORED: Final = Path(__file__).parents[1] / "measured.yaml"
_INTRODUCTION: Final = """\
# What was measured

Look up here the figures behind the statements of other pages. Each table has the command that repeats it, in a
checkout of the program. All data are simulated, drawn by code that is independent of the model. z is
(estimate − truth)/u: its root mean square (rms) is 1 where the stated u is right.
"""


def stored() -> list[dict[str, Any]]:
    """Return the measurements as the file lists them."""
    found: list[dict[str, Any]] = yaml.safe_load(STORED.read_text(encoding="utf-8"))
    return found


def page() -> str:
    """Return the page."""
    return "\n\n".join([_INTRODUCTION, *(_section(one) for one in stored())])


def _section(one: dict[str, Any]) -> str:
    parts = [f"## {one['title']}", f"Of [{one['of']}](../{one['page']}). {one['drawn']}"]
    for command in one["commands"]:
        parts.append(code(f"python -m benchmarks.{command}"))
    if "rows" in one:
        parts.append(table(one["columns"], [[str(cell) for cell in row] for row in one["rows"]]))
    if "found" in one:
        parts.append(one["found"])
    return "\n\n".join(parts)
