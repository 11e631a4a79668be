"""Report the size of the program and the relations of its parts, with the budgets of its rooms; nothing fails.

It prints: lines, files and median file of each room; long and small files; import circles at module level, and with
imports inside functions; modules imported by only one other, and those that import most; the files that four
commands run through:

    python -m benchmarks.house                    # about a minute; --no-paths leaves the commands out
    python -m benchmarks.house --since 62a1056f   # beside the lines of an earlier commit
"""

from __future__ import annotations

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

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from benchmarks.campaign import ROOT, arguments

PRODUCT: Final = ("bench", "drivers", "sim")
BESIDE: Final = ("tests", "benchmarks")
LONG, SMALL, MOST = 600, 40, 12
BUDGETS: Final = {
    "drivers": 7000, "sim": 8200, "base + model + readings": 4500, "config": 6000, "run": 8000, "stats": 1900,
    "calibration": 7500, "diagnosis": 6500, "planning": 2200, "history": 4000, "results": 5000, "services": 4500,
    "cli": 4200, "panel + certificate + catalogue + batch + exchange": 12400,
}  # fmt: skip
"""Largest number of lines of each room; rooms joined by "+" share a number."""
WHOLE: Final = {"lines": 82_000, "files": 340, "tests": 46_000, "benchmarks": 9_000}
PATHS: Final = {"run paper --dry-run": 170, "calibrate": 90, "diagnose": 130, "certificate --draft": 110}
"""Largest number of files that each command may execute."""

COMMANDS: Final = {
    "run paper --dry-run": ("run", "paper", "--dry-run", "--seed", "1", "--name", "house"),
    "calibrate": ("calibrate", "house", "--json", "house.json"),
    "diagnose": ("diagnose", "house"),
    "certificate --draft": (
        *("certificate", "issue", "house", "--laboratory", "laboratory.yaml", "--order", "order.yaml"),
        *("--authorised-by", "A. Person", "--draft", "--out", "draft"),
    ),
}
"""The commands whose files are counted, carried out one after the other in one folder."""

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
    """A module of the program: its dotted name, its file and its text."""

    name: str
    path: Path
    text: str

    @property
    def room(self) -> str:
        """The room that contains the module."""
        return room_of(self.path.relative_to(ROOT))

    @property
    def lines(self) -> int:
        """The number of lines."""
        return self.text.count("\n")

    @cached_property
    def tree(self) -> ast.Module:
        """The syntax tree."""
        return ast.parse(self.text)

    def imported(self, known: Mapping[str, Module], *, inner: bool) -> Iterator[str]:
        """Yield the modules of `known` that this module imports; `inner` includes imports inside functions."""
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


def room_of(path: Path) -> str:
    """Return the room of a file by its path from the root: a folder of `bench`, else the top folder."""
    parts = path.parts
    return parts[0] if parts[0] != "bench" else parts[1] if len(parts) > 2 else "bench"


def lines_at(revision: str) -> dict[str, int]:
    """Return the number of lines by room at a commit."""
    asked = ["git", "grep", "-c", "", revision, "--", *(f"{top}/*.py" for top in (*PRODUCT, *BESIDE))]
    answer = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True).stdout  # noqa: S603
    counted: Counter[str] = Counter()
    for line in answer.splitlines():
        _, path, number = line.split(":")
        counted[room_of(Path(path))] += int(number)
    return counted


def modules() -> dict[str, Module]:
    """Return the modules of the program by name."""
    found = {}
    for path in sorted(path for top in PRODUCT for path in (ROOT / top).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = Module(name, path, path.read_text(encoding="utf-8"))
    return found


def circles(edges: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the strongly connected components with more than one module, largest first."""
    names = sorted(edges)
    place = {name: k for k, name in enumerate(names)}
    rows, columns = np.array([(place[one], place[other]) for one in names for other in edges[one]]).T
    graph = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(names), len(names)))
    label = connected_components(graph, connection="strong")[1]
    components = ([names[k] for k in np.flatnonzero(label == one)] for one in np.unique(label))
    return sorted((one for one in components if len(one) > 1), key=len, reverse=True)


def print_rooms(known: Mapping[str, Module], since: str) -> None:
    """Print lines, files and the median file of each room, its budget, and its lines at the commit `since`."""
    rooms: dict[str, list[int]] = {}
    for module in known.values():
        rooms.setdefault(module.room, []).append(module.lines)
    before = lines_at(since) if since else {}
    budgets = {**BUDGETS, **dict.fromkeys(rooms.keys() - " + ".join(BUDGETS).split(" + "))}
    print(f"{'room':<50}{'lines':>8}{'files':>7}{'median':>8}{'budget':>8}" + f"{since[:9]:>10}")
    for names, budget in budgets.items():
        lines = [one for name in names.split(" + ") for one in rooms.get(name, ())]
        _print_room(names, lines, budget, sum(before.get(name, 0) for name in names.split(" + ")))
    whole = [module.lines for module in known.values()]
    _print_room(
        "the program",
        whole,
        WHOLE["lines"],
        sum(lines for room, lines in before.items() if room not in BESIDE),
    )
    for top in BESIDE:
        files = list((ROOT / top).rglob("*.py"))
        lines = [path.read_text(encoding="utf-8").count("\n") for path in files]
        _print_room(top, lines, WHOLE[top], before.get(top, 0))
    print(f"the program may have {WHOLE['files']} files")


def _print_room(name: str, lines: list[int], budget: int | None, before: int) -> None:
    print(f"{name:<50}{sum(lines):>8}{len(lines):>7}{median(lines):>8.0f}{budget or '':>8}{before or '':>10}")


def print_shape(known: Mapping[str, Module]) -> None:
    """Print long and small files, who imports whom, and import circles."""
    for module in known.values():
        if module.lines > LONG:
            print(f"over {LONG} lines: {module.path.relative_to(ROOT)} ({module.lines})")
    small = sum(module.lines < SMALL and module.path.name != "__init__.py" for module in known.values())
    inner = {name: sorted(set(module.imported(known, inner=True))) for name, module in known.items()}
    outer = {name: sorted(set(module.imported(known, inner=False))) for name, module in known.items()}
    fan_in = Counter(other for others in inner.values() for other in others)
    once = sum(fan_in[name] == 1 for name in known)
    print(f"{small} files under {SMALL} lines; {once} modules that one other imports")
    print("imported by most: " + ", ".join(f"{name} {count}" for name, count in fan_in.most_common(MOST)))
    for what, edges in (("module level", outer), ("functions included", inner)):
        print(f"import circles, {what}: {[len(circle) for circle in circles(edges)] or 'none'}")
    for circle in circles(outer):
        print(f"  {', '.join(circle)}")


def print_paths() -> None:
    """Print how many files, functions and rooms each of the commands executes."""
    known = {str(module.path.relative_to(ROOT)): module for module in modules().values()}
    print(f"{'path of':<32}{'files':>8}{'functions':>11}{'rooms':>7}{'files, budget':>15}")
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
            numbers = f"{len(told['files']):>8}{told['functions']:>11}{len(rooms):>7}{PATHS[command]:>15}"
            print(f"{command:<32}{numbers}{status}")


def main() -> None:
    given = arguments(
        __doc__, no_paths=(False, "leave out the commands"), since=("", "a commit whose lines stand beside")
    )
    known = modules()
    print_rooms(known, given.since)
    print_shape(known)
    if not given.no_paths:
        print_paths()


if __name__ == "__main__":
    main()
