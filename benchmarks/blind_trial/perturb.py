"""Diagnose the same cases with each numeric constant of the diagnosis 30 % smaller and 30 % larger.

    python -m benchmarks.blind_trial --perturb --only single --rows 4

A constant that changes nothing is listed, too: either it is superfluous, or no case tests it.
"""

import ast
import importlib
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import bench.diagnosis
from benchmarks.blind_trial.adapter import diagnose_case, forget_thresholds
from benchmarks.blind_trial.cases import make_case
from benchmarks.blind_trial.score import Task
from benchmarks.campaign import markdown, spread

PART: Final = 0.3
FEW_NUMBERS: Final = 4
ROOM: Final = "bench.diagnosis"
NO_SIZE: Final = {"MODULUS", "SUBSETS", "ZEROS", "SCALES", "SEED", "FLOOR", "OF_MEDIAN", "KNOWN_SIZE"}
"""Constants that have no size of their own: numbers of channels and columns, seeds, expectations, a tuple's entry.

Another value would be wrong, not larger or smaller.
"""


@dataclass(frozen=True)
class Constant:
    """A numeric constant of a module, a number or a tuple of numbers."""

    module: str
    name: str
    value: Any

    @property
    def shown(self) -> str:
        """The value in a table; of many numbers, their count and the ends."""
        if not isinstance(self.value, tuple):
            return f"{self.value:g}"
        if len(self.value) > FEW_NUMBERS:
            return f"{len(self.value)} from {self.value[0]:g} to {self.value[-1]:g}"
        return ", ".join(f"{one:g}" for one in self.value)

    def times(self, factor: float) -> Any:
        """Return the value times a factor; whole numbers stay whole and change by at least one."""
        if isinstance(self.value, tuple):
            return tuple(_times(one, factor) for one in self.value)
        return _times(self.value, factor)


def _times(value: float, factor: float) -> float:
    if not isinstance(value, int):
        return value * factor
    changed = round(value * factor)
    return changed if changed != value else value + (1 if factor > 1 else -1)


def constants() -> list[Constant]:
    """Return the numeric constants of all modules of the diagnosis, each once, at its definition.

    A constant whose definition contains no number follows from other constants and is not listed.
    """
    found = []
    for info in pkgutil.walk_packages(bench.diagnosis.__path__, f"{ROOM}."):
        module = importlib.import_module(info.name)
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for node in tree.body:
            if (
                isinstance(node, ast.AnnAssign)
                and isinstance(node.target, ast.Name)
                and node.target.id.isupper()
                and node.target.id not in NO_SIZE
                and any(isinstance(part, ast.Constant) for part in ast.walk(node.value or node.target))
            ):
                value = getattr(module, node.target.id)
                if _numeric(value):
                    found.append(Constant(info.name, node.target.id, value))
    return found


def _numeric(value: object) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_numeric(one) for one in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


@contextmanager
def changed(constant: Constant, factor: float) -> Iterator[None]:
    """Replace the constant in every module that has it, within the context, also in a worker process."""
    # the constant came by pickle: the object that modules share is that of its own module
    own = getattr(importlib.import_module(constant.module), constant.name)
    places = [
        module
        for name, module in list(sys.modules.items())
        if name.startswith(ROOM) and getattr(module, constant.name, None) is own
    ]
    for module in places:
        setattr(module, constant.name, constant.times(factor))
    forget_thresholds()
    try:
        yield
    finally:
        for module in places:
            setattr(module, constant.name, own)
        forget_thresholds()


def _said(tasks: Sequence[Task]) -> list[tuple[object, ...]]:
    said: list[tuple[object, ...]] = []
    for task in tasks:
        found = diagnose_case(make_case(task.seed, task.row, task.index)[0])
        names = tuple((one["name"], tuple(one["cannot_tell_from"])) for one in found["effects"])
        said.append((found["verdict"], names))
    return said


def _of_constant(constant: Constant | None, tasks: Sequence[Task]) -> list[list[tuple[object, ...]]]:
    if constant is None:
        return [_said(tasks)]
    said = []
    for factor in (1.0 - PART, 1.0 + PART):
        with changed(constant, factor):
            said.append(_said(tasks))
    return said


def perturb(tasks: Sequence[Task], workers: int) -> list[str]:
    """Return a table with the number of changed verdicts, and of changed verdicts or names, for each constant."""
    every = constants()
    baseline, *others = spread(partial(_of_constant, tasks=tasks), [None, *every], workers)
    rows = []
    for constant, both in zip(every, others, strict=True):
        cells = []
        for said in both:
            pairs = list(zip(said, baseline[0], strict=True))
            cells.append(f"{sum(a[0] != b[0] for a, b in pairs)} / {sum(a != b for a, b in pairs)}")
        place = constant.module.removeprefix(f"{ROOM}.")
        rows.append((f"{place}.{constant.name}", constant.shown, *cells))
    told = f"{len(every)} constants, {len(tasks)} cases; verdicts / verdicts or names that differ"
    return [told, *markdown(("constant", "value", "30 % smaller", "30 % larger"), rows)]
