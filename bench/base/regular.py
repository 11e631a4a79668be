"""Reading a file that was named by a person or by another file: a regular one, of a size that can be meant."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

MEGABYTE: Final = 1_000_000

_KINDS: Final = (
    (stat.S_ISDIR, "this is a folder; name a file in it"),
    (stat.S_ISFIFO, "this is a pipe, not a file"),
    (stat.S_ISSOCK, "this is a socket, not a file"),
    (stat.S_ISCHR, "this is a device, not a file"),
    (stat.S_ISBLK, "this is a device, not a file"),
)
_AT_ONCE: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the content of a regular file; nothing else is opened, and nothing is waited for.

    Raises `OSError` whose `strerror` says why not: what it is instead, or that it is too large.
    """
    try:
        _check(path, path.stat().st_mode)  # before it is opened: opening a device may do something
        descriptor = os.open(path, _AT_ONCE)
    except ValueError:  # a character that no name of a file can have
        raise FileNotFoundError(errno.ENOENT, "there is no such file", str(path)) from None
    with os.fdopen(descriptor, "rb") as file:
        _check(path, os.fstat(descriptor).st_mode)
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        size = f"{most_bytes / MEGABYTE:g} MB"
        raise OSError(errno.EFBIG, f"it has more than {size}", str(path))
    return content


def _check(path: Path, mode: int) -> None:
    for is_one, text in _KINDS:
        if is_one(mode):
            kind = IsADirectoryError if is_one is stat.S_ISDIR else OSError
            raise kind(errno.EISDIR if kind is IsADirectoryError else errno.EINVAL, text, str(path))
