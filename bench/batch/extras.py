"""Packages that come with extras, imported where a batch needs them; one that is missing is named."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

from bench.api.errors import Refused

MISSING = "{} need the package {}: pip install 'triaxial-bench[{}]'"


def pyarrow() -> ModuleType:
    """Return the package that writes and reads columns. Raises `Refused` where it is missing."""
    return _needed("pyarrow", "the tables of a batch", "catalogue")


def parquet() -> Any:
    """Return its part for Parquet files. Raises `Refused` where it is missing."""
    pyarrow()
    return import_module("pyarrow.parquet")


def duckdb() -> ModuleType:
    """Return the package that is asked about columns. Raises `Refused` where it is missing."""
    return _needed("duckdb", "questions about the tables of a batch", "catalogue")


def distributed() -> ModuleType:
    """Return the package that speaks with a cluster. Raises `Refused` where it is missing."""
    return _needed("distributed", "batches on a cluster", "cluster")


def _needed(package: str, what: str, extra: str) -> ModuleType:
    try:
        return import_module(package)
    except ImportError:
        raise Refused(MISSING.format(what, package, extra)) from None
