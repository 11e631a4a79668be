"""The self-tests in exported files, run as a reader of the file would run them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def own_test(path: Path) -> int:
    """Run the test in an exported file as its text says; return the exit status."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        data = json.loads(text)
        lines = data["python"] if "python" in data else data["check"]["python"]
    else:
        lines = [line[8:] for line in text.splitlines() if line.startswith("# test: ")]
    assert len(lines) == 3
    done = subprocess.run([sys.executable, "-c", "\n".join(lines), path], capture_output=True, check=False)  # noqa: S603
    return done.returncode


def compiled_test(folder: Path, name: str, text: str) -> int:
    """Compile a header strictly; return the result of its `<name>_self_test()`."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here to compile the header with")
    (folder / f"{name}.h").write_text(text)
    (folder / "main.c").write_text(f'#include "{name}.h"\nint main(void) {{ return {name}_self_test(); }}\n')
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wno-unused-function", "-O1"]
    subprocess.run([compiler, *strict, "-o", folder / "main", folder / "main.c"], check=True)  # noqa: S603
    return subprocess.run([folder / "main"], check=False).returncode  # noqa: S603


def with_a_digit_changed(text: str, at: int) -> str:
    """Return the text with another seventh significant digit of the number that begins at `at`."""
    digits = [k for k in range(at, min(at + 24, len(text))) if text[k].isdigit()]
    first = next(k for k in digits if text[k] != "0")
    k = [d for d in digits if d >= first][6]
    return text[:k] + str((int(text[k]) + 1) % 10) + text[k + 1 :]
