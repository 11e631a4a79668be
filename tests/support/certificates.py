"""A laboratory, an order and a recorded run for certificates in tests."""

import shutil
from pathlib import Path

from bench.validation.records import UNITS as ORDER
from bench.validation.records import write_files

__all__ = ["ORDER", "RECORDED", "copy_run", "write_files"]

RECORDED = Path(__file__).parents[1] / "data" / "records" / "finished"


def copy_run(runs: Path, name: str = "finished") -> Path:
    """Copy the recorded run into the folder `runs` as `name`; return the copy's folder."""
    return shutil.copytree(RECORDED, runs / name)
