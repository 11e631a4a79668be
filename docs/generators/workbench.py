"""A folder with dry runs and the pages that the program writes of them: what screenshots and sessions show."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

BENT: Final = """\
model_file: 1
name: a head out of centre
effects:
  - name: head_eccentricity
    parameters: {sine: 40 arcsec}
"""
"""The fault of the tutorial's bench."""
SQUARE: Final = """\
model_file: 1
name: a square in the output of y
effects:
  - name: quadratic_nonlinearity
    channels: [y]
    parameters: {K2: 150 ug/g^2}
"""
"""A fault that the paper's procedure cannot tell from another."""
OFF: Final = """\
model_file: 1
name: the meters are off
effects:
  - name: voltmeter_offset
    parameters: {offset: 600 uV}
"""
CHECK_BLOCK: Final = "check_block:\n  serial: CHECK-1\n  baseline: 3\n"
_CHECK: Final = "run quick --dry-run --bench my.yaml --unit CHECK-1 --runs checks"
COMMANDS: Final = (
    "run paper --dry-run --name first --seed 1",
    "calibrate first",
    "run paper --dry-run --name bent --seed 2 --model bent.yaml",
    "diagnose bent",
    "run paper --dry-run --name tied --seed 2 --model square.yaml",
    "diagnose tied",
    *(f"{_CHECK} --seed {seed} --name day-{seed}" for seed in (11, 12, 13, 14, 15, 16)),
    f"{_CHECK} --seed 17 --name day-17 --model off.yaml",
    "chart checks --page chart.html",
)


@contextlib.contextmanager
def standing_in(folder: Path) -> Iterator[None]:
    """Work in a folder, as somebody who follows the pages does."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def told(command: str) -> str:
    """Carry out a command of the program; return what it prints. Raises `RuntimeError` where it cannot be done."""
    from bench.cli.app import main

    out, status = io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main(command.split())
        except SystemExit as ended:
            status = int(ended.code or 0)
    if status > 1:
        raise RuntimeError(f"bench {command}: {out.getvalue()}")
    return out.getvalue()


class Workbench:
    """The folder, for as long as the build lasts, and what each command printed there."""

    def __init__(self) -> None:
        """Carry out the commands."""
        from bench.config.shipped import CONFIG, shipped_folder

        self._kept = tempfile.TemporaryDirectory()
        self.folder = Path(self._kept.name)
        paper = (shipped_folder(CONFIG) / "paper-stand.yaml").read_text(encoding="utf-8")
        for name, text in (("bent", BENT), ("square", SQUARE), ("off", OFF), ("my", paper + CHECK_BLOCK)):
            (self.folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        with standing_in(self.folder):
            self.printed = {command: told(command) for command in COMMANDS}


workbench = cache(Workbench)
"""Return the one workbench of this build."""
