"""Try the program on several Pythons with the lowest and the highest versions of its dependencies.

    python -m release.matrix --tests tests/calibration tests/readings

For each Python and set of versions: a fresh environment, the dependencies as `uv` resolves them, `bench run
paper --dry-run`, and the tests. A Python that is missing is said, not passed over.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

UV: Final = (sys.executable, "-m", "uv")
ROOT: Final = Path(__file__).parents[1]
PYTHONS: Final = ("3.11", "3.12", "3.13", "3.14")
SETS: Final = ("lowest-direct", "highest")
TESTS: Final = (
    "tests/calibration",
    "tests/readings",
    "tests/config",
    "tests/exchange",
    "tests/validation/test_reference.py",
)


def python_of(version: str) -> str | None:
    """Return the interpreter of a version that is on this computer; None without one."""
    pyenv = sorted(
        Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob(f"versions/{version}.*/bin/python")
    )
    if pyenv:
        return str(pyenv[-1])
    command = [*UV, "python", "find", "--no-python-downloads", version]
    done = subprocess.run(command, capture_output=True, check=False, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


def tried(python: str, versions: str, tests: list[str], place: Path) -> str:
    """Return "passed", or the step that failed with the end of what it said."""
    here = place / "bin" / "python"
    environment = {**os.environ, "UV_LINK_MODE": "copy", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ""}
    pins = place / "pins.txt"
    compile_ = [*UV, "pip", "compile", "-q", "pyproject.toml", "--extra", "test", "--resolution", versions]
    steps = (
        ("environment", [*UV, "venv", "-q", "--python", python, str(place)]),
        ("versions", [*compile_, "--only-binary", ":all:", "--python", str(here), "-o", str(pins)]),
        ("installation", [*UV, "pip", "install", "-q", "--python", str(here), "-r", str(pins)]),
        ("program", [*UV, "pip", "install", "-q", "--no-deps", "--python", str(here), "."]),
        (
            "dry run",
            [str(place / "bin" / "bench"), "run", "paper", "--dry-run", "--runs", str(place / "runs")],
        ),
        ("tests", [str(here), "-m", "pytest", "-n", "0", "-q", "-m", "not slow and not browser", *tests]),
    )
    for name, command in steps:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, check=False, text=True)
        if done.returncode:
            return f"{name} failed:\n{(done.stdout + done.stderr)[-2000:]}"
    return "passed"


def main() -> int:
    """Try every Python with both sets of versions; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pythons", nargs="+", default=PYTHONS)
    parser.add_argument("--sets", nargs="+", default=SETS, choices=SETS)
    parser.add_argument("--tests", nargs="+", default=TESTS)
    asked = parser.parse_args()
    failed = False
    for version in asked.pythons:
        python = python_of(version)
        if python is None:
            print(f"Python {version}: not on this computer, not tried", flush=True)
            continue
        for versions in asked.sets:
            with tempfile.TemporaryDirectory(prefix="bench-matrix-") as place:
                began_s = time.monotonic()
                said = tried(python, versions, list(asked.tests), Path(place) / "env")
                print(
                    f"Python {version}, {versions}: {said} ({time.monotonic() - began_s:.0f} s)", flush=True
                )
                failed |= said != "passed"
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
