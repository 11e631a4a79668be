"""Laboratory, order and a recorded run, of which certificates are made in tests."""

import shutil
from pathlib import Path
from typing import Any

import yaml

from bench.config.shipped import CERTIFICATE, shipped_folder

RECORDED = Path(__file__).parents[1] / "data" / "records" / "finished"
ORDER = {"units": [{"received": "2026-11-16", "condition": "undamaged", "state": "as found"}]}


def write_files(folder: Path, laboratory: Any = None, order: Any = None) -> tuple[Path, Path]:
    """Write the shipped laboratory and order files into a folder, with other sections; return both."""
    written = []
    for name, sections in (("laboratory", laboratory), ("order", order)):
        data = yaml.safe_load((shipped_folder(CERTIFICATE) / f"{name}.yaml").read_text(encoding="utf-8"))
        data = {**data, **(sections or {})}
        for key in [key for key, value in data.items() if value is None]:
            del data[key]
        written.append(folder / f"{name}.yaml")
        written[-1].write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    return written[0], written[1]


def copy_run(runs: Path, name: str = "finished") -> Path:
    """Copy the recorded run into a folder of runs; return its folder."""
    return shutil.copytree(RECORDED, runs / name)
