"""The page on bench files: every key, from the models that read them."""

from __future__ import annotations

import re
from typing import Final

from pydantic import BaseModel

from bench.config.bench_file.file import BenchFile
from docs.generators.effects import ENTRY_TITLES
from docs.generators.forms import sections
from docs.generators.instruments import driver_name

_TOP: Final = "The file"
_ENDINGS: Final = ("Section", "Form", "Truth")

_INTRODUCTION: Final = """\
# Bench files

A bench file describes the instruments and their addresses, the errors of the stand, the block and the limit of
its verification. It is YAML. `bench init` writes copies of the shipped ones to start from; `bench check
PROCEDURE --bench FILE` lists all mistakes at once, each with its line. An unknown key is a mistake; every
number has its unit ([units](../units.md)). This page is made from the program when the site is built. *Default*
is the value of a key that you do not write.
"""


def page() -> str:
    """Return the page."""
    return f"{_INTRODUCTION}\n{sections(BenchFile, title)}"


def title(model: type[BaseModel]) -> str:
    """Return the heading of a section of the bench file; instruments have the name of their driver."""
    if model is BenchFile:
        return _TOP
    name = driver_name(model)
    if name:
        return f"Driver {name}"
    if model.__name__ in ENTRY_TITLES:
        return ENTRY_TITLES[model.__name__]
    words = model.__name__
    for ending in _ENDINGS:
        words = words.removesuffix(ending)
    return _spaced(words, model)


def _spaced(words: str, model: type[BaseModel]) -> str:
    """Return CamelCase as words; what is true of the simulated bench says so, since the real one has it, too."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words).capitalize()
    return f"{text}, simulated" if model.__name__.endswith("Truth") else text
