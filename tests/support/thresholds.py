"""Thresholds of the designs that tests diagnose: simulating one takes seconds, and they never change.

`tests/data/thresholds.json` holds them by the key of their design. What is not there is simulated as for any user,
so that a stale file costs time and nothing else. `BENCH_KEEP_THRESHOLDS=1 make test` writes the file anew.
"""

import json
import os
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

KEPT: Final = Path(__file__).parent.parent / "data" / "thresholds.json"
ASKED: Final = "BENCH_KEEP_THRESHOLDS"


def kept() -> dict[str, dict[str, Any]]:
    """Return what is kept: the fields of a `Threshold` by key."""
    return dict(json.loads(KEPT.read_text(encoding="utf-8"))) if KEPT.exists() else {}


def unpack(folder: Path) -> None:
    """Put what is kept into an empty folder, as the cache has it."""
    folder.mkdir(parents=True)
    for key, fields in kept().items():
        (folder / f"{key}.json").write_text(json.dumps(fields), encoding="utf-8")


def keep(folder: Path) -> None:
    """Where that is asked for, keep what the tests of this process left in the cache, beside what others did."""
    if not os.environ.get(ASKED):
        return
    with FileLock(str(KEPT.with_suffix(".lock"))):
        found = {f.stem: json.loads(f.read_text(encoding="utf-8")) for f in folder.glob("*.json")}
        lines = (
            f"{json.dumps(key)}: {json.dumps(fields)}" for key, fields in sorted((kept() | found).items())
        )
        KEPT.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    KEPT.with_suffix(".lock").unlink(missing_ok=True)
