"""Diagnoses of a trial kept on disk as they come, so that a trial that was interrupted goes on where it stopped.

A line of the file is JSON, compressed and written as text: what a kill cuts off is the last line, which is made
again. The first says which program made the diagnoses, and of which seed: those of another are never mixed in.
Nothing of the answers is in it but their seals.
"""

from __future__ import annotations

import base64
import hashlib
import json
import time
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from benchmarks.blind_trial.score import Outcome, Task

_ROOT: Final = Path(__file__).parents[2]
_CODE: Final = ("bench", "drivers", "benchmarks/blind_trial")
_LIBRARIES: Final = ("numpy", "scipy")


def code_sha256(root: Path = _ROOT) -> str:
    """Return a SHA-256 of what a diagnosis is made by: program, its data files, this trial, libraries."""
    whole = hashlib.sha256("".join(f"{name} {version(name)}\0" for name in _LIBRARIES).encode())
    for folder in _CODE:
        for path in sorted((root / folder).rglob("*")):
            if path.is_file() and path.suffix in {".py", ".yaml"}:
                whole.update(f"{path.relative_to(root)}\0".encode())
                whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


class Kept:
    """The diagnoses in a file, and how long they took in all; new ones are appended."""

    def __init__(self, path: Path, seed: int, code: str | None = None) -> None:
        """Open a file, or begin it. Raises `ValueError` where it is of another seed or of another program."""
        self._path = path
        self._start = time.perf_counter()
        head = {"seed": seed, "code": code or code_sha256()}
        self._done: dict[tuple[str, int], dict[str, Any]] = {}
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1] if text else _written(head)
        try:
            lines = [_read(line) for line in whole.splitlines()]
            same = lines[0] == head
        except (ValueError, zlib.error, IndexError) as error:
            raise ValueError(f"{path}: holds no diagnoses of a trial; name another file") from error
        if not same:
            what = "seed" if lines[0].get("seed") != seed else "program"
            raise ValueError(f"{path}: its diagnoses are of another {what}; name another file, or remove it")
        if whole != text:
            path.write_bytes(whole)
        ended: dict[int, float] = {}
        for line in lines[1:]:
            self._done[line["row"], line["index"]] = line
            ended[line["call"]] = line["elapsed_s"]
        self._before_s = sum(ended.values())
        self._call = len(ended)

    @property
    def seconds(self) -> float:
        """How long the trial took so far, all its parts together, s."""
        return self._before_s + time.perf_counter() - self._start

    def outcome(self, task: Task) -> Outcome | None:
        """Return what was kept of a task; None where it is still to be done."""
        line = self._done.get((task.row.key, task.index))
        return None if line is None else Outcome(task, line["seal"], line["diagnosis"])

    def keep(self, outcome: Outcome) -> None:
        """Append an outcome; one that failed is tried again another time."""
        if outcome.error:
            return
        line = {
            "row": outcome.task.row.key,
            "index": outcome.task.index,
            "seal": outcome.seal,
            "diagnosis": outcome.diagnosis,
            "call": self._call,
            "elapsed_s": round(time.perf_counter() - self._start, 1),
        }
        with self._path.open("ab") as file:
            file.write(_written(line))


def _written(line: dict[str, Any]) -> bytes:
    return base64.b64encode(zlib.compress(json.dumps(line).encode())) + b"\n"


def _read(line: bytes) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(zlib.decompress(base64.b64decode(line)))
    return read
