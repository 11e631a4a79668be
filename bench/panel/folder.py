"""The folder of runs as strangers may name things in it: a run is a folder right in it, and nothing leads out."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from bench.panel.access.people import Refusal
from bench.run.folder import Run
from bench.run.manifest import MANIFEST

LARGEST_PAGE: Final = 64 * 2**20


class RunsFolder:
    """The runs in a folder. What is a link, or lies elsewhere, is none of them."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def runs(self) -> list[Run]:
        """Return the runs, in no order."""
        try:
            with os.scandir(self.path) as found:
                names = [one.name for one in found if one.is_dir(follow_symlinks=False)]
        except OSError:
            return []
        return [Run(self.path / name) for name in names if self._holds(name)]

    def run(self, name: str) -> Run:
        """Return the run of a name. Raises `Refusal` (404) where there is none."""
        if not self._holds(name):
            raise Refusal(404, "there is no run of that name")
        return Run(self.path / name)

    def _holds(self, name: str) -> bool:
        if not name or name.startswith(".") or "/" in name or "\\" in name:
            return False
        try:
            folder = os.lstat(f"{self.path}/{name}")
            manifest = os.lstat(f"{self.path}/{name}/{MANIFEST}")
        except (OSError, ValueError):
            return False
        return stat.S_ISDIR(folder.st_mode) and stat.S_ISREG(manifest.st_mode)


def read_page(run: Run, name: str) -> bytes:
    """Return a file of a run. Raises `Refusal` (404) where it is none, or a link."""
    try:
        descriptor = os.open(run.folder / name, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                return file.read(LARGEST_PAGE)
    except (OSError, ValueError):
        pass
    raise Refusal(404, f"{run.name} has no {name}")
