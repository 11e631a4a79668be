"""A folder of runs for batches: copies of one record of an earlier version, with or without stored results."""

import json
import shutil
from functools import cache
from pathlib import Path
from typing import Any

from bench.base.files import to_text
from bench.services.calibration import calibration_of, verification_of
from bench.services.source import Request, load_sources

RECORD = Path(__file__).parents[1] / "data" / "records" / "finished"


def runs_in(folder: Path, count: int, *, stored: bool = True) -> list[Path]:
    """Make the runs `run-1` … in a folder; with `stored`, they have results computed by this program."""
    results = results_of(RECORD) if stored else {}
    made = []
    for number in range(1, count + 1):
        run = folder / f"run-{number}"
        shutil.copytree(RECORD, run)
        for name, told in results.items():
            (run / name).write_text(to_text(told), encoding="utf-8")
        made.append(run)
    return made


@cache
def results_of(run: Path) -> dict[str, Any]:
    """Return the results of calibrating and verifying a run, by file name."""
    (source,) = load_sources(Request([str(run)], run.parent))
    found = calibration_of(source)
    return {"calibrate.json": found.to_dict(), "verify.json": verification_of(source, found).to_dict()}


def edited(file: Path, edit: Any) -> None:
    """Apply `edit` to the data of a JSON file, in place."""
    told = json.loads(file.read_text(encoding="utf-8"))
    edit(told)
    file.write_text(to_text(told), encoding="utf-8")
