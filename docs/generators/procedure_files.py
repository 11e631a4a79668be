"""The page on procedure files: verbs and keys, from the models that read them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from pydantic import BaseModel

from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check, operator_actions
from bench.config.procedure.file import VERBS, ProcedureFile
from bench.config.procedure.load import load_procedure
from bench.config.shipped import PROCEDURES, find_bench, shipped_folder
from bench.run.sentences import duration
from docs.generators.forms import models_in, sections
from docs.generators.markdown import code, table

_INTRODUCTION: Final = """\
# Procedure files

A procedure file is YAML: a name, and a list of steps. Each step is a mapping with exactly one verb; some verbs
contain further steps. `bench check FILE` prints the resulting plan, its time, what the operator does, every
mistake with its line, and what the readings will leave open. [Writing a procedure](../writing-a-procedure.md)
explains an example.
"""

_SHIPPED: Final = """\
## Shipped procedures

The expected times include the warm-up and the time that the procedure allows for the operator. They are for the
bench file named; `bench check PROCEDURE --bench FILE` states the time on your bench. To shorten a procedure, see
[Running until u is small enough](../run-until.md) and [Which points are
enough](../test-points.md#which-points-are-enough). `bench init` copies all of them; the comment at
the top of each file says what it separates.
"""
_BENCHES: Final = ("paper-stand", "bench-stand")
"""A procedure is timed on the first of these shipped bench files on which it can be carried out."""


def page() -> str:
    """Return the page."""
    head = ("name", "purpose", "mountings", "readings", "operator actions", "expected time", "bench file")
    return f"{_INTRODUCTION}\n{_SHIPPED}\n{table(head, _shipped())}\n\n{sections(ProcedureFile, title)}"


def _shipped() -> Iterator[tuple[str, ...]]:
    """Yield the row of each shipped procedure. Raises `ValueError` for one that no bench file suits."""
    benches = [load_bench(find_bench(name)) for name in _BENCHES]
    for path in sorted(shipped_folder(PROCEDURES).glob("*.yaml")):
        procedure = load_procedure(path)
        plan = procedure.expand()
        counts = plan.counts()
        bench = next((one for one in benches if not check(plan, one)), None)
        if bench is None:
            raise ValueError(f"{path}: no bench file of {_BENCHES} suits it")
        time_s = plan.expected_duration_s(bench.line_frequency, bench.unit_under_test.supply)
        actions = operator_actions(plan, bench)
        numbers = (str(counts["mount"]), str(counts["read"]), str(actions))
        yield code(path.stem), procedure.title, *numbers, duration(time_s), code(bench.name)


def _verbs() -> dict[type[BaseModel], str]:
    """Return by its model the verb that it is; one model stands for the two kinds of settling."""
    (entry,) = (m for m in _models_of(ProcedureFile, "steps"))
    named: dict[type[BaseModel], str] = {}
    for verb in VERBS:
        for model in _models_of(entry, verb):
            named.setdefault(model, verb)
    return named


def _models_of(model: type[BaseModel], key: str) -> list[type[BaseModel]]:
    return list(models_in(model.model_fields[key].annotation))


def title(model: type[BaseModel]) -> str:
    """Return the heading of a section of the procedure file."""
    if model is ProcedureFile:
        return "The file"
    name = model.__name__
    verb = _verbs().get(model)
    if verb and name.endswith("Verb"):
        return f"Verb {verb}"
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", re.sub(r"(Section|Form|Verb)$", "", name))
    return words.capitalize()
