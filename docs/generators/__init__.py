"""The reference pages, written from the code when the site is built, so that they say what the program does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks.blind_trial.page import shown as blind_trial_shown
from docs.generators import (
    bench_files,
    commands,
    constants,
    effects,
    errors,
    estimators,
    example_certificate,
    instruments,
    measured,
    procedure_files,
    python_face,
    readings,
    results,
    rooms,
)

PAGES: Final[dict[str, Callable[[], str]]] = {
    "bench-files.md": bench_files.page,
    "procedure-files.md": procedure_files.page,
    "model-files.md": effects.model_files_page,
    "readings.md": readings.page,
    "results.md": results.page,
    "commands.md": commands.page,
    "python.md": python_face.page,
    "effects.md": effects.page,
    "instruments.md": instruments.page,
    "estimators.md": estimators.page,
    "example-certificate.md": example_certificate.page,
    "measured.md": measured.page,
    "_rooms.md": rooms.fragment,
    "_errors.md": errors.fragment,
    "_parts.md": effects.parts,
    "_constants.md": constants.fragment,
    "_blind-trial.md": blind_trial_shown,
}
"""By file name what makes it; names that begin with `_` are parts of other pages."""


def write_pages(folder: Path) -> None:
    """Write all pages into a folder; one that would not change is left as it is."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in {path.name for path in folder.glob("*.md")} - PAGES.keys():
        (folder / stale).unlink()
    for name, page in PAGES.items():
        text = page().rstrip() + "\n"
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
