"""Which procedures and bench files may be chosen: those shipped and those of the working folder; no other path."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from bench.base.regular import open_regular
from bench.files.shipped import CONFIG, PROCEDURES, shipped_folder
from bench.panel.access.people import Refusal
from bench.panel.folder import RunsFolder

MARKS: Final = {
    PROCEDURES: re.compile(rb"^procedure\s*:", re.MULTILINE),
    CONFIG: re.compile(rb"^instruments\s*:", re.MULTILINE),
}
"""By what a file of the working folder is known as a procedure or a bench file."""

NEXT: Final = "diagnose-next.yaml"
"""What the diagnosis of a run proposes to measure, in the run's folder."""
OF_RUN: Final = "next:"
BEGINNING: Final = 65_536


def choices(kind: str, working: Path | None = None) -> dict[str, Path]:
    """Return what may be chosen of a kind (`PROCEDURES` or `CONFIG`), by name.

    A copy in the working folder is taken for the shipped file of its name, as commands do.
    """
    here = working or Path()
    found = {file.stem: file for file in _yaml(shipped_folder(kind))}
    found |= {file.stem: file for file in _yaml(here / kind)}
    found |= {file.name: file for file in _yaml(here) if MARKS[kind].search(_beginning(file))}
    named = os.environ.get("BENCH_FILE", "")
    if kind == CONFIG and named and Path(named).is_file():
        found[named] = Path(named)
    return dict(sorted(found.items()))


def chosen_procedure(name: str, runs: RunsFolder) -> Path:
    """Return the procedure of a name, or what a run's diagnosis proposes (`next:RUN`). Raises `Refusal`."""
    if name.startswith(OF_RUN):
        run = runs.run(name.removeprefix(OF_RUN))
        file = run.folder / NEXT
        if file.is_symlink() or not file.is_file():
            raise Refusal(404, f"{run.name}: its diagnosis proposes no measurement")
        return file
    return _chosen(PROCEDURES, name, "procedure")


def chosen_bench(name: str, runs: RunsFolder) -> Path:
    """Return the bench file of a name, or that of the run whose diagnosis is followed. Raises `Refusal`."""
    if name.startswith(OF_RUN):
        run = runs.run(name.removeprefix(OF_RUN))
        original = Path(str(run.manifest.get("bench", "")))
        if original in choices(CONFIG).values() or original.name in choices(CONFIG):
            return original
        raise Refusal(404, f"{run.name}: its bench file is not at hand any more; choose one")
    return _chosen(CONFIG, name, "bench file")


def _chosen(kind: str, name: str, called: str) -> Path:
    found = choices(kind).get(name)
    if found is None:
        raise Refusal(400, f"there is no {called} of that name to choose")
    return found


def _yaml(folder: Path) -> list[Path]:
    try:
        return sorted(file for file in folder.iterdir() if file.suffix == ".yaml" and file.is_file())
    except OSError:
        return []


def _beginning(file: Path) -> bytes:
    try:
        with open_regular(file) as stream:
            return stream.read(BEGINNING)
    except OSError:
        return b""
