"""Completions that a shell offers at Tab for names of runs, readings files, procedures and bench files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import typer


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names in the folder of runs that begin with `incomplete`."""
    from bench.run.events import MANIFEST

    folder = Path(ctx.params.get("runs") or os.environ.get("BENCH_RUNS") or "runs")
    return _beginning(incomplete, (file.parent.name for file in folder.glob(f"*/{MANIFEST}")))


def sources(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the matching runs, and the matching readings files in the folder that `incomplete` names."""
    return [*runs(ctx, incomplete), *_files(incomplete, ".csv")]


def procedures(incomplete: str) -> list[str]:
    """Return the matching shipped procedures, YAML files and folders."""
    from bench.config.shipped import PROCEDURES

    return [*_shipped(incomplete, PROCEDURES), *_files(incomplete, ".yaml")]


def bench_files(incomplete: str) -> list[str]:
    """Return the matching shipped bench files, YAML files and folders."""
    from bench.config.shipped import CONFIG

    return [*_shipped(incomplete, CONFIG), *_files(incomplete, ".yaml")]


def _shipped(incomplete: str, kind: str) -> list[str]:
    from bench.config.shipped import shipped_folder

    return _beginning(incomplete, (file.stem for file in shipped_folder(kind).glob("*.yaml")))


def _files(incomplete: str, suffix: str) -> list[str]:
    """Return the matching files with a suffix, and the matching folders, as a user would type them."""
    typed, _, begun = incomplete.rpartition("/")
    lead = f"{typed}/" if "/" in incomplete else ""
    try:
        found = [*Path(lead or ".").iterdir()]
    except OSError:
        return []
    names = (f"{p.name}/" if p.is_dir() else p.name for p in found if p.is_dir() or p.suffix == suffix)
    return [f"{lead}{name}" for name in _beginning(begun, names) if begun or not name.startswith(".")]


def _beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    return sorted(name for name in names if name.startswith(incomplete))
