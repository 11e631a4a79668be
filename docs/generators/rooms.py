"""The tree of rooms and who may import whom, from the contract that the imports are held against.

`python -c 'from docs.generators import rooms; rooms.write()'` updates the list of rooms in CONTRIBUTING.md.
"""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path
from typing import Any, Final

from docs.generators.markdown import first_line, table

ROOT: Final = Path(__file__).parents[2]
CONTRIBUTING: Final = ROOT / "CONTRIBUTING.md"
_LAYERS: Final = "layers"
_BEGIN: Final = "<!-- rooms: made by docs/generators/rooms.py, write() -->"
_END: Final = "<!-- end of the rooms -->"


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
            "Beside `bench` there are two packages:",
            table(("room", "what it holds"), outside),
            "Further rules of imports that `make lint` checks:",
            table(("rule", "of"), others),
        )
    )


def listing(text: str) -> str:
    """Return the text of CONTRIBUTING.md with the list of rooms as the code has it now."""
    before, _, rest = text.partition(_BEGIN)
    _, _, after = rest.partition(_END)
    rooms = [f"bench.{name}" for floor in layers() for name in floor] + ["drivers", "sim"]
    rows = [(f"`{place.replace('.', '/')}`", _holds(place), ", ".join(_inside(place))) for place in rooms]
    return f"{before}{_BEGIN}\n{table(('room', 'what it holds', 'rooms inside'), rows)}\n{_END}{after}"


def _inside(place: str) -> list[str]:
    folder = ROOT.joinpath(*place.split("."))
    return [f"`{path.parent.name}`" for path in sorted(folder.glob("*/__init__.py"))]


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


def write() -> None:
    """Bring the list of rooms in CONTRIBUTING.md up to date."""
    CONTRIBUTING.write_text(listing(CONTRIBUTING.read_text(encoding="utf-8")), encoding="utf-8")
