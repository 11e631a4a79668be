"""The families of checks, in the order of the page."""

from __future__ import annotations

from importlib import import_module
from typing import Final

from bench.validation.registry import TABLE, Check

MODULES: Final = (
    "reference",
    "gum",
    "statistics",
    "instruments",
    "records",
    "certificates",
    "machine",
    "changes",
)


def every() -> list[Check]:
    """Return all checks, after importing the modules that define them."""
    for name in MODULES:
        import_module(f"bench.validation.{name}")
    places = [f"bench.validation.{name}" for name in MODULES]
    return sorted(TABLE, key=lambda one: places.index(one.act.__module__))
