"""What tests share: a command line in an empty folder."""

import io
import os
from collections.abc import Callable
from pathlib import Path

import pytest

# as `bench diagnose` has it: with many small matrices the threads would wait for one another
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in an empty folder, with nothing preset."""
    monkeypatch.chdir(tmp_path)
    for name in ("BENCH_FILE", "BENCH_RUNS"):
        monkeypatch.delenv(name, raising=False)


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
