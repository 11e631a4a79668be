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
    new = new_run(
        RunRequest(
            "quick",
            "my.yaml",
            runs=Path("runs"),
            dry_run=True,
            seed=seed,
            name=name,
            unit=unit,
            model=model,
            **asked,
        )
    )
    carry_out(Run(new.folder), new.record(), Console(file=io.StringIO(), quiet=True))
    return Run(new.folder)
