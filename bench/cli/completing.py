"""What a shell offers at Tab for the arguments that are names: runs, readings files, procedures, bench files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import typer


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the runs in the folder of runs whose names begin so."""
    from bench.run.events import MANIFEST

    folder = Path(ctx.params.get("runs") or os.environ.get("BENCH_RUNS") or "runs")
    return _beginning(incomplete, (file.parent.name for file in folder.glob(f"*/{MANIFEST}")))


def sources(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the runs, and the readings files of the folder that was begun to be typed."""
    return [*runs(ctx, incomplete), *_files(incomplete, ".csv")]


def procedures(incomplete: str) -> list[str]:
    """Return the shipped procedures, and the files that may be one."""
    from bench.config.shipped import PROCEDURES

    return [*_shipped(incomplete, PROCEDURES), *_files(incomplete, ".yaml")]


def bench_files(incomplete: str) -> list[str]:
    """Return the shipped bench files, and the files that may be one."""
    from bench.config.shipped import CONFIG

    return [*_shipped(incomplete, CONFIG), *_files(incomplete, ".yaml")]


def _shipped(incomplete: str, kind: str) -> list[str]:
    from bench.config.shipped import shipped_folder

    return _beginning(incomplete, (file.stem for file in shipped_folder(kind).glob("*.yaml")))


def _files(incomplete: str, suffix: str) -> list[str]:
    """Return the files with a suffix, and the folders, as they would be typed."""
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
