"""What the benchmarks of certificates share: runs to be certified, and the files of a laboratory, in a folder."""

from __future__ import annotations

from pathlib import Path

from bench.base.yaml_files import load_document
from bench.certificate.life import Desk
from bench.config.shipped import CERTIFICATE, shipped_folder
from benchmarks.campaign import command
from drivers.clock import utc_now

BY = "A. Example"


def done(*words: object) -> None:
    """Carry out a command of the bench; end the program where it cannot be done."""
    said = command(*words)
    if said.status == 2:
        raise SystemExit(f"bench {' '.join(map(str, words))}: {said.err}")


def prepare(folder: Path, count: int) -> tuple[Desk, list[str]]:
    """Make a dry run of the procedure `quick`, and import its readings until there are `count` runs.

    Each has a record, and so a certificate, of its own. Return what certificates are issued with, and their names.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs, readings = folder / "runs", folder / "readings.csv"
    names = [f"unit-{n:04}" for n in range(count)]
    if not (runs / "source").is_dir():
        done("run", "quick", "--dry-run", "--seed", "1", "--name", "source", "--runs", runs)
        done("export", "source", "--csv", readings, "--runs", runs)
    for name in names:
        if not (runs / name).is_dir():
            done("import", readings, "--name", name, "--runs", runs)
    for name in ("laboratory", "order"):
        text = (shipped_folder(CERTIFICATE) / f"{name}.yaml").read_text(encoding="utf-8")
        (folder / f"{name}.yaml").write_text(text.replace("2026-11-16", "2026-01-01"), encoding="utf-8")
    laboratory, order = (load_document(folder / f"{name}.yaml") for name in ("laboratory", "order"))
    return Desk(runs, laboratory, order, BY, utc_now), names
