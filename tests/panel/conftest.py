"""A folder of runs, and a person who is signed in to the panel over it."""

import shutil
from pathlib import Path

import pytest

from tests.support.panel_client import Browser


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of runs beside the working folder, with nothing preset."""
    for name in ("work", "runs"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.delenv("BENCH_FILE", raising=False)
    return tmp_path / "runs"


@pytest.fixture
def judged(runs: Path, dry_run_of_paper: Path) -> Path:
    """A finished dry run with its results."""
    return shutil.copytree(dry_run_of_paper, runs / "run")


@pytest.fixture
def anna(runs: Path) -> Browser:
    """An operator."""
    return Browser(runs, "anna")
