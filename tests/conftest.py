"""What tests share: a command line in an empty folder."""

import contextlib
import faulthandler
import gc
import io
import itertools
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.support import thresholds

# as `bench diagnose` has it: with many small matrices the threads would wait for one another
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


TESTS = Path(__file__).parent
HANGS_S = 300.0
"""After so long in one test, or a few, all threads are shown: a test that hangs shows where."""


class Session:
    """What holds from test to test: when the watch for a hang was set, whether figures are drawn, numbers."""

    stderr = 2
    watched_s = -HANGS_S
    draw: Callable[..., str] | None = None
    folders = itertools.count()


def pytest_xdist_auto_num_workers() -> int:
    """Return the workers of `-n auto`: one beside those of the cores, since tests on wires and processes wait.

    Each worker imports and collects all tests, so that more of them cost more than they gain.
    """
    return 1 + (os.cpu_count() or 1)


def pytest_configure(config: pytest.Config) -> None:
    """Keep the session's standard error; let no speed of the machine decide; collect without garbage passes.

    Workers of the whole suite begin their collection at different folders: each compiles its share of the tests,
    and reads the bytecode of the others.
    """
    Session.stderr = os.dup(2)
    settings.register_profile("any speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("any speed")
    gc.disable()
    worker: dict[str, Any] = getattr(config, "workerinput", {})
    if worker and config.args == config.getini("testpaths"):
        folders = sorted(str(folder) for folder in TESTS.iterdir() if any(folder.rglob("test_*.py")))
        first = len(folders) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
        config.args = [*folders[first:], *folders[:first]]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the slowest files first, so that at the end no worker is left alone with one of them.

    A slow test counts 1 s of processor time, `slow(8)` counts 8 s.
    """
    slow = Counter[Path]()
    for item in items:
        if mark := item.get_closest_marker("slow"):
            slow[item.path] += mark.args[0] if mark.args else 1
    items.sort(key=lambda item: (-slow[item.path], item.path))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Set the watch for a hang, and say whether this test and its fixtures draw figures.

    The figures of pages are left empty: they cost more than all else. Tests marked `figures` draw them.
    To set the watch for each test would cost more than most tests do.
    """
    if time.monotonic() - Session.watched_s > HANGS_S / 10.0:
        Session.watched_s = time.monotonic()
        faulthandler.dump_traceback_later(HANGS_S, file=Session.stderr)
    from bench.results import plots

    # beneath what other modules import by name: one imported now would keep the empty one for ever
    Session.draw = Session.draw or plots._written
    drawn = item.get_closest_marker("figures") is not None
    plots._written = Session.draw if drawn else (lambda name, inches, draw: EMPTY_FIGURE)


@pytest.fixture(autouse=True, scope="session")
def cache_of_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the user's cache out of it: tests run side by side, with the same addresses of instruments.

    Thresholds of diagnoses are in it from the start.
    """
    from bench.base.files import cache_folder

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        base = tmp_path_factory.getbasetemp()
        shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        patch.setenv("MPLCONFIGDIR", str(shared / "matplotlib"))  # one list of fonts for all processes
        folder = cache_folder("thresholds")
        thresholds.unpack(folder, base)
        yield
        thresholds.keep(folder)


@pytest.fixture(autouse=True, scope="session")
def no_power_cut() -> Iterator[None]:
    """Leave out the wait for the disk, which costs much of a dry run: no test cuts the computer's power.

    What a program wrote before it was killed, the system keeps without it. A closed file is an error still.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: os.fstat(file) and None)
        yield


@pytest.fixture
def tmp_path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder for one test; pytest itself reads the names of all earlier ones to find a free name."""
    name = re.sub(r"\W", "_", request.node.name)[:30]
    return tmp_path_factory.mktemp(f"{name}_{next(Session.folders)}", numbered=False)


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in an empty folder, with nothing preset."""
    monkeypatch.chdir(tmp_path)
    for name in ("BENCH_FILE", "BENCH_RUNS"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="session")
def dry_run_of_paper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a dry run of the paper's procedure, seed 1; not to be written to."""
    from bench.cli.app import main

    folder = tmp_path_factory.mktemp("shared")
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit):
        main(["run", "paper", "--dry-run", "--name", "run", "--runs", "runs"])
    return folder / "runs" / "run"


@pytest.fixture
def paper_run(empty_folder: None, dry_run_of_paper: Path) -> None:
    """A dry run of the paper's procedure as `runs/run` of the empty folder: a copy of one that many share."""
    shutil.copytree(dry_run_of_paper, "runs/run")


EMPTY_FIGURE = '<svg viewBox="0 0 1 1"></svg>'


@pytest.fixture
def bench(
    capsys: pytest.CaptureFixture[str], empty_folder: None
) -> Callable[..., tuple[int | str | None, str, str]]:
    """Run a command; return (exit status, standard output, standard error)."""

    def call(*arguments: object, stdin: str = "") -> tuple[int | str | None, str, str]:
        from bench.cli.app import main

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.stdin", io.StringIO(stdin))
            with pytest.raises(SystemExit) as exit_:
                main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return exit_.value.code, out, err

    return call


def pytest_collection_finish() -> None:
    """Leave the tests and modules out of every later search for garbage, and search as rarely as `bench` does."""
    gc.set_threshold(50_000, 20, 20)
    gc.enable()
    gc.freeze()
