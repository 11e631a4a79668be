"""Laboratory, order and a recorded run, of which certificates are made in tests."""

import shutil
from pathlib import Path

from bench.validation.certificates import UNITS as ORDER
from bench.validation.certificates import write_files

__all__ = ["ORDER", "RECORDED", "copy_run", "write_files"]

RECORDED = Path(__file__).parents[1] / "data" / "records" / "finished"


def copy_run(runs: Path, name: str = "finished") -> Path:
    """Copy the recorded run into a folder of runs; return its folder."""
    return shutil.copytree(RECORDED, runs / name)
