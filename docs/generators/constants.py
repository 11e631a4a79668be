"""The table of the diagnosis's constants, from the modules that hold them: value, and what stands below each."""

from __future__ import annotations

import ast
import importlib
import inspect
from itertools import pairwise
from typing import Any, Final

import numpy as np

from docs.generators.markdown import code, table

NAMED: Final = (
    "candidates.KIND_PRIOR", "candidates.RARE", "candidates.EQUAL", "evidence.SIZES", "evidence.LOG_SIZE_WEIGHTS",
    "evidence.LOG_SIZE_WEIGHTS_OF_METER", "evidence.KNOWN_SIZE", "evidence.NULLS", "noise_grid.RATIOS",
    "noise_grid.RATIO_SPREAD", "noise_kinds.LOG_PRIOR", "noise_kinds.TAIL_DOF", "posterior.PART",
)  # fmt: skip


def fragment() -> str:
    """Return the table."""
    rows = []
    for named in NAMED:
        home, _, name = named.rpartition(".")
        module = importlib.import_module(f"bench.diagnosis.{home}")
        rows.append((code(named), _value(name, getattr(module, name)), meaning(module, name)))
    return table(("constant", "value", "meaning"), rows)


def _value(name: str, value: Any) -> str:
    numbers = np.atleast_1d(list(value.values()) if isinstance(value, dict) else value).astype(float)
    logarithm = name.startswith("LOG_")
    shown = ", ".join(f"{number:g}" for number in (np.exp(numbers) if logarithm else numbers))
    return f"ln of {shown}" if logarithm else shown


def meaning(module: Any, name: str) -> str:
    """Return the text below a constant of a module, empty without one."""
    for node, after in pairwise(ast.parse(inspect.getsource(module)).body):
        named = (
            isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id == name
        )
        if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return " ".join(str(after.value.value).partition("\n\n")[0].split())
    return ""
