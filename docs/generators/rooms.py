"""The tree of rooms and who may import whom, from the contract that the imports are held against."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path
from typing import Any, Final

from docs.generators.markdown import first_line, table

ROOT: Final = Path(__file__).parents[2]
_LAYERS: Final = "layers"


def _contracts() -> list[dict[str, Any]]:
    with (ROOT / "pyproject.toml").open("rb") as file:
        contracts: list[dict[str, Any]] = tomllib.load(file)["tool"]["importlinter"]["contracts"]
    return contracts


def layers() -> list[list[str]]:
    """Return the rooms of `bench`, the top floor first, those of one floor together."""
    (contract,) = (c for c in _contracts() if c["type"] == _LAYERS)
    return [re.findall(r"[\w.]+", layer) for layer in contract["layers"]]


def fragment() -> str:
    """Return the two tables: rooms from the top floor down, and what else is held."""
    rows = []
    for floor, names in enumerate(layers(), start=1):
        for name in names:
            place = f"bench.{name}"
            rows.append((str(floor), f"`{place}`", _holds(place)))
    others = [
        (c["name"], ", ".join(f"`{m}`" for m in c.get("source_modules", ())))
        for c in _contracts()
        if c["type"] != _LAYERS
    ]
    outside = [(f"`{name}`", _holds(name)) for name in ("drivers", "sim", *_folders("drivers", "sim"))]
    return "\n\n".join(
        (
            "Each room may import those on floors below it, and no other:",
            table(("floor", "room", "what it holds"), rows),
            "Beside `bench` stand two houses:",
            table(("room", "what it holds"), outside),
            "What else `make lint` holds the imports to:",
            table(("rule", "of"), others),
        )
    )


def _folders(*tops: str) -> list[str]:
    return [
        f"{top}.{path.parent.name}" for top in tops for path in sorted((ROOT / top).glob("*/__init__.py"))
    ]


def _holds(module: str) -> str:
    """Return the first sentence of a room's own description."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return first_line(text).partition(". ")[0].rstrip(".")
