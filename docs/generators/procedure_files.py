"""The page on procedure files: verbs and keys, from the models that read them."""

from __future__ import annotations

import re
from typing import Final

from pydantic import BaseModel

from bench.config.procedure.file import VERBS, ProcedureFile
from docs.generators.forms import models_in, sections

_INTRODUCTION: Final = """\
# Procedure files

A procedure file is YAML: beside its name a list of steps, each a mapping with exactly one verb. Verbs hold
steps of their own. `bench check FILE` prints the plan that comes of it, with the time, what the operator
does, every mistake with its line, and what the readings will leave open. [Writing a
procedure](../writing-a-procedure.md) goes through one.
"""


def page() -> str:
    """Return the page."""
    return f"{_INTRODUCTION}\n{sections(ProcedureFile, title)}"


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
