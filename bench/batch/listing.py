"""Which runs a batch is over: those that a query of the catalogue finds, or that lie where patterns say."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bench.api.errors import Refused
from bench.batch.stored import CALIBRATE_FILE, DIAGNOSE_FILE, VERIFY_FILE
from bench.run.folder import BENCH, EFFECTS, IMPORTED, PLAN
from bench.run.manifest import EVENTS, MANIFEST, sha256

_QUESTION: Final = re.compile(r"[a-z][a-z_]*\s*(=|!=|>=|<=|>|<)")
_READ: Final = (
    MANIFEST, EVENTS, BENCH, PLAN, IMPORTED, EFFECTS, CALIBRATE_FILE, VERIFY_FILE, DIAGNOSE_FILE,
)  # fmt: skip
"""Files of a run that a row is made from."""


@dataclass(frozen=True)
class Listed:
    """Runs (absolute paths, sorted, each once), and what was found where they lie and is none."""

    runs: tuple[str, ...]
    no_runs: tuple[str, ...] = ()


def list_runs(over: Sequence[str], runs: Path, catalogue: str | None = None) -> Listed:
    """Return the runs that `over` names: words of a query (`unit=Q-17`, all of which hold), or patterns.

    A pattern is that of a shell (`*`, `?`, `[…]`, `**` for folders in folders), in the working folder or else in
    the folder `runs`; a folder that is no run stands for the runs in it. Raises `Refused` where nothing is found.
    """
    words = [word for given in over for word in _words(given)]
    asked = [word for word in words if is_question(word)]
    if not any(words):
        raise Refused("--over: say which runs, such as --over 'runs/*' or --over unit=Q-17")
    if asked and len(asked) < len(words):
        other = next(word for word in words if not is_question(word))
        raise Refused(f"--over {other}: a pattern beside a query ({asked[0]}); give the one or the other")
    found = _asked(asked, catalogue) if asked else _there(words, runs)
    if not found.runs:
        kind = "the catalogue has no run of which this holds" if asked else "no run lies there"
        raise Refused(f"--over {' '.join(words)}: {kind}")
    return found


def _words(given: str) -> list[str]:
    """Return the words of a query in one text, where each is one; else the text, which may hold spaces."""
    words = given.split()
    return words if len(words) > 1 and all(map(is_question, words)) else [given]


def is_question(word: str) -> bool:
    """Whether a word is of a query (`unit=Q-17`) and no pattern of paths."""
    return _QUESTION.match(word) is not None and not Path(word).exists()


def fingerprint(run: str) -> str:
    """Return by what a run is known to be as it was: size and time of each file that a row is made from."""
    told = []
    for name in _READ:
        try:
            is_ = (Path(run) / name).stat()
        except OSError:
            continue
        told.append(f"{name} {is_.st_size} {is_.st_mtime_ns}")
    return sha256("\n".join(told).encode())[:32]


def _asked(words: Sequence[str], catalogue: str | None) -> Listed:
    from bench.catalogue.questions import run_folders
    from bench.catalogue.store import open_catalogue

    with open_catalogue(catalogue, existing=True) as opened:
        return _sorted(run_folders(opened, words), ())


def _there(patterns: Iterable[str], runs: Path) -> Listed:
    found: list[Path] = []
    others: list[Path] = []
    for pattern in patterns:
        for path in _matches(pattern, runs):
            if (path / MANIFEST).is_file():
                found.append(path)
                continue
            inside = [one for one in path.iterdir() if (one / MANIFEST).is_file()] if path.is_dir() else []
            found += inside
            if path.is_dir() and not inside:
                others.append(path)
    return _sorted(found, others)


def _matches(pattern: str, runs: Path) -> list[Path]:
    if not glob.has_magic(pattern):
        places = [Path(pattern), runs / pattern]
        return [place for place in places if place.exists()][:1]
    return [Path(path) for path in _globbed(pattern) or _globbed(str(runs / pattern))]


def _globbed(pattern: str) -> list[str]:
    """Return the paths that a pattern names, which may begin at the root, as `Path.glob` takes none."""
    return glob.glob(pattern, recursive=True)  # noqa: PTH207


def _sorted(found: Iterable[Path], others: Iterable[Path]) -> Listed:
    return Listed(
        tuple(sorted({str(path.resolve()) for path in found})),
        tuple(sorted({str(path) for path in others})),
    )
