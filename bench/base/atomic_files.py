"""Files that are there whole or not at all; JSON text, written and read."""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from bench.base.visible import in_json, shortened, visible
from bench.base.words import repeated


def to_text(result: Any) -> str:
    """Return a result as JSON text."""
    return in_json(json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False)) + "\n"


def from_text(text: str | bytes) -> Any:
    """Return what stands in JSON text, as the standard has it (RFC 8259).

    Raises `ValueError` where it is not JSON, has `NaN` or `Infinity`, a key twice, or brackets nested so deep that
    nobody can have meant them.
    """
    try:
        return json.loads(text, parse_constant=_no_number, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError("its brackets are nested too deep") from None


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is no number")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    whole = dict(pairs)
    if len(whole) < len(pairs):
        twice = repeated(name for name, _ in pairs)[0]
        raise ValueError(f"'{shortened(twice)}' stands twice")
    return whole


def write_whole(path: Path, text: str | bytes) -> None:
    """Write a file, a text in UTF-8, so that it is there whole or not at all. Raises `OSError` that names it.

    A link is followed; into what is no file (`/dev/null`, a pipe) the text is written, never put in its place.
    """
    content = text.encode() if isinstance(text, str) else text
    try:
        os.fsencode(path)
    except UnicodeEncodeError:  # half of a pair of UTF-16, which no file system takes
        raise OSError(errno.EINVAL, "no name that a file can have", visible(str(path))) from None
    try:
        if path.exists() and not path.is_file():
            with _opened_at_once(path) as special:
                special.write(content)
        else:
            _put_in_place(Path(os.path.realpath(path)), content)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _opened_at_once(path: Path) -> BinaryIO:
    """Open what is no file to write into it; a pipe that nobody reads is not waited for."""
    try:
        descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise OSError(errno.ENXIO, "this is a pipe that nobody reads") from None
        raise
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")


def _put_in_place(path: Path, content: bytes) -> None:
    half = path.with_name(path.name + ".part")
    try:
        half.write_bytes(content)
        half.replace(path)
    except OSError:
        with suppress(OSError):  # a file system that is read-only refuses that, too
            half.unlink(missing_ok=True)
        raise
