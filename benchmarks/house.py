"""How large the program is and how far its parts hang together: a report, no gate.

Lines, files and medians of each room; files that are long or small; import circles at module level and with imports
inside functions; modules that one other imports; the files that four commands run through:

    python -m benchmarks.house            # about a minute; --no-paths leaves the commands out
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PRODUCT: Final = ("bench", "drivers", "sim")
BESIDE: Final = ("tests", "benchmarks")
LONG, SMALL = 600, 40

COMMANDS: Final = {
    "run paper --dry-run": ("run", "paper", "--dry-run", "--seed", "1", "--name", "house"),
    "calibrate": ("calibrate", "house", "--json", "house.json"),
    "diagnose": ("diagnose", "house"),
    "certificate --draft": (
        *("certificate", "issue", "house", "--laboratory", "laboratory.yaml", "--order", "order.yaml"),
        *("--authorised-by", "A. Person", "--draft", "--out", "draft"),
    ),
}
"""The commands whose paths are followed, one after the other in one folder."""

PROBE: Final = """\
import json, sys, threading
root, answer, arguments = sys.argv[1], sys.argv[2], sys.argv[3:]
places = tuple(f"{root}/{top}/" for top in ("bench", "drivers", "sim"))
called = set()
def note(frame, event, _):
    code = frame.f_code
    ours = code.co_filename.startswith(places) and code.co_filename.endswith(".py")
    if ours and event == "call" and code.co_name != "<module>":
        called.add(code)
threading.setprofile(note)
sys.setprofile(note)
sys.argv = ["bench", *arguments]
from bench.cli.program import main
try:
    status = main()
except SystemExit as end:
    status = end.code
sys.setprofile(None)
files = {code.co_filename[len(root) + 1:] for code in called}
with open(answer, "w", encoding="utf-8") as file:
    json.dump({"status": status or 0, "functions": len(called), "files": sorted(files)}, file)
"""


@dataclass(frozen=True)
class Module:
    """A module of the program: its dotted name, its file, its text."""

    name: str
    path: Path
    text: str

    @property
    def room(self) -> str:
        """The folder that it stands in: the top one of drivers and simulation, below `bench` the room."""
        parts = self.path.relative_to(ROOT).parts[:-1]
        return "/".join(parts[: 3 if parts[1:2] == ("analysis",) else 2 if parts[0] == "bench" else 1])

    @property
    def lines(self) -> int:
        """How many lines it has."""
        return self.text.count("\n")

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax."""
        return ast.parse(self.text)

    def imported(self, known: Mapping[str, Module], *, inner: bool) -> Iterator[str]:
        """Yield the modules of `known` that it imports; `inner` includes imports inside functions."""
        for node in ast.walk(self.tree) if inner else _at_module_level(self.tree.body):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name in known)
            elif isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    name = whole if whole in known else node.module
                    if name in known and name != self.name:
                        yield name


def _at_module_level(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        yield node
        if isinstance(node, ast.If | ast.Try):
            yield from _at_module_level([*node.body, *node.orelse])


def modules() -> dict[str, Module]:
    """Return the modules of the program by name."""
    found = {}
    for path in sorted(path for top in PRODUCT for path in (ROOT / top).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = Module(name, path, path.read_text(encoding="utf-8"))
    return found


def circles(edges: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the strongly connected components with more than one module (Tarjan 1972), largest first."""
    found: list[list[str]] = []
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in edges[name]:
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            at = stack.index(name)
            component = stack[at:]
            del stack[at:]
            if len(component) > 1:
                found.append(sorted(component))

    for name in edges:
        if name not in index:
            visit(name)
    return sorted(found, key=len, reverse=True)


def print_rooms(known: Mapping[str, Module]) -> None:
    """Print lines, files and the median file of each room."""
    rooms: dict[str, list[int]] = {}
    for module in known.values():
        rooms.setdefault(module.room, []).append(module.lines)
    print(f"{'room':<32}{'lines':>8}{'files':>7}{'median':>8}")
    for room, lines in rooms.items():
        print(f"{room:<32}{sum(lines):>8}{len(lines):>7}{median(lines):>8.0f}")
    every = [module.lines for module in known.values()]
    print(f"{'the program':<32}{sum(every):>8}{len(every):>7}{median(every):>8.0f}")
    for top in BESIDE:
        lines = [path.read_text(encoding="utf-8").count("\n") for path in (ROOT / top).rglob("*.py")]
        print(f"{top:<32}{sum(lines):>8}{len(lines):>7}{median(lines):>8.0f}")


def print_shape(known: Mapping[str, Module]) -> None:
    """Print what is long, small, imported by one other alone, and what imports itself by a way round."""
    for module in known.values():
        if module.lines > LONG:
            print(f"over {LONG} lines: {module.path.relative_to(ROOT)} ({module.lines})")
    small = sum(module.lines < SMALL and module.path.name != "__init__.py" for module in known.values())
    inner = {name: sorted(set(module.imported(known, inner=True))) for name, module in known.items()}
    outer = {name: sorted(set(module.imported(known, inner=False))) for name, module in known.items()}
    fan_in = Counter(other for others in inner.values() for other in others)
    once = sum(fan_in[name] == 1 for name in known)
    print(f"{small} files under {SMALL} lines; {once} modules that one other imports")
    for what, edges in (("module level", outer), ("functions included", inner)):
        print(f"import circles, {what}: {[len(circle) for circle in circles(edges)] or 'none'}")
    for circle in circles(outer):
        print(f"  {', '.join(circle)}")


def print_paths() -> None:
    """Print how many files, functions and rooms each of the commands runs through."""
    known = {str(module.path.relative_to(ROOT)): module for module in modules().values()}
    print(f"{'path of':<32}{'files':>8}{'functions':>11}{'rooms':>7}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("laboratory.yaml", "order.yaml"):
            (folder / file).write_bytes((ROOT / "config" / "certificate" / file).read_bytes())
        for command, arguments in COMMANDS.items():
            answer = folder / "answer.json"
            subprocess.run(  # noqa: S603 - this Python, on our own commands
                [sys.executable, "-c", PROBE, str(ROOT), str(answer), *arguments],
                cwd=folder,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                stdout=subprocess.DEVNULL,
                check=True,
            )
            told = json.loads(answer.read_text(encoding="utf-8"))
            rooms = {known[file].room for file in told["files"]}
            status = f"  (exit status {told['status']})" if told["status"] else ""
            print(f"{command:<32}{len(told['files']):>8}{told['functions']:>11}{len(rooms):>7}{status}")


def main() -> None:
    """Print the whole report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--no-paths", action="store_true", help="leave out the commands")
    given = parser.parse_args()
    known = modules()
    print_rooms(known)
    print_shape(known)
    if not given.no_paths:
        print_paths()


if __name__ == "__main__":
    main()
