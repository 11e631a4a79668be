"""Files that are there whole or not at all, and results as JSON text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def to_text(result: Any) -> str:
    """Return a result as JSON text."""
    return json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_whole(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all. Raises `OSError` that names it."""
    half = path.with_name(path.name + ".part")
    try:
        half.write_text(text, encoding="utf-8", newline="")
        half.replace(path)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
