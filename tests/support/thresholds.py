"""Stored thresholds of the designs that tests diagnose: simulating one takes seconds, and they never change.

`tests/data/thresholds.json` has them by key of the design. A missing one is simulated once for all workers,
so that a stale file costs nothing but time. `make thresholds` writes it again.
"""

import json
import os
import warnings
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

KEPT: Final = Path(__file__).parent.parent / "data" / "thresholds.json"
ASKED: Final = "BENCH_KEEP_THRESHOLDS"


def kept() -> dict[str, dict[str, Any]]:
    """Return the stored thresholds: the fields of a `Threshold` by key."""
    return dict(json.loads(KEPT.read_text(encoding="utf-8"))) if KEPT.exists() else {}


def unpack(folder: Path, base: Path) -> None:
    """Copy the stored thresholds into a folder that all workers share, and make `folder` a link to it."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    shared = (base.parent if worker else base) / "thresholds"
    shared.mkdir(exist_ok=True)
    for key, fields in kept().items():
        part = shared / f"{key}.{worker}"
        part.write_text(json.dumps(fields), encoding="utf-8")
        part.replace(shared / f"{key}.json")
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.symlink_to(shared, target_is_directory=True)


def keep(folder: Path) -> None:
    """If `ASKED` is set in the environment, add the thresholds in the cache `folder` to the stored ones.

    Otherwise warn of designs that are not stored, each of which costs seconds.
    """
    if not os.environ.get(ASKED):
        if new := {file.stem for file in folder.glob("*.json")} - kept().keys():
            warnings.warn(
                f"thresholds had to be simulated: {', '.join(sorted(new))}; 'make thresholds' keeps them",
                stacklevel=1,
            )
        return
    with FileLock(str(KEPT.with_suffix(".lock"))):
        found = {f.stem: json.loads(f.read_text(encoding="utf-8")) for f in folder.glob("*.json")}
        lines = (
            f"{json.dumps(key)}: {json.dumps(fields)}" for key, fields in sorted((kept() | found).items())
        )
        KEPT.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    KEPT.with_suffix(".lock").unlink(missing_ok=True)
