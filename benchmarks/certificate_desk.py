"""What the benchmarks of certificates share: runs to be certified, and the files of a laboratory, in a folder."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

from bench.base.yaml_files import load_document
from bench.certificate.life import Desk
from bench.cli.app import main
from bench.config.shipped import CERTIFICATE, shipped_folder
from drivers.clock import utc_now

BY = "A. Example"


def command(*words: str | Path) -> int:
    """Carry out a command of the bench without its output; return its exit status."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 2
    if status == 2:
        raise SystemExit(f"bench {' '.join(map(str, words))}: {err.getvalue()}")
    return status


def prepare(folder: Path, count: int) -> tuple[Desk, list[str]]:
    """Make a dry run of the procedure `quick`, and import its readings until there are `count` runs.

    Each has a record, and so a certificate, of its own. Return what certificates are issued with, and their names.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs, readings = folder / "runs", folder / "readings.csv"
    names = [f"unit-{n:04}" for n in range(count)]
    if not (runs / "source").is_dir():
        command("run", "quick", "--dry-run", "--seed", "1", "--name", "source", "--runs", runs)
        command("export", "source", "--csv", readings, "--runs", runs)
    for name in names:
        if not (runs / name).is_dir():
            command("import", readings, "--name", name, "--runs", runs)
    for name in ("laboratory", "order"):
        text = (shipped_folder(CERTIFICATE) / f"{name}.yaml").read_text(encoding="utf-8")
        (folder / f"{name}.yaml").write_text(text.replace("2026-11-16", "2026-01-01"), encoding="utf-8")
    laboratory, order = (load_document(folder / f"{name}.yaml") for name in ("laboratory", "order"))
    return Desk(runs, laboratory, order, BY, utc_now), names
