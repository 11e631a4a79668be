"""Checks and tries a run that somebody wants to start, as a process of its own: `python -m … FOLDER`.

The findings of `bench check` first; then a dry run on simulated instruments, recorded in the wish's own folder.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.base.files import from_text, read_regular
from bench.base.yaml_files import FileMistakes
from bench.panel.launching import BENCH, Found, Wanted, WishFolder, last_words
from bench.services.errors import Refused
from bench.services.requests.planning import Check
from bench.services.until import look_ahead


def main() -> None:
    """Check and try the wish in the folder that is named on the command line."""
    wish = WishFolder(Path(sys.argv[1]))
    with wish.lock():
        found = checked(wish.wanted(), wish.path)
        if found.stage == "trying":
            wish.tell(found)
            found = tried(wish, found)
        wish.tell(found)


def checked(wanted: Wanted, folder: Path) -> Found:
    """Return the findings of `bench check`; with what the dry run would refuse, it is not tried."""
    try:
        findings = look_ahead(Check(wanted.procedure, bench=wanted.bench, runs=folder))
    except (Refused, FileMistakes) as mistakes:
        return Found("done", mistakes=str(mistakes))
    return Found("trying" if findings.can_be_tried else "done", check=findings.result.to_dict())


def tried(wish: WishFolder, found: Found) -> Found:
    """Return what a dry run came to."""
    wanted, log, result = wish.wanted(), wish.path / "dry-run.log", wish.path / "dry-run.json"
    arguments = [
        "run", wanted.procedure, f"--bench={wanted.bench}", "--dry-run", "--name=trial",
        f"--runs={wish.path / 'runs'}", f"--json={result}",
    ]  # fmt: skip
    if wanted.unit:
        arguments.append(f"--unit={wanted.unit}")
    with log.open("wb") as out:
        status = subprocess.run(  # noqa: S603 - a program of ours, arguments that were checked
            [sys.executable, *BENCH, *arguments],
            stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip
    return replace(found, stage="done", tried=status, said=last_words(log), result=_result(result))


def _result(file: Path) -> dict[str, Any] | None:
    try:
        told = from_text(read_regular(file))
    except (OSError, ValueError):
        return None
    return told if isinstance(told, dict) else None


if __name__ == "__main__":
    main()
