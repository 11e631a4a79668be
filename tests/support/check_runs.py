"""Dry runs of the check block of a bench, in a folder `runs` beside its bench file `my.yaml`."""

import io
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.config.shipped import find_bench
from bench.run.folder import Run
from bench.services.execution import carry_out, new_run
from bench.services.requests.measuring import RunRequest

SECTION = "\ncheck_block:\n  serial: CHECK-1\n  rule: refuse\n  baseline: 3\n"


def write_bench() -> None:
    """Write the bench file, with a check block."""
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    Path("my.yaml").write_text(text + SECTION, encoding="utf-8")


def measured(
    name: str, seed: int, *, unit: str | None = "CHECK-1", model: Path | None = None, **asked: Any
) -> Run:
    """Carry out a dry run of the check block or another `unit`; return the run."""
    return dry_run("quick", "my.yaml", Path("runs"), name, seed, unit=unit, model=model, **asked)


def dry_run(procedure: str, bench: str, runs: Path, name: str, seed: int, **asked: Any) -> Run:
    """Carry out a dry run silently; return the run."""
    new = new_run(RunRequest(procedure, bench, runs=runs, dry_run=True, seed=seed, name=name, **asked))
    carry_out(Run(new.folder), new.record(), Console(file=io.StringIO(), quiet=True))
    return Run(new.folder)
