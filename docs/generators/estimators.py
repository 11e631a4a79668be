"""The page on estimators, from their registry."""

from __future__ import annotations

import importlib
from typing import Final

from bench.calibration.estimators import ESTIMATORS
from docs.generators.markdown import code, table

_INTRODUCTION: Final = """\
# Estimators

Choose an estimator with `--estimator NAME` of `bench calibrate`, `bench budget` and `bench require`. The default
is the first. [Writing an estimator](../writing-an-estimator.md) shows how to add one.
"""


def page() -> str:
    """Return the page."""
    rows = [
        (
            " or ".join(code(name) for name in (e.name, *e.also)),
            getattr(e, "phrase", "") or getattr(e, "told", ""),
            "each by its weight" if e.gain is None else "alike in each run of the same angles",
            "yes" if e.weighs_all else "no",
            code(e.counts_as or e.name),
        )
        for e in ESTIMATORS.values()
    ]
    head = ("name", "what it does", "weights readings", "uses free positions", "counts in a budget as")
    module = importlib.import_module("bench.calibration.gls")
    doc = (module.__doc__ or "").strip()
    return f"{_INTRODUCTION}\n{table(head, rows)}\n\n## Generalised least squares\n\n{doc}\n"
